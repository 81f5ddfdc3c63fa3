// SPDX-License-Identifier: Apache-2.0
// Robust pose of a camera from patches in the world; pose_reference.py says what it computes.
#pragma once
#include <cstddef>

#include "linear.hpp"

namespace sf {

struct Sights {
    const double* X;     // [E, 3] world position times inverse depth
    const double* w;     // [E] inverse depth
    const double* uv;    // [E, 2] px
    const double* root;  // [E, 3] root of the information
    size_t count;
};

struct PoseSolution {
    double T[12];   // rows of T_cw [3, 4]: the start, and the result
    double H[36];   // information of exp(xi) T_cw
    double excess;  // of squared errors over what the information says, at least 1
    double support;
};

// Gauss-Newton; `scales` [count] narrow the robust kernel; `prior` [6] holds the pose at its start. error: [E] px.
void solve_pose(const Camera& camera, const Sights& sights, const double* scales, size_t count, const double* prior,
                int steps, PoseSolution& solution, double* error);

}  // namespace sf
