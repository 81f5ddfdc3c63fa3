// SPDX-License-Identifier: Apache-2.0
#include "ipr_bins.hpp"

#include <omp.h>

namespace sf {
namespace {

constexpr float kInfinity = std::numeric_limits<float>::infinity();
constexpr size_t kBlock = 512;    // points projected at a time, into the cache
constexpr size_t kLanes = 16;    // of the widest vectors
constexpr size_t kChunk = 8192;   // points a thread takes at a time

// Points of a block that may be seen, and where they lie in the image.
struct Seen {
    size_t n = 0;
    int32_t row[kBlock];  // in the block
    float point[3 * kBlock];
    Fragment fragment[kBlock];
    Window tiles[kBlock];
    uint8_t kind[kBlock];  // see Kind
};

enum Kind : uint8_t { kHidden, kNarrow, kWide };  // a wide point may cover a whole tile

SF_SIMD void test_block(const RasterSpec& spec, const float* points, size_t n, uint8_t* may_show) {
    const RasterSpec s = spec;  // a local copy: the compiler need not fear that an output overlaps it
    const Frustum frustum(s);
    for (size_t i = 0; i < n; ++i) may_show[i] = frustum.may_show(s, points + 3 * i);
}

// The memory is asked for the points up to `ahead` meanwhile.
void pick_block(const RasterSpec& spec, const float* points, size_t n, size_t ahead, Seen& out) {
    uint8_t may_show[kBlock];
    for (size_t i = 3 * n; i < 3 * ahead; i += 64 / sizeof(float)) __builtin_prefetch(points + i);
    test_block(spec, points, n, may_show);
    out.n = 0;
    for (size_t i = 0; i < n; ++i) {
        out.row[out.n] = static_cast<int32_t>(i);
        out.n += may_show[i];
    }
    for (size_t k = 0; k < out.n; ++k) std::memcpy(out.point + 3 * k, points + 3 * out.row[k], 3 * sizeof(float));
}

SF_SIMD void project_block(const RasterSpec& spec, int32_t first, Seen& out) {
    const RasterSpec s = spec;
    const size_t whole = (out.n + kLanes - 1) / kLanes * kLanes;  // no rest that is worked through one by one
    std::fill(out.point + 3 * out.n, out.point + 3 * whole, 0.0f);
    std::fill(out.row + out.n, out.row + whole, 0);
    for (size_t i = 0; i < whole; ++i) {
        Window w;
        float u, v, z;
        const bool visible = sf::project(s, out.point + 3 * i, u, v, z, w);
        const bool wide = (w.x1 - w.x0 >= kTile - 1) & (w.y1 - w.y0 >= kTile - 1);
        out.kind[i] = visible ? (wide ? kWide : kNarrow) : kHidden;
        out.fragment[i].u = u, out.fragment[i].v = v, out.fragment[i].z = z, out.fragment[i].id = first + out.row[i];
        out.tiles[i].x0 = w.x0 / kTile, out.tiles[i].x1 = w.x1 / kTile;
        out.tiles[i].y0 = w.y0 / kTile, out.tiles[i].y1 = w.y1 / kTile;
    }
}

}  // namespace

void Lots::clear(size_t tiles) {
    before_.clear();
    newest_.assign(tiles, -1);
    end_.assign(tiles, nullptr);
}

Fragment* Lots::fresh(size_t tile) {
    const size_t lot = before_.size();
    if (lot / kPage == pages_.size()) pages_.emplace_back(new Lot[kPage]);
    before_.push_back(newest_[tile]);
    newest_[tile] = static_cast<int32_t>(lot);
    return pages_[lot / kPage][lot % kPage].fragments;
}

void Binner::project(const float* points, size_t first, size_t last, const RasterSpec& s, Worker& worker) const {
    Seen seen;
    for (size_t start = first; start < last; start += kBlock) {
        pick_block(s, points + 3 * start, std::min(kBlock, last - start), std::min(2 * kBlock, last - start), seen);
        project_block(s, static_cast<int32_t>(start), seen);
        for (size_t i = 0; i < seen.n; ++i) {
            if (seen.kind[i] == kWide) worker.wide.push_back({seen.fragment[i], seen.tiles[i]});
            if (seen.kind[i] == kNarrow) add(seen.fragment[i], seen.tiles[i], worker.lots);
        }
    }
}

// Close-ups: the k_ray nearest points that cover a whole tile fill all its pixels; wide points behind them are culled,
// so that memory does not grow with the area of the windows.
void Binner::bound_tiles(const RasterSpec& s) {
    std::vector<std::vector<float>> nearest(bound_.size());  // heaps, the farthest on top
    for (const Worker& worker : workers_)
        for (const Visible& point : worker.wide) {
            const Fragment& f = point.fragment;
            const float hx = half_width(s, s.fx, f.z), hy = half_width(s, s.fy, f.z);
            const int x0 = first_pixel(f.u, hx, 0), x1 = last_pixel(f.u, hx, s.width - 1);
            const int y0 = first_pixel(f.v, hy, 0), y1 = last_pixel(f.v, hy, s.height - 1);
            for (int ty = point.tiles.y0; ty <= point.tiles.y1; ++ty)
                for (int tx = point.tiles.x0; tx <= point.tiles.x1; ++tx) {
                    const int left = tx * kTile, top = ty * kTile, tile = ty * tiles_x_ + tx;
                    if (x0 > left || x1 < std::min(left + kTile, s.width) - 1 || f.z >= bound_[tile]) continue;
                    if (y0 > top || y1 < std::min(top + kTile, s.height) - 1) continue;
                    std::vector<float>& heap = nearest[tile];
                    if (heap.size() == static_cast<size_t>(s.k_ray)) {
                        std::pop_heap(heap.begin(), heap.end());
                        heap.pop_back();
                    }
                    heap.push_back(f.z);
                    std::push_heap(heap.begin(), heap.end());
                    if (heap.size() == static_cast<size_t>(s.k_ray)) bound_[tile] = heap.front();
                }
        }
}

void Binner::add_wide(Worker& worker) const {
    for (const Visible& point : worker.wide)
        for (int ty = point.tiles.y0; ty <= point.tiles.y1; ++ty)
            for (int tx = point.tiles.x0; tx <= point.tiles.x1; ++tx) {
                const int tile = ty * tiles_x_ + tx;
                if (point.fragment.z <= bound_[tile]) worker.lots.add(tile, point.fragment);
            }
}

void Binner::bin(const float* points, size_t n, const RasterSpec& s, int threads) {
    tiles_x_ = (s.width + kTile - 1) / kTile, tiles_y_ = (s.height + kTile - 1) / kTile;
    bound_.assign(tiles(), kInfinity);
    workers_.resize(threads);
    for (Worker& worker : workers_) {  // also of threads that the system may not grant this time
        worker.lots.clear(tiles());
        worker.wide.clear();
    }
#pragma omp parallel for schedule(dynamic, 1) num_threads(threads)
    for (size_t first = 0; first < n; first += kChunk)
        project(points, first, std::min(first + kChunk, n), s, workers_[omp_get_thread_num()]);
    bound_tiles(s);
#pragma omp parallel for schedule(static, 1) num_threads(threads)
    for (int i = 0; i < threads; ++i) add_wide(workers_[i]);
}

}  // namespace sf
