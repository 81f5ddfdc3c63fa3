// SPDX-License-Identifier: Apache-2.0
#include "point_grid.hpp"

#include <algorithm>
#include <limits>

namespace sf {

void PointGrid::add(const float* p) {
    const int32_t cell = cells_.insert(cell_of(p, inverse_));
    if (static_cast<size_t>(cell) == heads_.size()) heads_.push_back(-1);
    if (heads_[cell] < 0 || blocks_[heads_[cell]].count == kBlock) {
        blocks_.push_back(Block{{}, {}, {}, {}, 0, heads_[cell]});
        heads_[cell] = static_cast<int32_t>(blocks_.size()) - 1;
    }
    Block& block = blocks_[heads_[cell]];
    block.x[block.count] = p[0];
    block.y[block.count] = p[1];
    block.z[block.count] = p[2];
    block.id[block.count++] = count_++;
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

void PointGrid::visit(Cell cell, const float* p, int k, float radius2, int32_t* ids, float* distance2) const {
    const int32_t found = cells_.find(cell);
    if (found < 0) return;
    for (int32_t b = heads_[found]; b >= 0; b = blocks_[b].next) {
        const Block& block = blocks_[b];
        float d2[kBlock];
        for (int i = 0; i < kBlock; ++i) {
            const float dx = block.x[i] - p[0], dy = block.y[i] - p[1], dz = block.z[i] - p[2];
            d2[i] = dx * dx + dy * dy + dz * dz;
        }
        for (int i = 0; i < block.count; ++i) {
            const auto before = [&](int j) {
                return d2[i] < distance2[j] || (d2[i] == distance2[j] && block.id[i] < ids[j]);
            };
            if (d2[i] > radius2 || !before(k - 1)) continue;
            int j = k - 1;
            for (; j > 0 && before(j - 1); --j) {
                ids[j] = ids[j - 1];
                distance2[j] = distance2[j - 1];
            }
            ids[j] = block.id[i];
            distance2[j] = d2[i];
        }
    }
}

void PointGrid::query(const float* p, int k, float radius, int32_t* ids, float* distance2) const {
    std::fill(ids, ids + k, -1);
    std::fill(distance2, distance2 + k, std::numeric_limits<float>::infinity());
    const Cell home = cell_of(p, inverse_);
    const float radius2 = radius * radius;
    const float corner[3] = {home.x * size_, home.y * size_, home.z * size_};
    // Distance from the point to the cells at an offset along one axis; shrunk a little against rounding.
    const auto gap = [&](int axis, int offset) {
        const float to_low = p[axis] - corner[axis];
        const float d = offset > 0 ? offset * size_ - to_low : offset < 0 ? to_low - (offset + 1) * size_ : 0.0f;
        return std::max(0.0f, d * 0.9999f - 1e-5f * size_);
    };
    const int rings = static_cast<int>(std::ceil(radius * inverse_));
    for (int ring = 0; ring <= rings; ++ring) {
        for (int dx = -ring; dx <= ring; ++dx) {
            const float gx = gap(0, dx), gx2 = gx * gx;
            for (int dy = -ring; dy <= ring; ++dy) {
                const float gy = gap(1, dy), gxy2 = gx2 + gy * gy;
                if (gxy2 > std::min(radius2, distance2[k - 1])) continue;
                const bool face = dx == -ring || dx == ring || dy == -ring || dy == ring;
                for (int dz = -ring; dz <= ring; dz += face || ring == 0 ? 1 : 2 * ring) {
                    const float gz = gap(2, dz);
                    if (gxy2 + gz * gz > std::min(radius2, distance2[k - 1])) continue;
                    visit({home.x + dx, home.y + dy, home.z + dz}, p, k, radius2, ids, distance2);
                }
            }
        }
        float reach = std::numeric_limits<float>::infinity();  // nearest cell not yet visited
        for (int axis = 0; axis < 3; ++axis) reach = std::min({reach, gap(axis, ring + 1), gap(axis, -ring - 1)});
        if (distance2[k - 1] < reach * reach) return;
    }
}

}  // namespace sf
