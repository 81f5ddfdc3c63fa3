// SPDX-License-Identifier: Apache-2.0
// Points in a hashed grid: incremental insertion, exact K nearest neighbours within a radius.
#pragma once
#include <cstdint>
#include <memory>
#include <shared_mutex>
#include <vector>

#include "cell_map.hpp"

namespace sf {

constexpr int kMaxNeighbours = 64;

// Positions of points near one place, as arrays, so that distances are computed many at a time.
struct Candidates {
    static constexpr int kCapacity = 512;
    alignas(64) float x[kCapacity], y[kCapacity], z[kCapacity];
    int32_t id[kCapacity];
    int count = 0;
};

class GridCursor;

// Readers share `mutex()`, a writer owns it; the methods themselves do not lock.
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

    // query() for n points [n * 3] by a team of threads; false when a point is not finite or too far away.
    bool knn(const float* points, size_t n, int k, float radius, int32_t* ids, float* distance2, int threads) const;

    // All points within `radius` of a place; false when they are more than fit.
    bool collect(const float* point, float radius, Candidates& out) const;

    int32_t size() const { return count_; }
    size_t nbytes() const;  // of memory, free places included
    float cell_size() const { return size_; }
    std::shared_mutex& mutex() const { return mutex_; }

   private:
    friend class GridCursor;
    static constexpr int kBlock = 8, kPage = 1024;
    struct alignas(64) Block {  // unused lanes lie at infinity
        float x[kBlock], y[kBlock], z[kBlock];
        int32_t id[kBlock];
    };
    struct Brick {  // newest block of each of 4 x 4 x 4 cells, or -1: neighbouring cells share a look-up
        int32_t newest[64];
    };
    struct Best;

    const Block& block(int32_t b) const { return pages_[b / kPage][b % kPage]; }
    static Cell brick_of(Cell c) { return {c.x >> 2, c.y >> 2, c.z >> 2}; }
    static int in_brick(Cell c) { return (c.x & 3) << 4 | (c.y & 3) << 2 | (c.z & 3); }
    int32_t newest(Cell cell) const;
    int32_t new_block(int32_t next);
    void visit(int32_t first, const float* point, Best& best) const;
    void search_rings(const float* point, float radius, Cell home, Best& best) const;

    float size_, inverse_;
    CellMap index_;  // of the bricks
    std::vector<Brick> bricks_;
    std::vector<std::unique_ptr<Block[]>> pages_;  // growth never moves a block
    std::vector<int32_t> next_;                    // block after each block in its cell, or -1
    std::vector<uint8_t> filled_;                  // lanes of each block
    int32_t count_ = 0;
    mutable std::shared_mutex mutex_;
};

// Answers queries that lie near one another: it remembers what the cells around earlier ones hold. One per thread;
// the grid must not grow meanwhile.
class GridCursor {
   public:
    explicit GridCursor(const PointGrid& grid) : grid_(&grid), around_(kSlots) {}

    // PointGrid::query() for the points of the given rows; outputs in the same rows.
    void query(const float* points, const uint32_t* rows, size_t n, int k, float radius, int32_t* ids,
               float* distance2);

   private:
    static constexpr size_t kSlots = 64;
    struct Around {  // the occupied ones of a cell and its 26 neighbours, home and then faces, edges, corners
        Cell home{kCellLimit, 0, 0};
        int count = 0;
        int32_t first[27];
        int8_t offset[27][3];
    };

    const Around& around(Cell home);

    const PointGrid* grid_;
    std::vector<Around> around_;
};

}  // namespace sf
