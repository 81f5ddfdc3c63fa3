// SPDX-License-Identifier: Apache-2.0
#include "point_grid.hpp"

#include <omp.h>

#include <algorithm>
#include <atomic>
#include <limits>

#include "simd.hpp"

namespace sf {
namespace {

constexpr float kInfinity = std::numeric_limits<float>::infinity();
constexpr size_t kSortFrom = 2048;    // queries; fewer stay in the order given
constexpr size_t kBuckets = 1 << 16;  // of the counting sort of queries
constexpr size_t kChunk = 256;        // queries a thread takes at a time

// Squared distances from a place to the layers of cells at offset -1, 0, 1 along an axis, shrunk against rounding.
struct Gaps {
    float squared[3][3];

    Gaps(const float* point, Cell home, float size) {
        const int32_t cell[3] = {home.x, home.y, home.z};
        for (int axis = 0; axis < 3; ++axis) {
            const float low = point[axis] - cell[axis] * size;
            const float below = std::max(0.0f, low * 0.9999f - 1e-5f * size);
            const float above = std::max(0.0f, (size - low) * 0.9999f - 1e-5f * size);
            squared[axis][0] = below * below;
            squared[axis][1] = 0.0f;
            squared[axis][2] = above * above;
        }
    }

    SF_INLINE float to(const int8_t* offset) const {
        return squared[0][offset[0] + 1] + squared[1][offset[1] + 1] + squared[2][offset[2] + 1];
    }
};

// A cell and its 26 neighbours: home, faces, edges, corners.
constexpr int8_t kOffsets[27][3] = {
    {0, 0, 0},  {-1, 0, 0}, {1, 0, 0},   {0, -1, 0},  {0, 1, 0},  {0, 0, -1},  {0, 0, 1},  {-1, -1, 0},  {-1, 1, 0},
    {1, -1, 0}, {1, 1, 0},  {-1, 0, -1}, {-1, 0, 1},  {1, 0, -1}, {1, 0, 1},   {0, -1, -1}, {0, -1, 1},  {0, 1, -1},
    {0, 1, 1},  {-1, -1, -1}, {-1, -1, 1}, {-1, 1, -1}, {-1, 1, 1}, {1, -1, -1}, {1, -1, 1}, {1, 1, -1}, {1, 1, 1}};

inline bool same(Cell a, Cell b) { return a.x == b.x && a.y == b.y && a.z == b.z; }

// Rows of the queries so that those in the same part of space follow one another: memory stays in the cache.
std::vector<uint32_t> by_place(const std::vector<Cell>& cells) {
    std::vector<uint32_t> order(cells.size());
    if (cells.size() < kSortFrom) {
        for (size_t i = 0; i < cells.size(); ++i) order[i] = static_cast<uint32_t>(i);
        return order;
    }
    Cell low = cells[0], high = cells[0];
    for (const Cell& c : cells) {
        low = {std::min(low.x, c.x), std::min(low.y, c.y), std::min(low.z, c.z)};
        high = {std::max(high.x, c.x), std::max(high.y, c.y), std::max(high.z, c.z)};
    }
    const auto extent = [](int32_t a, int32_t b, int shift) { return static_cast<size_t>((b - a) >> shift) + 1; };
    int shift = 0;
    while (extent(low.x, high.x, shift) * extent(low.y, high.y, shift) * extent(low.z, high.z, shift) > kBuckets)
        ++shift;
    const size_t ny = extent(low.y, high.y, shift), nz = extent(low.z, high.z, shift);
    const auto bucket = [&](const Cell& c) {
        return (static_cast<size_t>((c.x - low.x) >> shift) * ny + ((c.y - low.y) >> shift)) * nz +
               ((c.z - low.z) >> shift);
    };
    std::vector<uint32_t> begin(kBuckets + 1);
    for (const Cell& c : cells) ++begin[bucket(c) + 1];
    for (size_t i = 0; i < kBuckets; ++i) begin[i + 1] += begin[i];
    for (size_t i = 0; i < cells.size(); ++i) order[begin[bucket(cells[i])]++] = static_cast<uint32_t>(i);
    return order;
}

}  // namespace

// The k best so far: bits of the squared distance above the id, so that one comparison breaks ties.
struct PointGrid::Best {
    uint64_t keys[kMaxNeighbours];
    int k, found = 0;
    float bound;  // no point farther than this (squared) can enter

