// SPDX-License-Identifier: Apache-2.0
// Points in a hashed grid: incremental insertion, exact K nearest neighbours within a radius.
#pragma once
#include <cstdint>
#include <vector>

#include "cell_map.hpp"

namespace sf {

class PointGrid {
   public:
    explicit PointGrid(float cell_size) : size_(cell_size), inverse_(1.0f / cell_size) {}

    // Append one point; its id is the number of points before it.
    void add(const float* point);

    // Greedy, in order: append each point whose nearest neighbour is farther than `spacing`. Outputs, one entry per
    // accepted point: its row in `points`, and the id of the nearest point within `copy_radius` that existed before
    // the call (followed through points of this call), or -1.
    void add_spaced(const float* points, size_t n, float spacing, float copy_radius, std::vector<int32_t>& rows,
                    std::vector<int32_t>& parents);

    // The k nearest within `radius` (inclusive), ascending by (distance, id); ids -1 and distance2 inf where fewer.
    void query(const float* point, int k, float radius, int32_t* ids, float* distance2) const;

    int32_t size() const { return count_; }

   private:
    static constexpr int kBlock = 8;
    struct Block {
        float x[kBlock], y[kBlock], z[kBlock];
        int32_t id[kBlock];
        int32_t count, next;
    };

    void visit(Cell cell, const float* point, int k, float radius2, int32_t* ids, float* distance2) const;

    float size_, inverse_;
    CellMap cells_;
    std::vector<int32_t> heads_;  // newest block of every cell
    std::vector<Block> blocks_;
    int32_t count_ = 0;
};

}  // namespace sf
