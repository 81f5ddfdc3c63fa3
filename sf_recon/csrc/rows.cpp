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

SF_SIMD bool accumulate(const int32_t* ids, const float* weights, size_t n, size_t k, const float* gradient,
                        size_t columns, float* sums, uint8_t* marks, size_t rows, std::vector<int64_t>& touched) {
    for (size_t i = 0; i < n * k; ++i) {
        if (weights[i] == 0.0f) continue;  // no neighbour there
        const size_t row = static_cast<size_t>(ids[i]);
        if (row >= rows) return false;
        if (!marks[row]) touched.push_back(static_cast<int64_t>(row));
        marks[row] = 1;
        add_scaled(sums + row * columns, gradient + i / k * columns, weights[i], columns);
    }
    return true;
}

SF_SIMD void adam_row(size_t columns, float step, float scale, const AdamRates& a, float* g, float* table, float* mean,
                      float* square) {
    for (size_t c = 0; c < columns; ++c) {
        mean[c] = a.beta1 * mean[c] + (1 - a.beta1) * g[c];
        square[c] = a.beta2 * square[c] + (1 - a.beta2) * g[c] * g[c];
        table[c] -= step * mean[c] / (std::sqrt(square[c] * scale) + a.epsilon);
        g[c] = 0.0f;
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

bool accumulate_rows(const int32_t* ids, const float* weights, size_t n, size_t k, const float* gradient,
                     size_t columns, float* sums, uint8_t* marks, size_t rows, std::vector<int64_t>& touched) {
    const bool good = accumulate(ids, weights, n, k, gradient, columns, sums, marks, rows, touched);
    for (const int64_t row : touched) marks[row] = 0;
    return good;
}

void adam_rows(const std::vector<int64_t>& touched, size_t columns, const AdamRates& a, float* sums, float* table,
               float* mean, float* square, float* steps) {
    std::vector<std::pair<float, float>> corrections;  // by the number of steps: most rows share few numbers
    for (const int64_t row : touched) {
        const size_t step = static_cast<size_t>(steps[row] += 1.0f);
        while (corrections.size() <= std::min<size_t>(step, 4096)) {
            const double t = static_cast<double>(corrections.size());
            corrections.emplace_back(static_cast<float>(a.rate / (1 - std::pow(a.beta1, t))),
                                     static_cast<float>(1 / (1 - std::pow(a.beta2, t))));
        }
        const auto [rate, scale] = corrections[std::min<size_t>(step, 4096)];
        const size_t at = static_cast<size_t>(row) * columns;
        adam_row(columns, rate, scale, a, sums + at, table + at, mean + at, square + at);
    }
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
