// SPDX-License-Identifier: Apache-2.0
// Normal equations of a bundle adjustment over N keyframes of M patches; bundle_reference.py says what is computed.
#pragma once
#include <cstddef>

#include "linear.hpp"

namespace sf {

struct Bundle {
    int n, m;
    const double* T_ts;          // [N, N, 4, 4] source to target, source first
    const double* rays;          // [N, M, 2]
    const double* w;             // [N, M]
    const double* prior;         // [N, M]
    const double* prior_weight;  // [N, M]
    const double* uv;            // [N, N, M, 2]
    const double* root;          // [N, N, M, 3]; 0: not seen
};

struct Normal {
    double* H;  // [6N, 6N] of the poses
    double* b;  // [6N]
    double* C;  // [N, M] of the inverse depths
    double* c;  // [N, M]
    double* E;  // [6N, N M] their coupling
};

// Robust cost of all observations and priors, without measured motions.
double bundle_cost(const Camera& camera, const Bundle& p, double scale);

// motion, pull: [N, N, 6, 6] and [N, N, 6] information of measured motions and that times their error.
void linearise(const Camera& camera, const Bundle& p, double scale, const double* motion, const double* pull,
               const Normal& out);

// S [rows, rows] -= E diag(1 / C) E^T and b [rows] -= E diag(1 / C) c, for E [rows, columns].
void eliminate(const double* E, const double* C, const double* c, size_t rows, size_t columns, double* S, double* b);

}  // namespace sf
