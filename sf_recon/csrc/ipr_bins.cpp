// SPDX-License-Identifier: Apache-2.0
#include "ipr_bins.hpp"

#include <omp.h>

namespace sf {
namespace {

constexpr float kInfinity = std::numeric_limits<float>::infinity();
constexpr size_t kBlock = 512;      // points projected at a time, into the cache
constexpr size_t kMinChunk = 8192;  // points
constexpr int kChunksPerThread = 4;

struct Projected {  // pixels of the window, inclusive; empty for a point that is not visible
    float u[kBlock], v[kBlock], z[kBlock];
    int32_t x0[kBlock], x1[kBlock], y0[kBlock], y1[kBlock], visible[kBlock];
};

SF_SIMD void project_block(const RasterSpec& spec, const float* points, size_t n, Projected& out) {
    const RasterSpec s = spec;  // a local copy: the compiler need not fear that `out` overlaps it
    for (size_t i = 0; i < n; ++i) {
        Window w;
        float u, v, z;
        out.visible[i] = sf::project(s, points + 3 * i, u, v, z, w);
        out.u[i] = u, out.v[i] = v, out.z[i] = z;
        out.x0[i] = w.x0, out.x1[i] = w.x1, out.y0[i] = w.y0, out.y1[i] = w.y1;
    }
}

}  // namespace

void Binner::project(const float* points, size_t first, size_t last, const RasterSpec& s, int chunk) {
    Projected p;
    uint32_t rows[kBlock];
    Visible* out = visible_.get() + first;
    size_t* counts = offset_.data() + chunk * static_cast<size_t>(bins_.tiles_x * bins_.tiles_y);
    bool covers = false;
    for (size_t start = first; start < last; start += kBlock) {
        const size_t n = std::min(kBlock, last - start);
        project_block(s, points + 3 * start, n, p);
        size_t found = 0;
        for (size_t i = 0; i < n; ++i) {
            rows[found] = static_cast<uint32_t>(i);
            found += static_cast<size_t>(p.visible[i]);
        }
        for (size_t k = 0; k < found; ++k, ++out) {
            const size_t i = rows[k];
            out->fragment = {p.u[i], p.v[i], p.z[i], static_cast<int32_t>(start + i)};
            out->x0 = static_cast<uint16_t>(p.x0[i] / kTile), out->x1 = static_cast<uint16_t>(p.x1[i] / kTile);
            out->y0 = static_cast<uint16_t>(p.y0[i] / kTile), out->y1 = static_cast<uint16_t>(p.y1[i] / kTile);
            covers |= p.x1[i] - p.x0[i] >= kTile - 1 && p.y1[i] - p.y0[i] >= kTile - 1;
            for (int ty = out->y0; ty <= out->y1; ++ty)  // now, while the point is in the cache
                for (int tx = out->x0; tx <= out->x1; ++tx) ++counts[ty * bins_.tiles_x + tx];
        }
    }
    first_[chunk] = first;
    found_[chunk] = static_cast<size_t>(out - (visible_.get() + first));
    covers_[chunk] = covers;
}

// Counts anew what lies before the bounds of the tiles.
void Binner::count(int chunk) {
    size_t* counts = offset_.data() + chunk * static_cast<size_t>(bins_.tiles_x * bins_.tiles_y);
    const Visible* v = visible_.get() + first_[chunk];
    for (const Visible* end = v + found_[chunk]; v < end; ++v)
        for (int ty = v->y0; ty <= v->y1; ++ty)
            for (int tx = v->x0; tx <= v->x1; ++tx) {
                const int tile = ty * bins_.tiles_x + tx;
                counts[tile] += v->fragment.z <= bound_[tile];
            }
}

// Close-ups: the k_ray nearest points that cover a whole tile fill all its pixels; what lies behind them is culled, so
// that memory does not grow with the area of the windows.
// Returns whether there is any such tile.
bool Binner::bound_tiles(const RasterSpec& s, int chunks) {
    if (std::find(covers_.begin(), covers_.begin() + chunks, 1) == covers_.begin() + chunks) return false;
    std::vector<std::vector<float>> nearest(bound_.size());  // heaps, the farthest on top
    for (int c = 0; c < chunks; ++c)
        for (const Visible* v = visible_.get() + first_[c]; v < visible_.get() + first_[c] + found_[c]; ++v) {
            const Fragment& f = v->fragment;
            const float hx = half_width(s, s.fx, f.z), hy = half_width(s, s.fy, f.z);
            const int x0 = first_pixel(f.u, hx, 0), x1 = last_pixel(f.u, hx, s.width - 1);
            const int y0 = first_pixel(f.v, hy, 0), y1 = last_pixel(f.v, hy, s.height - 1);
            for (int ty = v->y0; ty <= v->y1; ++ty)
                for (int tx = v->x0; tx <= v->x1; ++tx) {
                    const int left = tx * kTile, top = ty * kTile, tile = ty * bins_.tiles_x + tx;
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
    return true;
}

// Turns counts into write positions; returns the number of fragments.
size_t Binner::place(int chunks) {
    const size_t tiles = bound_.size();
    size_t total = 0;
    for (size_t tile = 0; tile < tiles; ++tile) {
        bins_.begin[tile] = total;
        for (int c = 0; c < chunks; ++c) {
            const size_t count = offset_[c * tiles + tile];
            offset_[c * tiles + tile] = total;
            total += count;
        }
    }
    return bins_.begin[tiles] = total;
}

void Binner::scatter(int chunk) {
    size_t* write = offset_.data() + chunk * bound_.size();
    const Visible* v = visible_.get() + first_[chunk];
    for (const Visible* end = v + found_[chunk]; v < end; ++v)
        for (int ty = v->y0; ty <= v->y1; ++ty)
            for (int tx = v->x0; tx <= v->x1; ++tx) {
                const int tile = ty * bins_.tiles_x + tx;
                if (v->fragment.z <= bound_[tile]) bins_.fragments[write[tile]++] = v->fragment;
            }
}

const Bins& Binner::bin(const float* points, size_t n, const RasterSpec& s, int threads) {
    bins_.tiles_x = (s.width + kTile - 1) / kTile, bins_.tiles_y = (s.height + kTile - 1) / kTile;
    const size_t tiles = static_cast<size_t>(bins_.tiles_x) * bins_.tiles_y;
    const int chunks = static_cast<int>(std::min<size_t>(kChunksPerThread * threads, n / kMinChunk + 1));
    if (capacity_ < n) visible_.reset(new Visible[capacity_ = n]);
    first_.resize(chunks), found_.resize(chunks), covers_.resize(chunks);
    offset_.assign(chunks * tiles, 0);
    bound_.assign(tiles, kInfinity);
    bins_.begin.resize(tiles + 1);
#pragma omp parallel for schedule(dynamic, 1) num_threads(threads)
    for (int c = 0; c < chunks; ++c) project(points, n * c / chunks, n * (c + 1) / chunks, s, c);
    if (bound_tiles(s, chunks)) {
        offset_.assign(chunks * tiles, 0);
#pragma omp parallel for schedule(dynamic, 1) num_threads(threads)
        for (int c = 0; c < chunks; ++c) count(c);
    }
    const size_t total = place(chunks);
    if (bins_.capacity < total) bins_.fragments.reset(new Fragment[bins_.capacity = total + total / 4]);
#pragma omp parallel for schedule(dynamic, 1) num_threads(threads)
    for (int c = 0; c < chunks; ++c) scatter(c);
    return bins_;
}

}  // namespace sf
