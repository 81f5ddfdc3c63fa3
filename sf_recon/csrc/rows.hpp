// SPDX-License-Identifier: Apache-2.0
// Tables with one row per point: interpolation, its transpose, Adam on the rows touched, means of cells.
#pragma once
#include <cstddef>
#include <cstdint>
#include <vector>

namespace sf {

// out[i] = sum_j weights[i, j] * table[ids[i, j]]; ids and weights [n, k], table [rows, columns], out [n, columns].
// Entries of weight 0 are left out. False when another id is no row of the table.
bool interpolate(const float* table, size_t rows, size_t columns, const int32_t* ids, const float* weights, size_t n,
                 size_t k, float* out, int threads);

// The transpose: sums[ids[i, j]] += weights[i, j] * gradient[i], in order. `touched` gets the rows in order of first
// touch; `marks` [rows] is 0 between calls. False when an id is no row.
bool accumulate_rows(const int32_t* ids, const float* weights, size_t n, size_t k, const float* gradient,
                     size_t columns, float* sums, uint8_t* marks, size_t rows, std::vector<int64_t>& touched);

struct AdamRates {
    float rate, beta1, beta2, epsilon;
};

// One step of Adam on the touched rows of a table by their gradient in `sums`, which is then 0 again. Each row counts
// its own steps. table, mean, square, sums [rows, columns]; steps [rows].
void adam_rows(const std::vector<int64_t>& touched, size_t columns, const AdamRates& rates, float* sums, float* table,
               float* mean, float* square, float* steps);

// Mean of the rows [n, columns] that fall in each cell of a grid (columns 0-2 are the position), in order of first
// appearance. Throws std::out_of_range for a position that is not finite or too far away.
std::vector<float> voxel_means(const float* rows, size_t n, size_t columns, float cell_size);

}  // namespace sf
