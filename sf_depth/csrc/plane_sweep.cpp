// SPDX-License-Identifier: Apache-2.0
#include "plane_sweep.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "simd.hpp"

namespace sf {
namespace {

constexpr float kInfinite = std::numeric_limits<float>::infinity();

SF_INLINE Float8 smaller(const Float8& a, const Float8& b) { return a < b ? a : b; }
SF_INLINE Float8 larger(const Float8& a, const Float8& b) { return a < b ? b : a; }
SF_INLINE Float8 root(const Float8& v) {
    Float8 out;
    for (size_t q = 0; q < kLanes; ++q) out[q] = std::sqrt(v[q]);
    return out;
}

// One row of a source, warped onto the reference at inverse depth d, and whether it is hidden there (1) or seen (0).
SF_INLINE void warp(const Compared& c, size_t j, size_t row, float d, float* u, float* v, float* hidden,
                    float* warped) {
    const size_t w = c.columns, area = c.rows * w;
    const float *X = c.rotated + 3 * j * area + row * w, *t = c.t + 3 * j, *other = c.others + j * area;
    const float right = static_cast<float>(w) - 0.5f, bottom = static_cast<float>(c.rows) - 0.5f;
    const Float8 zero = {}, last = zero + (right - 0.5f), lowest = zero + (bottom - 0.5f);
    for (size_t k = 0; k < w; k += kLanes) {
        const size_t count = w - k;
        const Float8 z = load<Float8>(X + 2 * area + k, count) + t[2] * d, iz = 1.0f / larger(z, zero + c.least_z);
        const Float8 x = (load<Float8>(X + k, count) + t[0] * d) * iz;
        const Float8 y = (load<Float8>(X + area + k, count) + t[1] * d) * iz;
        const Float8 drawn = 1.0f + c.theta[4] * (x * x + y * y);
        const Float8 col = (c.theta[0] * x * drawn + c.theta[2]) / c.zoom[0] - 0.5f;
        const Float8 line = (c.theta[1] * y * drawn + c.theta[3]) / c.zoom[1] - 0.5f;
        const Int8 out = (col < -0.5f) | (col > right) | (line < -0.5f) | (line > bottom) | (z < c.least_z);
        store(hidden + k, out ? zero + 1.0f : zero, count);
        store(u + k, smaller(larger(col, zero), last), count);  // the border is repeated
        store(v + k, smaller(larger(line, zero), lowest), count);
    }
    for (size_t k = 0; k < w; ++k) {
        const int x = static_cast<int>(u[k]), y = static_cast<int>(v[k]);
        const float a = u[k] - static_cast<float>(x), b = v[k] - static_cast<float>(y);
        const float* top = other + static_cast<size_t>(y) * w + x;
        const size_t next = a > 0 ? 1 : 0, down = b > 0 ? w : 0;  // none beyond the last
        warped[k] = (1 - b) * ((1 - a) * top[0] + a * top[next]) + b * ((1 - a) * top[down] + a * top[down + next]);
    }
}

// The row above or below; at the border it is mirrored.
SF_INLINE size_t mirrored(size_t row, int step, size_t rows) {
    if (step < 0) return row > 0 ? row - 1 : 1;
    return row + 1 < rows ? row + 1 : rows - 2;
}

SF_INLINE Float8 mean_of(const float* sums, size_t k, size_t count) {
    const float* next = sums + k + 1;
    return (load<Float8>(sums + k, count) + load<Float8>(next, count) + load<Float8>(next + 1, count)) / 9.0f;
}

// The cost of one row of one source, into the two least so far.
SF_INLINE void compare(const Compared& c, const float* warped, const float* hidden, size_t r, float* sums, float* best,
                       float* second) {
    const size_t w = c.columns, rows[3] = {mirrored(r, -1, c.rows) * w, r * w, mirrored(r, 1, c.rows) * w};
    float* of[3] = {sums, sums + (w + 2), sums + 2 * (w + 2)};  // b, b^2 and a b; a column more on both sides
    for (size_t k = 0; k < w; k += kLanes) {
        Float8 b = {}, bb = {}, ab = {};
        for (const size_t row : rows) {
            const Float8 there = load<Float8>(warped + row + k, w - k);
            b += there;
            bb += there * there;
            ab += load<Float8>(c.first + row + k, w - k) * there;
        }
        store(of[0] + 1 + k, b, w - k);
        store(of[1] + 1 + k, bb, w - k);
        store(of[2] + 1 + k, ab, w - k);
    }
    for (float* row : of) {
        row[0] = row[2];
        row[w + 1] = row[w - 1];
    }
    for (size_t k = 0; k < w; k += kLanes) {
        const size_t at = rows[1] + k, count = w - k;
        const Float8 mean = mean_of(of[0], k, count);
        const Float8 product = mean_of(of[2], k, count) - load<Float8>(c.mean + at, count) * mean;
        const Float8 variance = larger(mean_of(of[1], k, count) - mean * mean, Float8{}) + c.noise;
        const Float8 alike = product * load<Float8>(c.scale + at, count) / root(variance);
        const Float8 cost = load<Float8>(hidden + at, count) > 0.0f ? Float8{} + c.unseen : 1.0f - alike;
        const Float8 least = load<Float8>(best + at, count);
        store(second + at, smaller(load<Float8>(second + at, count), larger(least, cost)), count);
        store(best + at, smaller(least, cost), count);
    }
}

}  // namespace

SF_SIMD void dissimilarity(const Compared& c, float d, float* out) {
    const size_t w = c.columns, area = w * c.rows;
    std::vector<float> warped(area), hidden(area), second(area, kInfinite), place(2 * w), sums(3 * (w + 2));
    std::fill_n(out, area, kInfinite);
    for (size_t j = 0; j < c.sources; ++j) {
        for (size_t r = 0; r < c.rows; ++r)
            warp(c, j, r, d, place.data(), place.data() + w, hidden.data() + r * w, warped.data() + r * w);
        for (size_t r = 0; r < c.rows; ++r)
            compare(c, warped.data(), hidden.data(), r, sums.data(), out, second.data());
    }
    if (c.sources > 1)
        for (size_t k = 0; k < area; ++k) out[k] = 0.5f * (out[k] + second[k]);
}

namespace {

// Adds the cost of the best path that comes from one side; `paths` holds those to the pixels before.
SF_INLINE void add_paths(const Costs& c, bool upright, bool back, const Prices& prices, float* paths, float* padded,
                         float* total) {
    const size_t planes = c.planes, pixels = c.rows * c.columns, steps = upright ? c.rows : c.columns;
    const ptrdiff_t stride = (upright ? static_cast<ptrdiff_t>(c.columns) : 1) * (back ? -1 : 1);
    for (size_t k = 0; k < pixels; ++k) {
        const size_t p = back ? pixels - 1 - k : k, along = upright ? p / c.columns : p % c.columns;
        const float* cost = c.cost + p * planes;
        float *path = paths + (upright ? p % c.columns : 0) * planes, *sum = total + p * planes;
        if (along == (back ? steps - 1 : 0)) {
            std::copy_n(cost, planes, path);
        } else {
            std::copy_n(path, planes, padded + 1);
            const float* before = padded;
            float least = kInfinite;
            for (size_t q = 0; q < planes; ++q) least = std::min(least, path[q]);
            const float jump = prices.jump / (1.0f + std::abs(c.image[p] - c.image[p - stride]) / prices.edge);
            const float other = least + std::max(jump, prices.bend);
            for (size_t q = 0; q < planes; ++q) {
                const float near = std::min(before[q], before[q + 2]) + prices.bend;
                path[q] = cost[q] + (std::min(std::min(near, before[q + 1]), other) - least);
            }
        }
        for (size_t q = 0; q < planes; ++q) sum[q] += path[q];
    }
}

}  // namespace

SF_SIMD void best_paths(const Costs& c, bool upright, const Prices& prices, float* total) {
    std::vector<float> paths((upright ? c.columns : 1) * c.planes), padded(c.planes + 2, kInfinite);
    std::fill_n(total, c.rows * c.columns * c.planes, 0.0f);
    add_paths(c, upright, false, prices, paths.data(), padded.data(), total);
    add_paths(c, upright, true, prices, paths.data(), padded.data(), total);
}

}  // namespace sf
