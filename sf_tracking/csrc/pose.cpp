// SPDX-License-Identifier: Apache-2.0
#include "pose.hpp"

#include <algorithm>
#include <limits>
#include <vector>

namespace sf {
namespace {

constexpr double kBehind = 1e-3, kStill = 1e-6, kMedianChi2 = 1.386;

struct Seen {
    double x, y, iz, ru, rv;  // on the image plane at unit depth, inverse z, residual px
};

// False behind the camera and for what is not finite.
bool see(const Camera& camera, const double* T, const Sights& s, size_t e, Seen& seen) {
    const double *X = s.X + 3 * e, w = s.w[e];
    double c[3];
    for (int i = 0; i < 3; ++i) c[i] = T[4 * i] * X[0] + T[4 * i + 1] * X[1] + T[4 * i + 2] * X[2] + w * T[4 * i + 3];
    if (!(c[2] > kBehind)) return false;
    seen.iz = 1.0 / c[2];
    seen.x = c[0] * seen.iz;
    seen.y = c[1] * seen.iz;
    seen.ru = s.uv[2 * e] - (camera.fx * seen.x + camera.cx);
    seen.rv = s.uv[2 * e + 1] - (camera.fy * seen.y + camera.cy);
    const double* root = s.root + 3 * e;
    return std::isfinite(seen.ru + seen.rv + root[0] + root[1] + root[2]);
}

double squared(const Seen& seen, const double* root) {
    const double u = root[0] * seen.ru + root[1] * seen.rv, v = root[2] * seen.rv;
    return u * u + v * v;
}

// H [6, 6] and g [6] of the robust cost at T, with information divided by `excess`.
void linearise(const Camera& camera, const double* T, const Sights& s, double scale, double excess, double* H,
               double* g) {
    const double shrink = 1.0 / std::sqrt(excess), far = 1.0 / (scale * scale);
    std::fill_n(H, 36, 0.0);
    std::fill_n(g, 6, 0.0);
    Seen p;
    for (size_t e = 0; e < s.count; ++e) {
        if (!see(camera, T, s, e, p)) continue;
        const double root[3] = {s.root[3 * e] * shrink, s.root[3 * e + 1] * shrink, s.root[3 * e + 2] * shrink};
        const double weight = std::sqrt(1.0 / (1.0 + squared(p, root) * far)), d = s.w[e] * p.iz;
        const double r[2] = {weight * (root[0] * p.ru + root[1] * p.rv), weight * root[2] * p.rv};
        const double on[2][2] = {{weight * root[0] * camera.fx, weight * root[1] * camera.fy},
                                 {0.0, weight * root[2] * camera.fy}};
        double J[2][6];
        by_pose(on, d, p.x, p.y, J);
        for (int i = 0; i < 6; ++i) {
            g[i] += J[0][i] * r[0] + J[1][i] * r[1];
            for (int j = 0; j <= i; ++j) H[6 * i + j] += J[0][i] * J[0][j] + J[1][i] * J[1][j];
        }
    }
    for (int i = 0; i < 6; ++i)
        for (int j = i + 1; j < 6; ++j) H[6 * i + j] = H[6 * j + i];
}

double median(std::vector<double>& values) {
    const size_t half = values.size() / 2;
    std::nth_element(values.begin(), values.begin() + half, values.end());
    if (values.size() % 2) return values[half];
    return 0.5 * (values[half] + *std::max_element(values.begin(), values.begin() + half));
}

// The largest component of the step that was taken; 0 where none can be solved for.
double step(const double* H, const double* g, const double* prior, double* T, double* away) {
    double A[36], b[6], xi[6], largest = 0;
    std::copy_n(H, 36, A);
    for (int i = 0; i < 6; ++i) {
        A[7 * i] += prior[i];
        b[i] = g[i] - prior[i] * away[i];
    }
    if (!solve_spd<6>(A, b, xi)) return 0;
    move(xi, T);
    for (int i = 0; i < 6; ++i) {
        away[i] += xi[i];
        largest = std::max(largest, std::abs(xi[i]));
    }
    return largest;
}

}  // namespace

void solve_pose(const Camera& camera, const Sights& sights, const double* scales, size_t count, const double* prior,
                int steps, PoseSolution& solution, double* error) {
    double away[6] = {}, g[6];
    Seen p;
    std::vector<double> errors;
    solution.excess = 1.0;
    solution.support = 0.0;
    std::fill_n(solution.H, 36, 0.0);
    for (size_t s = 0; s < count; ++s) {
        // Errors beyond what alignment claims (rolling shutter, depth registered badly) widen the kernel.
        const double excess = solution.excess;
        for (int i = 0; i < steps; ++i) {
            linearise(camera, solution.T, sights, scales[s], excess, solution.H, g);
            if (step(solution.H, g, prior, solution.T, away) < kStill) break;
        }
        errors.clear();
        solution.support = 0.0;
        for (size_t e = 0; e < sights.count; ++e) {
            if (!see(camera, solution.T, sights, e, p)) continue;
            errors.push_back(squared(p, sights.root + 3 * e));
            solution.support += 1.0 / (1.0 + errors.back() / (scales[s] * scales[s]));
        }
        solution.excess = errors.empty() ? 1.0 : std::max(1.0, median(errors) / kMedianChi2);
    }
    for (size_t e = 0; e < sights.count; ++e)
        error[e] = see(camera, solution.T, sights, e, p) ? std::hypot(p.ru, p.rv) : std::numeric_limits<double>::infinity();
}

}  // namespace sf
