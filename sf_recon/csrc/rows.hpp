// SPDX-License-Identifier: Apache-2.0
// Tables with one row per point: interpolation, Adam on the rows that it touched, means of cells.
#pragma once
#include <cstddef>
#include <cstdint>
#include <vector>

namespace sf {

// out[i] = sum_j weights[i, j] * table[ids[i, j]]; ids and weights [n, k], table [rows, columns], out [n, columns].
// Entries of weight 0 are left out. False when another id is no row of the table.
bool interpolate(const float* table, size_t rows, size_t columns, const int32_t* ids, const float* weights, size_t n,
                 size_t k, float* out, int threads);

struct AdamRates {
    float rate, beta1, beta2, epsilon;
};

struct AdamTable {  // a table [rows, columns] and its moments; 4 bytes per value and 2 per row
    float* values;
    uint16_t *mean, *root;  // [rows, columns] half floats: first moment, and root of the second
    int16_t* steps;         // [rows]
    size_t rows, columns;
};

// One step of Adam on the rows that were interpolated with ids and weights [n, k], given the gradient [n, columns] of
// the interpolated values. Lazy: a row that no query touched keeps its value and its moments, and each row counts its
// own steps. Sums run in the order of the queries, so the result does not depend on threads. False, and nothing is
// changed, when an id with a weight is no row.
bool adam_rows(const int32_t* ids, const float* weights, size_t n, size_t k, const float* gradient,
               const AdamTable& table, const AdamRates& rates, int threads);

// Mean of the rows [n, columns] that fall in each cell of a grid (columns 0-2 are the position), in order of first
// appearance. Throws std::out_of_range for a position that is not finite or too far away.
std::vector<float> voxel_means(const float* rows, size_t n, size_t columns, float cell_size);

}  // namespace sf
