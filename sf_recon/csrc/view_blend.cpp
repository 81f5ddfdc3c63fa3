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
        p.inside[i] = ahead & (border > 0.0f) ? faded : 0.0f;  // false for what is not a number
    }
}

typedef uint8_t Bytes8 __attribute__((vector_size(8), aligned(1)));

SF_INLINE Float8 bytes8(const uint8_t* bytes) {
    return __builtin_convertvector(*reinterpret_cast<const Bytes8*>(bytes), Float8);
}

// color += weight * the image between its pixels' centres; x and y are positive.
SF_INLINE void add_sample(const SourceView& view, float x, float y, float weight, float* color) {
    const int left = static_cast<int>(x + 0.5f) - 1, top = static_cast<int>(y + 0.5f) - 1;  // -1: half a pixel outside
    const float s = x - 0.5f - static_cast<float>(left), t = y - 0.5f - static_cast<float>(top);
    const int y0 = std::max(top, 0), y1 = std::min(top + 1, view.height - 1);
    const uint8_t* upper = view.image + 3 * static_cast<size_t>(y0) * view.width;
    const uint8_t* lower = view.image + 3 * static_cast<size_t>(y1) * view.width;
    const float above = weight * (1 - t), below = weight * t;
    if (left >= 0 && left + 3 <= view.width - 1) {  // eight bytes from the left pixel lie in the row
        const Float8 mixed = above * bytes8(upper + 3 * left) + below * bytes8(lower + 3 * left);
        for (int k = 0; k < 3; ++k) color[k] += (1 - s) * mixed[k] + s * mixed[k + 3];
        return;
    }
    const int x0 = std::max(left, 0), x1 = std::min(left + 1, view.width - 1);
    for (int k = 0; k < 3; ++k)
        color[k] += (1 - s) * (above * upper[3 * x0 + k] + below * lower[3 * x0 + k]) +
                    s * (above * upper[3 * x1 + k] + below * lower[3 * x1 + k]);
}

SF_SIMD void blend_run(const SourceView& view, const BlendRules& rules, const Places& p, const uint8_t* surface, int n,
                       float* color, float* total, float* confidence) {
    for (int i = 0; i < n; ++i) {
        if (p.inside[i] == 0.0f) continue;
        const size_t column = std::min(static_cast<int>(p.x[i]), view.width - 1);
        const size_t row = std::min(static_cast<int>(p.y[i]), view.height - 1);
        const int steps = view.depth[row * view.width + column];
        float agreement = rules.unknown;
        if (steps != 0) {
            const float off = surface[i] ? std::abs(static_cast<float>(steps) * view.step - p.d[i]) / p.d[i] : 0.0f;
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
