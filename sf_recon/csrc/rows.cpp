// SPDX-License-Identifier: Apache-2.0
#include "rows.hpp"

#include <omp.h>

#include <algorithm>
#include <atomic>
#include <cmath>

#include "cell_map.hpp"
#include "simd.hpp"

namespace sf {
namespace {

constexpr size_t kChunk = 512;
constexpr size_t kAhead = 12;  // rows lie anywhere in memory: ask for them this many before they are needed
constexpr int kMaxStep = 4096;    // from then on the bias corrections are 1
constexpr float kHalfMax = 6e4f, kHalfMin = 1e-7f;  // range of the moments

// sum += weight * row; columns that are a multiple of 8 go 8 at a time.
SF_INLINE void add_scaled(float* sum, const float* row, float weight, size_t columns) {
    size_t c = 0;
    for (; c + 8 <= columns; c += 8)
        for (size_t i = 0; i < 8; ++i) sum[c + i] += weight * row[c + i];
    for (; c < columns; ++c) sum[c] += weight * row[c];
}

SF_SIMD bool interpolate_chunk(const float* table, size_t rows, size_t columns, const int32_t* ids,
                               const float* weights, size_t n, size_t k, float* out) {
    for (size_t i = 0; i < n; ++i) {
        float* sum = out + i * columns;
        std::fill(sum, sum + columns, 0.0f);
        for (size_t j = i * k; j < (i + 1) * k; ++j) {
            if (weights[j] == 0.0f) continue;
            const size_t row = static_cast<size_t>(ids[j]);
            if (row >= rows) return false;
            add_scaled(sum, table + row * columns, weights[j], columns);
        }
    }
    return true;
}

// Dense numbers, in the order of first touch, for the rows of a few queries: no memory per row of the table.
class Touched {
   public:
    explicit Touched(size_t most) {
        size_t size = 64;
        while (size < 2 * most) size *= 2;
        slots_.assign(size, -1);
        rows.reserve(most);
    }

    size_t number(int32_t row) {
        const size_t mask = slots_.size() - 1;
        size_t slot = static_cast<uint32_t>(row) * 0x9E3779B1u & mask;
        while (slots_[slot] >= 0 && rows[slots_[slot]] != row) slot = (slot + 1) & mask;
        if (slots_[slot] < 0) {
            slots_[slot] = static_cast<int32_t>(rows.size());
            rows.push_back(row);
        }
        return static_cast<size_t>(slots_[slot]);
    }

    std::vector<int32_t> rows;

