// SPDX-License-Identifier: Apache-2.0
// Diffusion in an image along the links between its pixels; diffusion_reference.py says what it computes.
#pragma once
#include <cstddef>

namespace sf {

constexpr size_t kChannels = 4;

// right, down [H, W]: conductance of the link to the next pixel, 0 in the last column and row; ground [H, W]: that of
// the links to what is known, inflow [H, W, 4]: what comes through those. A pixel without links stays as it is.
struct Linked {
    size_t rows, columns;
    const float *right, *down, *ground, *inflow;
};

// So many steps of conjugate gradients from values [H, W, 4] towards those that the flow through the links keeps.
void settle(const Linked& linked, size_t steps, float* values);

}  // namespace sf
