// SPDX-License-Identifier: Apache-2.0
#include "ipr_bins.hpp"

#include <omp.h>

namespace sf {
namespace {

constexpr float kInfinity = std::numeric_limits<float>::infinity();
constexpr size_t kBlock = 512;   // points projected at a time, into the cache
constexpr size_t kChunk = 8192;  // points a thread takes at a time

struct Projected {
    float u[kBlock], v[kBlock], z[kBlock];
    uint32_t columns[kBlock], rows[kBlock];  // see Visible
    int32_t visible[kBlock], wide[kBlock];   // whether it can be seen, and may cover a whole tile
};

SF_SIMD void project_block(const RasterSpec& spec, const float* points, size_t n, Projected& out) {
    const RasterSpec s = spec;  // a local copy: the compiler need not fear that `out` overlaps it
    for (size_t i = 0; i < n; ++i) {
        Window w;
        float u, v, z;
        out.visible[i] = sf::project(s, points + 3 * i, u, v, z, w);
        out.u[i] = u, out.v[i] = v, out.z[i] = z;
        out.columns[i] = static_cast<uint32_t>(w.x0 / kTile) | static_cast<uint32_t>(w.x1 / kTile) << 16;
        out.rows[i] = static_cast<uint32_t>(w.y0 / kTile) | static_cast<uint32_t>(w.y1 / kTile) << 16;
        out.wide[i] = (w.x1 - w.x0 >= kTile - 1) & (w.y1 - w.y0 >= kTile - 1);
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

void Lots::copy_to(size_t tile, std::vector<Fragment>& out) const {
    const Fragment* end = end_[tile];
    for (int32_t lot = newest_[tile]; lot >= 0; lot = before_[lot]) {
        const Fragment* first = at(lot);
        out.insert(out.end(), first, lot == newest_[tile] ? end : first + kLot);
    }
}

void Binner::project(const float* points, size_t first, size_t last, const RasterSpec& s, Worker& worker) const {
    Projected p;
    uint32_t rows[kBlock];
    for (size_t start = first; start < last; start += kBlock) {
        const size_t n = std::min(kBlock, last - start);
        project_block(s, points + 3 * start, n, p);
        size_t found = 0;
        for (size_t i = 0; i < n; ++i) {
            rows[found] = static_cast<uint32_t>(i);
            found += static_cast<size_t>(p.visible[i]);
        }
        for (size_t k = 0; k < found; ++k) {
            const size_t i = rows[k];
            const Visible point{{p.u[i], p.v[i], p.z[i], static_cast<int32_t>(start + i)}, p.columns[i], p.rows[i]};
            if (p.wide[i]) {
                worker.wide.push_back(point);
                continue;
            }
            for (int ty = point.y0(); ty <= point.y1(); ++ty)
                for (int tx = point.x0(); tx <= point.x1(); ++tx) worker.lots.add(ty * tiles_x_ + tx, point.fragment);
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
            for (int ty = point.y0(); ty <= point.y1(); ++ty)
                for (int tx = point.x0(); tx <= point.x1(); ++tx) {
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
        for (int ty = point.y0(); ty <= point.y1(); ++ty)
            for (int tx = point.x0(); tx <= point.x1(); ++tx) {
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

void Binner::fragments(int tile, std::vector<Fragment>& out) const {
    out.clear();
    for (const Worker& worker : workers_) worker.lots.copy_to(tile, out);
}

}  // namespace sf