   private:
    std::vector<int32_t> slots_;
};

// Half floats by integer arithmetic, so that it vectorises everywhere; the nearest half, ties to even. A half below
// 2^-14 counts steps of 2^-24, which is what the last bits of a float near 0.5 do.
SF_INLINE float from_half(uint16_t half) {
    const int32_t size = half & 0x7fff;
    const float normal = from_bits((size << 13) + (112 << 23)), small = from_bits(size + to_bits(0.5f)) - 0.5f;
    const float value = size < 0x400 ? small : normal;
    return half & 0x8000 ? -value : value;
}

SF_INLINE uint16_t to_half(float value) {  // of at most 65504
    const float size = std::abs(value);
    const int32_t bits = to_bits(size);
    const int32_t normal = (bits - (112 << 23) + 0xfff + ((bits >> 13) & 1)) >> 13;
    const int32_t small = to_bits(size + 0.5f) - to_bits(0.5f);
    return static_cast<uint16_t>((size < 6.103515625e-5f ? small : normal) | (value < 0.0f ? 0x8000 : 0));
}

SF_SIMD void adam_row(size_t columns, float step, float scale, const AdamRates& a, const float* g, float* values,
                      uint16_t* means, uint16_t* roots) {
    for (size_t c = 0; c < columns; ++c) {
        const float root = from_half(roots[c]);
        const float mean = a.beta1 * from_half(means[c]) + (1 - a.beta1) * g[c];
        const float square = a.beta2 * root * root + (1 - a.beta2) * g[c] * g[c];
        values[c] -= step * mean / (std::sqrt(square * scale) + a.epsilon);
        means[c] = to_half(std::min(std::max(mean, -kHalfMax), kHalfMax));
        roots[c] = to_half(std::min(std::max(std::sqrt(square), kHalfMin), kHalfMax));
    }
}

}  // namespace

bool interpolate(const float* table, size_t rows, size_t columns, const int32_t* ids, const float* weights, size_t n,
                 size_t k, float* out, int threads) {
    std::atomic<bool> good{true};
#pragma omp parallel for num_threads(threads > 0 ? threads : omp_get_max_threads())
    for (size_t first = 0; first < n; first += kChunk) {
        const size_t count = std::min(kChunk, n - first);
        if (!interpolate_chunk(table, rows, columns, ids + first * k, weights + first * k, count, k,
                               out + first * columns))
            good = false;
    }
    return good;
}

bool adam_rows(const int32_t* ids, const float* weights, size_t n, size_t k, const float* gradient,
               const AdamTable& table, const AdamRates& a, int threads) {
    const size_t columns = table.columns;
    Touched touched(n * k);
    std::vector<float> sums;
    sums.reserve(n * k * columns);
    for (size_t i = 0; i < n * k; ++i) {
        if (weights[i] == 0.0f) continue;  // no neighbour there
        if (static_cast<size_t>(ids[i]) >= table.rows) return false;
        const size_t number = touched.number(ids[i]);
        if (number * columns == sums.size()) sums.resize(sums.size() + columns, 0.0f);
        add_scaled(sums.data() + number * columns, gradient + i / k * columns, weights[i], columns);
    }
    std::vector<std::pair<float, float>> corrections(kMaxStep + 1);  // of the step and of the square, by step number
    double power1 = 1, power2 = 1;
    for (int t = 1; t <= kMaxStep; ++t) {
        power1 *= a.beta1, power2 *= a.beta2;
        corrections[t] = {static_cast<float>(a.rate / (1 - power1)), static_cast<float>(1 / (1 - power2))};
    }
    const std::vector<int32_t>& rows = touched.rows;
#pragma omp parallel for num_threads(threads > 0 ? threads : omp_get_max_threads())
    for (size_t i = 0; i < rows.size(); ++i) {
        if (i + kAhead < rows.size()) {
            const size_t next = static_cast<size_t>(rows[i + kAhead]);
            __builtin_prefetch(table.values + next * columns, 1);
            __builtin_prefetch(table.mean + next * columns, 1);
            __builtin_prefetch(table.root + next * columns, 1);
            __builtin_prefetch(table.steps + next, 1);
        }
        const size_t row = static_cast<size_t>(rows[i]), at = row * columns;
        const int count = std::min<int>(table.steps[row] + 1, kMaxStep);
        table.steps[row] = static_cast<int16_t>(count);
        const auto [step, scale] = corrections[count];
        adam_row(columns, step, scale, a, sums.data() + i * columns, table.values + at, table.mean + at,
                 table.root + at);
    }
    return true;
}

std::vector<float> voxel_means(const float* rows, size_t n, size_t columns, float cell_size) {
    CellMap cells;
    std::vector<double> sums, counts;
    for (size_t i = 0; i < n; ++i) {
        const float* row = rows + i * columns;
        const size_t cell = cells.insert(cell_of(row, 1.0f / cell_size));
        if (cell == counts.size()) {
            counts.push_back(0.0);
            sums.resize(sums.size() + columns);
        }
        counts[cell] += 1.0;
        for (size_t c = 0; c < columns; ++c) sums[cell * columns + c] += row[c];
    }
    std::vector<float> means(sums.size());
    for (size_t i = 0; i < sums.size(); ++i) means[i] = static_cast<float>(sums[i] / counts[i / columns]);
    return means;
}

}  // namespace sf
