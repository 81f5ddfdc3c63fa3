// SPDX-License-Identifier: Apache-2.0
// Improved Point Rasterization on the CPU; sf_recon/core/ipr_reference.py is its definition.
#pragma once
#include <cstddef>

namespace sf {

struct RasterSpec {
    float rotation[9], translation[3];  // T_camera_map, row major
    float fx, fy, cx, cy;
    int width, height;
    float radius;      // half-width of a point's window, in units of length
    float near;        // points with z below it are left out
    float max_half;    // cap of the half-width, px
    int k_ray;         // points per pixel, nearest in depth
    float layer_gap;   // a step in depth of at least this ends the first layer
    float sigma;       // of the weight exp(-q2 / sigma), q2 in half-widths squared
    int threads;       // 0: all
};

// depth [height * width] (NaN = hole); position [height * width * 3] in the camera frame, or null.
void rasterize(const float* points, size_t n, const RasterSpec& spec, float* depth, float* position);

}  // namespace sf
