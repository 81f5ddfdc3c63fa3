// SPDX-License-Identifier: Apache-2.0
// Measured surfaces: depth thinned to a grid, and one step of point-to-plane alignment; shape_reference.py defines both.
#pragma once
#include <cstddef>
#include <cstdint>

#include "linear.hpp"

namespace sf {

// Planes through the inverse depths of blocks of step x step of a depth image [height, width] (NaN or <= 0: none): how
// many pixels are known, depth in the middle of the block, and the deviation from the plane relative to it. Out:
// [height / step, width / step] each; 0 without any.
void thin(const float* z, int height, int width, int step, int32_t* known, double* centre, double* rough);

struct Surface {
    const double* points;   // [K, 3] m
    const double* normals;  // [K, 3], NaN where it is not smooth
    size_t count;
};

struct Grid {
    const int64_t* index;  // [height, width] of the surface's points, -1: none
    int height, width;
    double to_col, to_row;  // cells per px
    Camera camera;
};

// The target's point that each source point falls on, moved by T [4, 4]; -1: none.
void partners(const double* T, const double* points, size_t count, const Grid& grid, int64_t* partner);

struct PlaneSystem {
    double H[36], g[6];
    int64_t used;  // points that count
    int64_t met;   // points with a partner, however far
};

// Normal equations of the robust distances of points [count, 3], moved by T, to the planes of their partners.
// reach: how far apart they may lie, relative to the depth of the point. The points deviate by the share of ``sigma``
// that their distances show, but by no less than the share ``least``.
void plane_system(const double* T, const double* points, const double* sigma, const int64_t* partner, size_t count,
                  const Surface& target, double reach, double scale, double least, double trust, PlaneSystem& out);

}  // namespace sf
