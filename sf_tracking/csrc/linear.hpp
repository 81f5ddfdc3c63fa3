// SPDX-License-Identifier: Apache-2.0
// Small dense linear algebra and rigid motions, row-major doubles.
#pragma once
#include <cmath>

#include "simd.hpp"

namespace sf {

struct Camera {
    double fx, fy, cx, cy;
};

// Solves A x = b for a symmetric positive definite A [N, N] by Cholesky; false where A is none.
template <int N>
bool solve_spd(const double* A, const double* b, double* x) {
    double L[N][N], y[N];
    for (int i = 0; i < N; ++i)
        for (int j = 0; j <= i; ++j) {
            double s = A[N * i + j];
            for (int k = 0; k < j; ++k) s -= L[i][k] * L[j][k];
            if (i != j)
                L[i][j] = s / L[j][j];
            else if (s > 0 && std::isfinite(s))
                L[i][i] = std::sqrt(s);
            else
                return false;
        }
    for (int i = 0; i < N; ++i) {
        double s = b[i];
        for (int k = 0; k < i; ++k) s -= L[i][k] * y[k];
        y[i] = s / L[i][i];
    }
    for (int i = N - 1; i >= 0; --i) {
        double s = y[i];
        for (int k = i + 1; k < N; ++k) s -= L[k][i] * x[k];
        x[i] = s / L[i][i];
    }
    return true;
}

// T <- exp(xi) T for a motion [3, 4] of rows, tangent (translation, rotation).
inline void move(const double* xi, double* T) {
    const double *rho = xi, *w = xi + 3;
    const double t2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2], t = std::sqrt(t2);
    const bool small = t < 1e-4;
    const double a = small ? 1 - t2 / 6 : std::sin(t) / t;
    const double b = small ? 0.5 - t2 / 24 : (1 - std::cos(t)) / t2;
    const double c = small ? 1.0 / 6 - t2 / 120 : (t - std::sin(t)) / (t2 * t);
    const double W[9] = {0, -w[2], w[1], w[2], 0, -w[0], -w[1], w[0], 0};
    double R[9], V[9], out[12];
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) {
            const double one = i == j, square = w[i] * w[j] - t2 * one;
            R[3 * i + j] = one + a * W[3 * i + j] + b * square;
            V[3 * i + j] = one + b * W[3 * i + j] + c * square;
        }
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 4; ++j) {
            double s = j == 3 ? V[3 * i] * rho[0] + V[3 * i + 1] * rho[1] + V[3 * i + 2] * rho[2] : 0.0;
            for (int k = 0; k < 3; ++k) s += R[3 * i + k] * T[4 * k + j];
            out[4 * i + j] = s;
        }
    for (int i = 0; i < 12; ++i) T[i] = out[i];
}

// Derivative of a whitened reprojection by a small motion (translation, rotation) of the camera that sees it, at
// (x, y) of the image plane; ``on`` whitens and holds the focal lengths, d is inverse depth there.
template <class Real>
SF_INLINE void by_pose(const Real on[2][2], const Real& d, const Real& x, const Real& y, Real J[2][6]) {
    for (int i = 0; i < 2; ++i) {
        const Real a = on[i][0], b = on[i][1];
        J[i][0] = a * d;
        J[i][1] = b * d;
        J[i][2] = -d * (a * x + b * y);
        J[i][3] = -a * x * y - b * (1 + y * y);
        J[i][4] = a * (1 + x * x) + b * x * y;
        J[i][5] = b * x - a * y;
    }
}

}  // namespace sf
