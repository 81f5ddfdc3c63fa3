// SPDX-License-Identifier: Apache-2.0
// Dense bundle adjustment over S sources of N reference pixels; dense_ba_reference.py says what is computed.
#pragma once
#include <cstddef>

namespace sf {

struct Views {
    size_t sources, pixels;
    const double* theta;   // [5] fx fy cx cy k1
    const double* T;       // [S, 4, 4] source from reference
    const double* x;       // [2, N] rays of the reference
    const double* d;       // [N] inverse depth
    const double* target;  // [S, 2, N] px; anything where the weight is 0
    const double* weight;  // [S, N]
    const double* turn;    // [S, 3] rotation of a source while its rows are read, rad per unit of the row's tangent
};

// What is free of a source.
struct Free {
    bool poses, turn;
    size_t columns() const { return (poses ? 6 : 0) + (turn ? 3 : 0); }
};

struct Intrinsics {
    size_t count;           // K free ones
    const float* dx;        // [2, K, N] derivative of the rays
    const double* columns;  // [5, K] derivative of theta
};

struct Equations {
    double* H;      // [P, P] of poses, turns and intrinsics, in this order
    double* g;      // [P]
    float* E;       // [P, N] coupling with the inverse depths
    float* C;       // [N] of the inverse depths
    float* w;       // [N]
    float* scores;  // [P, N] what each pixel contributes to g; null: not wanted
};

// Squared residuals [S, N] px^2; NaN where a source cannot see the point, or where the weight is 0.
void squared_residuals(const Views& views, float* out);

// Sum of the Cauchy costs of `count` squared residuals; one that is NaN counts as `blind`. And that of the weights.
void robust_cost(const float* squares, const double* weight, size_t count, double c2, double blind, double& cost,
                 double& total);

// The normal equations, each observation weighted by its confidence and a Cauchy kernel of width^2 c2.
void linearise(const Views& views, const Intrinsics& free, Free own, double c2, const Equations& out);

// S [P, P] = H - E C^-1 E^T and b [P] = g - E C^-1 w.
void eliminate(const float* E, const float* C, const float* w, const double* H, const double* g, size_t rows,
               size_t pixels, double* S, double* b);

// dd [N] = C^-1 (w - E^T dx).
void substitute(const float* E, const float* C, const float* w, const double* dx, size_t rows, size_t pixels,
                double* dd);

}  // namespace sf
