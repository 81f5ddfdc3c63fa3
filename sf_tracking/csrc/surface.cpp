// SPDX-License-Identifier: Apache-2.0
#include "surface.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "simd.hpp"

namespace sf {

constexpr double kRidge = 1e-9;  // keeps a plane through few pixels determined

SF_SIMD void thin(const float* z, int height, int width, int step, int32_t* known, double* centre, double* rough) {
    const int rows = height / step, cols = width / step;
    const double middle = 0.5 * (step - 1);
    for (int row = 0; row < rows; ++row)
        for (int col = 0; col < cols; ++col) {
            const float* block = z + static_cast<size_t>(row) * step * width + static_cast<size_t>(col) * step;
            // Sums of 1, u, v, uu, uv, vv, w, uw, vw, ww over the known pixels; w is inverse depth.
            double n = 0, su = 0, sv = 0, suu = 0, suv = 0, svv = 0, sw = 0, suw = 0, svw = 0, sww = 0;
            for (int i = 0; i < step; ++i) {
                const double v = i - middle;
                for (int j = 0; j < step; ++j) {
                    const float d = block[static_cast<size_t>(i) * width + j];
                    const bool good = d > 0.0f && d <= std::numeric_limits<float>::max();
                    const double one = good ? 1.0 : 0.0, w = good ? 1.0 / static_cast<double>(d) : 0.0;
                    const double u = one * (j - middle);
                    n += one;
                    su += u;
                    sv += one * v;
                    suu += u * u;
                    suv += u * v;
                    svv += one * v * v;
                    sw += w;
                    suw += u * w;
                    svw += v * w;
                    sww += w * w;
                }
            }
            const size_t cell = static_cast<size_t>(row) * cols + col;
            known[cell] = static_cast<int32_t>(n);
            centre[cell] = rough[cell] = 0.0;
            const double A[9] = {n + kRidge, su, sv, su, suu + kRidge, suv, sv, suv, svv + kRidge}, b[3] = {sw, suw, svw};
            double x[3];
            if (n == 0 || !solve_spd<3>(A, b, x) || !(x[0] > 0)) continue;
            centre[cell] = 1.0 / x[0];
            rough[cell] = std::sqrt(std::max(sww - x[0] * b[0] - x[1] * b[1] - x[2] * b[2], 0.0) / n) / x[0];
        }
}

namespace {

SF_INLINE void transform(const double* T, const double* p, double* q) {
    for (int i = 0; i < 3; ++i) q[i] = T[4 * i] * p[0] + T[4 * i + 1] * p[1] + T[4 * i + 2] * p[2] + T[4 * i + 3];
}

}  // namespace

void partners(const double* T, const double* points, size_t count, const Grid& grid, int64_t* partner) {
    double p[3];
    for (size_t k = 0; k < count; ++k) {
        transform(T, points + 3 * k, p);
        partner[k] = -1;
        if (!(p[2] > 0)) continue;
        const double col = std::floor((grid.camera.fx * (p[0] / p[2]) + grid.camera.cx) * grid.to_col);
        const double row = std::floor((grid.camera.fy * (p[1] / p[2]) + grid.camera.cy) * grid.to_row);
        if (col >= 0 && row >= 0 && col < grid.width && row < grid.height)
            partner[k] = grid.index[static_cast<size_t>(row) * grid.width + static_cast<size_t>(col)];
    }
}

SF_SIMD void plane_system(const double* T, const double* points, const double* sigma, const int64_t* partner,
                          size_t count, const Surface& target, double reach, double scale, double least, double trust,
                          PlaneSystem& out) {
    out.met = 0;
    // Of the points that count, one after the other: distance to the plane, deviation, normal and moment of the plane.
    std::vector<double> off, deviation, sorted, rows[6];
    for (auto* values : {&off, &deviation, &rows[0], &rows[1], &rows[2], &rows[3], &rows[4], &rows[5]})
        values->reserve(count);
    double q[3];
    for (size_t k = 0; k < count; ++k) {
        if (partner[k] < 0 || static_cast<size_t>(partner[k]) >= target.count) continue;
        transform(T, points + 3 * k, q);
        const double *p = target.points + 3 * partner[k], *n = target.normals + 3 * partner[k];
        const double d[3] = {p[0] - q[0], p[1] - q[1], p[2] - q[2]};
        const double r = d[0] * n[0] + d[1] * n[1] + d[2] * n[2];
        if (!std::isfinite(r) || !(sigma[k] > 0)) continue;
        ++out.met;
        const double far = reach * q[2];
        if (!(far > 0 && d[0] * d[0] + d[1] * d[1] + d[2] * d[2] < far * far)) continue;
        off.push_back(r);
        deviation.push_back(sigma[k]);
        const double J[6] = {n[0], n[1], n[2], q[1] * n[2] - q[2] * n[1], q[2] * n[0] - q[0] * n[2],
                             q[0] * n[1] - q[1] * n[0]};
        for (int i = 0; i < 6; ++i) rows[i].push_back(J[i]);
    }
    std::fill_n(out.H, 36, 0.0);
    std::fill_n(out.g, 6, 0.0);
    out.used = static_cast<int64_t>(off.size());
    if (off.empty()) return;
    sorted.resize(off.size());
    for (size_t i = 0; i < off.size(); ++i) sorted[i] = std::abs(off[i]) / deviation[i];
    const size_t half = sorted.size() / 2;
    std::nth_element(sorted.begin(), sorted.begin() + half, sorted.end());
    double middle = sorted[half];
    if (sorted.size() % 2 == 0) middle = 0.5 * (middle + *std::max_element(sorted.begin(), sorted.begin() + half));
    const double rough = std::max(1.4826 * middle, least);
    Double8 H[6][6] = {}, g[6] = {}, J[6];
    for (size_t k = 0; k < off.size(); k += 8) {
        const int left = static_cast<int>(std::min<size_t>(8, off.size() - k));
        const Double8 r = gather8(off.data() + k, 1, left);
        Double8 s = gather8(deviation.data() + k, 1, left) * rough;
        for (int i = left; i < 8; ++i) s[i] = 1.0;  // of no point; its row is 0
        const Double8 far = r / (s * scale), weight = trust / ((1.0 + far * far) * s * s);
        for (int a = 0; a < 6; ++a) J[a] = gather8(rows[a].data() + k, 1, left);
        for (int a = 0; a < 6; ++a) {
            const Double8 weighted = weight * J[a];
            g[a] += weighted * r;
            for (int b = 0; b <= a; ++b) H[a][b] += weighted * J[b];
        }
    }
    for (int a = 0; a < 6; ++a) {
        out.g[a] = sum(g[a]);
        for (int b = 0; b <= a; ++b) out.H[6 * a + b] = sum(H[a][b]);
    }
    for (int a = 0; a < 6; ++a)
        for (int b = a + 1; b < 6; ++b) out.H[6 * a + b] = out.H[6 * b + a];
}

}  // namespace sf
