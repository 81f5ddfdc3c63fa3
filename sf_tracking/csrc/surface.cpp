// SPDX-License-Identifier: Apache-2.0
#include "surface.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "simd.hpp"

namespace sf {

SF_SIMD void thin(const float* z, int height, int width, int step, int32_t* known, double* mean, double* extent) {
    const int rows = height / step, cols = width / step;
    for (int row = 0; row < rows; ++row)
        for (int col = 0; col < cols; ++col) {
            const float* block = z + static_cast<size_t>(row) * step * width + static_cast<size_t>(col) * step;
            double sum = 0;
            float low = std::numeric_limits<float>::infinity(), high = 0;
            int32_t count = 0;
            for (int i = 0; i < step; ++i)
                for (int j = 0; j < step; ++j) {
                    const float d = block[static_cast<size_t>(i) * width + j];
                    const bool good = d > 0.0f && d <= std::numeric_limits<float>::max();
                    sum += good ? d : 0.0f;
                    low = good && d < low ? d : low;
                    high = good && d > high ? d : high;
                    count += good;
                }
            const size_t cell = static_cast<size_t>(row) * cols + col;
            known[cell] = count;
            mean[cell] = count ? sum / count : 0.0;
            extent[cell] = count ? double(high) - double(low) : 0.0;
        }
}

void partners(const double* moved, size_t count, const Grid& grid, int64_t* partner) {
    for (size_t k = 0; k < count; ++k) {
        const double* p = moved + 3 * k;
        partner[k] = -1;
        if (!(p[2] > 0)) continue;
        const double col = std::floor((grid.camera.fx * (p[0] / p[2]) + grid.camera.cx) * grid.to_col);
        const double row = std::floor((grid.camera.fy * (p[1] / p[2]) + grid.camera.cy) * grid.to_row);
        if (col >= 0 && row >= 0 && col < grid.width && row < grid.height)
            partner[k] = grid.index[static_cast<size_t>(row) * grid.width + static_cast<size_t>(col)];
    }
}

void plane_system(const double* moved, const double* sigma, const int64_t* partner, size_t count, const Surface& target,
                  double reach, double scale, double least, double trust, PlaneSystem& out) {
    out.met = 0;
    std::vector<double> off, sorted;
    std::vector<size_t> used;
    off.reserve(count);
    used.reserve(count);
    for (size_t k = 0; k < count; ++k) {
        if (partner[k] < 0 || static_cast<size_t>(partner[k]) >= target.count) continue;
        const double *p = target.points + 3 * partner[k], *n = target.normals + 3 * partner[k], *q = moved + 3 * k;
        const double d[3] = {p[0] - q[0], p[1] - q[1], p[2] - q[2]};
        const double r = d[0] * n[0] + d[1] * n[1] + d[2] * n[2];
        const double distance = std::sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
        if (!std::isfinite(r) || !(sigma[k] > 0)) continue;
        ++out.met;
        if (!(distance < reach * q[2])) continue;
        off.push_back(r);
        used.push_back(k);
    }
    std::fill_n(out.H, 36, 0.0);
    std::fill_n(out.g, 6, 0.0);
    out.used = static_cast<int64_t>(used.size());
    if (used.empty()) return;
    sorted.resize(off.size());
    for (size_t i = 0; i < used.size(); ++i) sorted[i] = std::abs(off[i]) / sigma[used[i]];
    const size_t half = sorted.size() / 2;
    std::nth_element(sorted.begin(), sorted.begin() + half, sorted.end());
    double middle = sorted[half];
    if (sorted.size() % 2 == 0) middle = 0.5 * (middle + *std::max_element(sorted.begin(), sorted.begin() + half));
    const double rough = std::max(1.4826 * middle, least);
    for (size_t i = 0; i < used.size(); ++i) {
        const size_t k = used[i];
        const double *n = target.normals + 3 * partner[k], *q = moved + 3 * k, r = off[i];
        const double deviation = sigma[k] * rough, far = r / (deviation * scale);
        const double weight = trust / ((1.0 + far * far) * deviation * deviation);
        const double J[6] = {n[0], n[1], n[2], q[1] * n[2] - q[2] * n[1], q[2] * n[0] - q[0] * n[2],
                             q[0] * n[1] - q[1] * n[0]};
        for (int a = 0; a < 6; ++a) {
            out.g[a] += weight * J[a] * r;
            for (int b = 0; b <= a; ++b) out.H[6 * a + b] += weight * J[a] * J[b];
        }
    }
    for (int a = 0; a < 6; ++a)
        for (int b = a + 1; b < 6; ++b) out.H[6 * a + b] = out.H[6 * b + a];
}

}  // namespace sf