    Best(int k_, float radius) : k(k_), bound(std::min(radius * radius, std::numeric_limits<float>::max())) {}

    SF_INLINE void offer(float distance2, int32_t id) {
        const uint64_t key = static_cast<uint64_t>(to_bits(distance2)) << 32 | static_cast<uint32_t>(id);
        if (found == k && key >= keys[k - 1]) return;
        int j = found == k ? k - 1 : found++;
        for (; j > 0 && key < keys[j - 1]; --j) keys[j] = keys[j - 1];
        keys[j] = key;
        if (found == k) bound = std::min(bound, from_bits(static_cast<int32_t>(keys[k - 1] >> 32)));
    }

    // The k neighbours of another place, the farthest at kth2 (squared), are all at most this far from p.
    SF_INLINE void limit(const float* p, const float* other, float kth2) {
        const float dx = p[0] - other[0], dy = p[1] - other[1], dz = p[2] - other[2];
        const float reach = (std::sqrt(kth2) + std::sqrt(dx * dx + dy * dy + dz * dz)) * 1.0001f;
        bound = std::min(bound, reach * reach);
    }

    void write(int32_t* ids, float* distance2) const {
        for (int j = 0; j < k; ++j) {
            ids[j] = j < found ? static_cast<int32_t>(keys[j] & 0xffffffffu) : -1;
            distance2[j] = j < found ? from_bits(static_cast<int32_t>(keys[j] >> 32)) : kInfinity;
        }
    }
};

int32_t PointGrid::new_block(int32_t next) {
    const int32_t b = static_cast<int32_t>(next_.size());
    if (b % kPage == 0) pages_.emplace_back(new Block[kPage]);
    next_.push_back(next);
    filled_.push_back(0);
    Block& fresh = pages_[b / kPage][b % kPage];
    for (int i = 0; i < kBlock; ++i) {
        fresh.x[i] = kInfinity;
        fresh.y[i] = fresh.z[i] = 0.0f;
        fresh.id[i] = -1;
    }
    return b;
}

size_t PointGrid::nbytes() const {
    const size_t blocks = pages_.size() * kPage * sizeof(Block) + next_.capacity() * sizeof(int32_t) + filled_.capacity();
    return blocks + bricks_.capacity() * sizeof(Brick) + index_.nbytes();
}

void PointGrid::add(const float* p) {
    const Cell cell = cell_of(p, inverse_);
    const size_t brick = index_.insert(brick_of(cell));
    if (brick == bricks_.size()) std::fill_n(bricks_.emplace_back().newest, 64, -1);
    int32_t& b = bricks_[brick].newest[in_brick(cell)];
    if (b < 0 || filled_[b] == kBlock) b = new_block(b);
    Block& block = pages_[b / kPage][b % kPage];
    const int lane = filled_[b]++;
    block.x[lane] = p[0], block.y[lane] = p[1], block.z[lane] = p[2];
    block.id[lane] = count_++;
}

void PointGrid::add_spaced(const float* points, size_t n, float spacing, float copy_radius,
                           std::vector<int32_t>& rows, std::vector<int32_t>& parents) {
    const int32_t before = count_;
    for (size_t i = 0; i < n; ++i) {
        int32_t id;
        float distance2;
        query(points + 3 * i, 1, spacing, &id, &distance2);
        if (id >= 0) continue;
        query(points + 3 * i, 1, copy_radius, &id, &distance2);
        parents.push_back(id < before ? id : parents[id - before]);
        rows.push_back(static_cast<int32_t>(i));
        add(points + 3 * i);
    }
}

int32_t PointGrid::newest(Cell cell) const {
    const int32_t brick = index_.find(brick_of(cell));
    return brick < 0 ? -1 : bricks_[brick].newest[in_brick(cell)];
}

SF_INLINE void PointGrid::visit(int32_t first, const float* p, Best& best) const {
    for (int32_t b = first; b >= 0; b = next_[b]) {
        const Block& points = block(b);
        const Float8 dx = load8(points.x) - p[0], dy = load8(points.y) - p[1], dz = load8(points.z) - p[2];
        const Float8 d2 = dx * dx + dy * dy + dz * dz;
        for (uint32_t mask = lanes_set(d2 <= best.bound); mask; mask &= mask - 1) {
            const int i = __builtin_ctz(mask);
            best.offer(d2[i], points.id[i]);
        }
    }
}

// Rings of cells from the second on, until no cell farther out can hold a better point.
void PointGrid::search_rings(const float* p, float radius, Cell home, Best& best) const {
    if (radius < size_ * 0.9999f) return;  // the first ring was enough
    const float low[3] = {p[0] - home.x * size_, p[1] - home.y * size_, p[2] - home.z * size_};
    const auto gap = [&](int axis, int offset) {
        const float d = offset > 0 ? offset * size_ - low[axis] : offset < 0 ? low[axis] - (offset + 1) * size_ : 0.0f;
        return std::max(0.0f, d * 0.9999f - 1e-5f * size_);
    };
    const int rings = static_cast<int>(std::ceil(radius * inverse_));
    for (int ring = 2; ring <= rings; ++ring) {
        float reach = kInfinity;  // the nearest cell of this ring
        for (int axis = 0; axis < 3; ++axis) reach = std::min({reach, gap(axis, ring), gap(axis, -ring)});
        if (reach * reach > best.bound) return;
        for (int dx = -ring; dx <= ring; ++dx) {
            const float gx = gap(0, dx), gx2 = gx * gx;
            if (gx2 > best.bound) continue;
            for (int dy = -ring; dy <= ring; ++dy) {
                const float gy = gap(1, dy), gxy2 = gx2 + gy * gy;
                if (gxy2 > best.bound) continue;
                const bool face = dx == -ring || dx == ring || dy == -ring || dy == ring;
                for (int dz = -ring; dz <= ring; dz += face ? 1 : 2 * ring) {
                    const float gz = gap(2, dz);
                    if (gxy2 + gz * gz > best.bound) continue;
                    const int32_t first = newest({home.x + dx, home.y + dy, home.z + dz});
                    if (first >= 0) visit(first, p, best);
                }
            }
        }
    }
}

void PointGrid::query(const float* p, int k, float radius, int32_t* ids, float* distance2) const {
    const Cell home = cell_of(p, inverse_);
    const Gaps gaps(p, home, size_);
    Best best(k, radius);
    for (const auto& o : kOffsets) {
        if (gaps.to(o) > best.bound) continue;
        const int32_t first = newest({home.x + o[0], home.y + o[1], home.z + o[2]});
        if (first >= 0) visit(first, p, best);
    }
    search_rings(p, radius, home, best);
    best.write(ids, distance2);
}

const GridCursor::Around& GridCursor::around(Cell home) {
    const uint32_t mixed = static_cast<uint32_t>(home.x) * 73856093u ^ static_cast<uint32_t>(home.y) * 19349663u ^
                           static_cast<uint32_t>(home.z) * 83492791u;
    Around& slot = around_[mixed % kSlots];
    if (same(slot.home, home)) return slot;
    slot.home = home, slot.count = 0;
    const Cell low = PointGrid::brick_of({home.x - 1, home.y - 1, home.z - 1});
    const Cell high = PointGrid::brick_of({home.x + 1, home.y + 1, home.z + 1});
    const PointGrid::Brick* bricks[2][2][2] = {};
    for (int x = 0; x <= high.x - low.x; ++x)
        for (int y = 0; y <= high.y - low.y; ++y)
            for (int z = 0; z <= high.z - low.z; ++z) {
                const int32_t found = grid_->index_.find({low.x + x, low.y + y, low.z + z});
                if (found >= 0) bricks[x][y][z] = &grid_->bricks_[found];
            }
    for (const auto& o : kOffsets) {
        const Cell cell{home.x + o[0], home.y + o[1], home.z + o[2]}, b = PointGrid::brick_of(cell);
        const PointGrid::Brick* brick = bricks[b.x - low.x][b.y - low.y][b.z - low.z];
        const int32_t first = brick ? brick->newest[PointGrid::in_brick(cell)] : -1;
        if (first < 0) continue;
        slot.first[slot.count] = first;
        std::copy(o, o + 3, slot.offset[slot.count++]);
    }
    return slot;
}

SF_SIMD void GridCursor::query(const float* points, const uint32_t* rows, size_t n, int k, float radius, int32_t* ids,
                               float* distance2) {
    const PointGrid& grid = *grid_;
    const float* last = nullptr;  // the query before: its neighbours bound the distance of this one's
    for (size_t i = 0; i < n; ++i) {
        const float* p = points + 3 * rows[i];
        const Cell home = cell_of(p, grid.inverse_);
        const Around& near = around(home);
        const Gaps gaps(p, home, grid.size_);
        PointGrid::Best best(k, radius);
        if (last) best.limit(p, last, distance2[rows[i - 1] * k + k - 1]);
        for (int j = 0; j < near.count; ++j)
            if (gaps.to(near.offset[j]) <= best.bound) grid.visit(near.first[j], p, best);
        grid.search_rings(p, radius, home, best);
        best.write(ids + rows[i] * k, distance2 + rows[i] * k);
        last = p;
    }
}

bool PointGrid::knn(const float* points, size_t n, int k, float radius, int32_t* ids, float* distance2,
                    int threads) const {
    const int team = threads > 0 ? threads : omp_get_max_threads();
    std::vector<Cell> cells(n);
    std::atomic<bool> outside{false};
#pragma omp parallel for num_threads(team)
    for (size_t i = 0; i < n; ++i) {
        try {
            cells[i] = cell_of(points + 3 * i, inverse_);
        } catch (const std::out_of_range&) {  // an exception must not leave a parallel region
            outside = true;
        }
    }
    if (outside) return false;
    const std::vector<uint32_t> order = by_place(cells);
#pragma omp parallel num_threads(team)
    {
        GridCursor cursor(*this);
#pragma omp for schedule(dynamic, 1)
    for (size_t chunk = 0; chunk < (n + kChunk - 1) / kChunk; ++chunk) {
        const size_t first = chunk * kChunk;
        cursor.query(points, order.data() + first, std::min(kChunk, n - first), k, radius, ids, distance2);
    }
    }
    return true;
}

SF_SIMD bool PointGrid::collect(const float* p, float radius, Candidates& out) const {
    out.count = 0;
    const float radius2 = radius * radius;
    Cell low, high;
    const float first[3] = {p[0] - radius, p[1] - radius, p[2] - radius};
    const float last[3] = {p[0] + radius, p[1] + radius, p[2] + radius};
    low = cell_of(first, inverse_), high = cell_of(last, inverse_);
    for (int32_t x = low.x; x <= high.x; ++x)
        for (int32_t y = low.y; y <= high.y; ++y)
            for (int32_t z = low.z; z <= high.z; ++z)
                for (int32_t b = newest({x, y, z}); b >= 0; b = next_[b]) {
                    const Block& points = block(b);
                    if (out.count + kBlock > Candidates::kCapacity) return false;
                    const Float8 dx = load8(points.x) - p[0], dy = load8(points.y) - p[1], dz = load8(points.z) - p[2];
                    for (uint32_t m = lanes_set(dx * dx + dy * dy + dz * dz <= radius2); m; m &= m - 1) {
                        const int i = __builtin_ctz(m);
                        out.x[out.count] = points.x[i], out.y[out.count] = points.y[i], out.z[out.count] = points.z[i];
                        out.id[out.count++] = points.id[i];
                    }
                }
    return true;
}

}  // namespace sf
