// SPDX-License-Identifier: Apache-2.0
// A reduced reference compared with its sources plane by plane; plane_sweep_reference.py says what is computed.
#pragma once
#include <cstddef>

namespace sf {

struct Compared {
    size_t sources, rows, columns;
    const float* first;    // [h, w] grey levels
    const float* mean;     // [h, w] of the windows of the reference
    const float* scale;    // [h, w] one over their deviation
    const float* others;   // [S, h, w]
    const float* rotated;  // [S, 3, h, w] rays of the reference, turned into each source
    const float* t;        // [S, 3]
    float theta[5], zoom[2];
    float least_z, noise, unseen;
};

// 1 - correlation with the two sources most alike, if the scene were at inverse depth d, [h, w].
void dissimilarity(const Compared& c, float d, float* out);

struct Costs {
    size_t rows, columns, planes;
    const float* cost;   // [h, w, D]
    const float* image;  // [h, w] grey levels
};

struct Prices {
    float bend, jump, edge;  // of the next plane; of any other, and the grey levels at which that costs half
};

// Cost [h, w, D] of the best paths along the columns (upright) or the rows that end in a pixel on a plane, both ways.
void best_paths(const Costs& costs, bool upright, const Prices& prices, float* total);

}  // namespace sf
