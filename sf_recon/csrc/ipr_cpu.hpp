// SPDX-License-Identifier: Apache-2.0
// Improved Point Rasterization; sf_recon/core/ipr_reference.py is its definition.
#pragma once
#include <cstddef>
#include <cstdint>

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

// Images; all but depth may be null. NaN, or index -1 and weight 0, where nothing is drawn.
struct RasterImages {
    float* depth;     // [height * width]
    float* position;  // [height * width * 3] camera frame
    int32_t* index;   // [height * width * k_ray] first-layer points, front to back
    float* weight;    // [height * width * k_ray] sum to 1
    float* normal;    // [height * width * 3] unit, camera frame, towards the camera
};

// `normals` [n * 3] of the points, map frame, or null: then normals come from the drawn depth.
void rasterize(const float* points, const float* normals, size_t n, const RasterSpec& spec, const RasterImages& out);

// Normals of a drawn surface from the positions of neighbouring pixels whose depth differs by less than `layer_gap`.
void normals_of(const float* position, int width, int height, float layer_gap, int threads, float* normal);

}  // namespace sf
