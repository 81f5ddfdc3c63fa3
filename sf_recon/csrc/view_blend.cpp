// SPDX-License-Identifier: Apache-2.0
#include "view_blend.hpp"

#include <omp.h>

#include <algorithm>
#include <cmath>

#include "simd.hpp"

namespace sf {
namespace {

constexpr int kRun = 256;  // pixels of a row whose places are computed at once
constexpr float kAhead = 1e-6f;

struct Places {  // in the view: continuous pixel, depth, and the weight of being inside
    float x[kRun], y[kRun], d[kRun], inside[kRun];
};

SF_SIMD void project_run(const SourceView& view, const BlendRules& rules, const float* z, int first, int row, int n,
                         Places& p) {
    const float* A = view.A;
    const float v = static_cast<float>(row) + 0.5f, w = static_cast<float>(view.width), feather = rules.feather;
    const float h = static_cast<float>(view.height);
    const float rx = A[1] * v + A[2], ry = A[4] * v + A[5], rd = A[7] * v + A[8];
    for (int i = 0; i < n; ++i) {
        const float u = static_cast<float>(first + i) + 0.5f;
        const float d = z[i] * (A[6] * u + rd) + view.b[2];
        const bool ahead = d > kAhead;
        const float divisor = ahead ? d : 1.0f;
        const float x = (z[i] * (A[0] * u + rx) + view.b[0]) / divisor;
        const float y = (z[i] * (A[3] * u + ry) + view.b[1]) / divisor;
        const float across = x < w - x ? x : w - x, down = y < h - y ? y : h - y;
        const float border = (across < down ? across : down) / feather;
        const float faded = border < 1.0f ? border : 1.0f;
        p.x[i] = x, p.y[i] = y, p.d[i] = divisor;
        p.inside[i] = ahead & (faded > 0.0f) ? faded : 0.0f;  // also for what is not a number
    }
}

// color += weight * the image between its pixels' centres.
SF_INLINE void add_sample(const SourceView& view, float x, float y, float weight, float* color) {
    x -= 0.5f, y -= 0.5f;
    const float fx = std::floor(x), fy = std::floor(y), s = x - fx, t = y - fy;
    const int x0 = std::max(static_cast<int>(fx), 0), x1 = std::min(static_cast<int>(fx) + 1, view.width - 1);
    const int y0 = std::max(static_cast<int>(fy), 0), y1 = std::min(static_cast<int>(fy) + 1, view.height - 1);
    const uint8_t* upper = view.image + 3 * static_cast<size_t>(y0) * view.width;
    const uint8_t* lower = view.image + 3 * static_cast<size_t>(y1) * view.width;
    const float a = weight * (1 - s) * (1 - t), b = weight * s * (1 - t), c = weight * (1 - s) * t, d = weight * s * t;
    for (int k = 0; k < 3; ++k)
        color[k] += a * upper[3 * x0 + k] + b * upper[3 * x1 + k] + c * lower[3 * x0 + k] + d * lower[3 * x1 + k];
}

void blend_run(const SourceView& view, const BlendRules& rules, const Places& p, const uint8_t* surface, int n,
               float* color, float* total, float* confidence) {
    for (int i = 0; i < n; ++i) {
        if (p.inside[i] == 0.0f) continue;
        const size_t column = std::min(static_cast<int>(p.x[i]), view.width - 1);
        const size_t row = std::min(static_cast<int>(p.y[i]), view.height - 1);
        const uint16_t steps = view.depth[row * view.width + column];
        float agreement = rules.unknown;
        if (steps != 0) {
            const float off = surface[i] ? std::abs(steps * view.step - p.d[i]) / p.d[i] : 0.0f;
            if (off >= rules.other) continue;
            agreement = 1 / (1 + (off / rules.doubt) * (off / rules.doubt));
        }
        const float weight = p.inside[i] * agreement * view.weight;
        confidence[i] = std::max(confidence[i], view.trust * p.inside[i]);
        total[i] += weight;
        add_sample(view, p.x[i], p.y[i], weight, color + 3 * i);
    }
}

}  // namespace

void blend_view(const float* z, const uint8_t* surface, int width, int height, const SourceView& view,
                const BlendRules& rules, float* color, float* total, float* confidence, int threads) {
#pragma omp parallel for schedule(dynamic, 16) num_threads(threads > 0 ? threads : omp_get_max_threads())
    for (int row = 0; row < height; ++row) {
        Places places;
        for (int first = 0; first < width; first += kRun) {
            const int n = std::min(kRun, width - first);
            const size_t at = static_cast<size_t>(row) * width + first;
            project_run(view, rules, z + at, first, row, n, places);
            blend_run(view, rules, places, surface + at, n, color + 3 * at, total + at, confidence + at);
        }
    }
}

}  // namespace sf
