// SPDX-License-Identifier: Apache-2.0
// The patches of a keyframe as another view has them; reproject_reference.py says what it computes.
#pragma once
#include <cstddef>
#include <cstdint>

#include "linear.hpp"

namespace sf {

struct Rays {
    const double* uv;     // [M, 2] px, the patch in its keyframe
    const double* w;      // [M] inverse depth
    const double* slope;  // [M, 2] d(inverse depth)/d(uv)
    size_t count;
};

struct Reprojection {
    double* uv;     // [M, 2] px, NaN behind the camera
    double* warp;   // [M, 2, 2]
    double* J_w;    // [M, 2] d(uv)/d(inverse depth)
    double* w;      // [M] inverse depth there
    bool* visible;  // [M]
};

// T [4, 4] moves points of the keyframe into the view, an image of width by height px; `least` and `most` bound the
// change of a patch's area.
void reproject(const Camera& camera, const double* T, const Rays& rays, double width, double height, double least,
               double most, const Reprojection& out);

}  // namespace sf
