// SPDX-License-Identifier: Apache-2.0
// Points are culled, binned into square tiles by a counting sort whose order does not depend on the number of threads,
// and each tile is drawn front to back, so that K nearest, first layer and weighted mean need no per-pixel list.
#include "ipr_cpu.hpp"

#include <omp.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <memory>
#include <vector>

namespace sf {
namespace {

constexpr int kTile = 16;    // px
constexpr int kChunks = 64;  // fixed: the order of fragments must not follow the number of threads

struct Fragment {  // a visible point: continuous pixel, depth
    float u, v, z;
};

struct Window {  // covered pixels, inclusive, inside the image; empty when x1 < x0 or y1 < y0
    int x0, x1, y0, y1;
};

inline float half_width(const RasterSpec& s, float focal, float z) {
    return std::min(std::max(s.radius * focal / z, 0.5f), s.max_half);
}

inline Window window_of(const RasterSpec& s, const Fragment& f) {
    const float hx = half_width(s, s.fx, f.z), hy = half_width(s, s.fy, f.z);
    Window w;
    w.x0 = std::max(0, static_cast<int>(std::ceil(f.u - hx - 0.5f)));
    w.x1 = std::min(s.width - 1, static_cast<int>(std::floor(f.u + hx - 0.5f)));
    w.y0 = std::max(0, static_cast<int>(std::ceil(f.v - hy - 0.5f)));
    w.y1 = std::min(s.height - 1, static_cast<int>(std::floor(f.v + hy - 0.5f)));
    return w;
}

// Camera coordinates and projection; false for a point that touches no pixel.
inline bool project(const RasterSpec& s, const float* p, Fragment& f) {
    const float* R = s.rotation;
    f.z = R[6] * p[0] + R[7] * p[1] + R[8] * p[2] + s.translation[2];
    if (!(f.z >= s.near && f.z < std::numeric_limits<float>::infinity())) return false;
    f.u = s.fx * (R[0] * p[0] + R[1] * p[1] + R[2] * p[2] + s.translation[0]) / f.z + s.cx;
    f.v = s.fy * (R[3] * p[0] + R[4] * p[1] + R[5] * p[2] + s.translation[1]) / f.z + s.cy;
    const float mx = s.max_half + 1.0f;  // reject before any conversion to int can overflow
    return f.u > -mx && f.u < s.width + mx && f.v > -mx && f.v < s.height + mx;
}

struct Bins {
    std::unique_ptr<Fragment[]> fragments;  // grouped by tile, in point order within a tile
    std::vector<size_t> begin;              // [tiles + 1]
};

template <class Visit>
inline void for_tiles(const Window& w, int tiles_x, Visit visit) {
    for (int ty = w.y0 / kTile; ty <= w.y1 / kTile; ++ty)
        for (int tx = w.x0 / kTile; tx <= w.x1 / kTile; ++tx) visit(ty * tiles_x + tx);
}

Bins bin_points(const float* points, size_t n, const RasterSpec& s, int tiles_x, int tiles, int threads) {
    std::unique_ptr<Fragment[]> visible(new Fragment[n]);
    std::vector<size_t> found(kChunks);
    std::vector<size_t> offset(static_cast<size_t>(kChunks) * tiles);  // counts first, then write positions
    const auto first = [&](int chunk) { return n * chunk / kChunks; };
#pragma omp parallel for schedule(dynamic, 1) num_threads(threads)
    for (int c = 0; c < kChunks; ++c) {
        Fragment* out = visible.get() + first(c);
        for (size_t i = first(c); i < first(c + 1); ++i) {
            if (!project(s, points + 3 * i, *out)) continue;
            const Window w = window_of(s, *out);
            if (w.x1 < w.x0 || w.y1 < w.y0) continue;
            for_tiles(w, tiles_x, [&](int tile) { ++offset[static_cast<size_t>(c) * tiles + tile]; });
            ++out;
        }
        found[c] = out - (visible.get() + first(c));
    }
    Bins bins;
    bins.begin.resize(tiles + 1);
    size_t total = 0;
    for (int tile = 0; tile < tiles; ++tile) {
        bins.begin[tile] = total;
        for (int c = 0; c < kChunks; ++c) {
            size_t& slot = offset[static_cast<size_t>(c) * tiles + tile];
            const size_t count = slot;
            slot = total;
            total += count;
        }
    }
    bins.begin[tiles] = total;
    bins.fragments.reset(new Fragment[total]);
#pragma omp parallel for schedule(dynamic, 1) num_threads(threads)
    for (int c = 0; c < kChunks; ++c) {
        size_t* write = offset.data() + static_cast<size_t>(c) * tiles;
        for (size_t i = 0; i < found[c]; ++i) {
            const Fragment& f = visible[first(c) + i];
            for_tiles(window_of(s, f), tiles_x, [&](int tile) { bins.fragments[write[tile]++] = f; });
        }
    }
    return bins;
}

struct Pixel {  // running sums over the first layer
    float last_z, weight, z, x, y;
    int count;  // k_ray once the layer is closed
};

// One fragment into the pixels of its window that lie in the tile at (left, top).
inline void draw(const RasterSpec& s, const Fragment& f, int left, int top, Pixel* pixels) {
    const Window w = window_of(s, f);
    const float hx = half_width(s, s.fx, f.z), hy = half_width(s, s.fy, f.z);
    const float x = (f.u - s.cx) / s.fx * f.z, y = (f.v - s.cy) / s.fy * f.z;
    const int x0 = std::max(w.x0, left), x1 = std::min(w.x1, left + kTile - 1);
    const int y0 = std::max(w.y0, top), y1 = std::min(w.y1, top + kTile - 1);
    float column[kTile];  // the Gaussian is separable: one exp per column and row, not per pixel
    for (int i = x0; i <= x1; ++i) {
        const float q = (i + 0.5f - f.u) / hx;
        column[i - left] = std::exp(-q * q / s.sigma);
    }
    for (int j = y0; j <= y1; ++j) {
        const float q = (j + 0.5f - f.v) / hy;
        const float row = std::exp(-q * q / s.sigma);
        for (int i = x0; i <= x1; ++i) {
            Pixel& pixel = pixels[(j - top) * kTile + i - left];
            if (pixel.count == s.k_ray) continue;
            if (pixel.count > 0 && f.z - pixel.last_z >= s.layer_gap) {
                pixel.count = s.k_ray;
                continue;
            }
            const float weight = row * column[i - left];
            pixel.last_z = f.z;
            pixel.weight += weight;
            pixel.z += weight * f.z;
            pixel.x += weight * x;
            pixel.y += weight * y;
            ++pixel.count;
        }
    }
}

void draw_tile(const RasterSpec& s, const Fragment* fragments, size_t n, int left, int top,
               std::vector<uint64_t>& order, float* depth, float* position) {
    order.resize(n);
    for (size_t i = 0; i < n; ++i) {  // bits of a positive float sort like the float; the index breaks ties
        uint32_t bits;
        std::memcpy(&bits, &fragments[i].z, 4);
        order[i] = static_cast<uint64_t>(bits) << 32 | i;
    }
    std::sort(order.begin(), order.end());
    Pixel pixels[kTile * kTile] = {};
    for (const uint64_t key : order) draw(s, fragments[key & 0xffffffffu], left, top, pixels);
    const float hole = std::numeric_limits<float>::quiet_NaN();
    for (int j = top; j < std::min(top + kTile, s.height); ++j)
        for (int i = left; i < std::min(left + kTile, s.width); ++i) {
            const Pixel& p = pixels[(j - top) * kTile + i - left];
            const size_t at = static_cast<size_t>(j) * s.width + i;
            const bool hit = p.weight > 0.0f;
            depth[at] = hit ? p.z / p.weight : hole;
            if (position == nullptr) continue;
            position[3 * at] = hit ? p.x / p.weight : hole;
            position[3 * at + 1] = hit ? p.y / p.weight : hole;
            position[3 * at + 2] = depth[at];
        }
}

}  // namespace

void rasterize(const float* points, size_t n, const RasterSpec& s, float* depth, float* position) {
    const int threads = s.threads > 0 ? s.threads : omp_get_max_threads();
    const int tiles_x = (s.width + kTile - 1) / kTile, tiles_y = (s.height + kTile - 1) / kTile;
    const Bins bins = bin_points(points, n, s, tiles_x, tiles_x * tiles_y, threads);
#pragma omp parallel num_threads(threads)
    {
        std::vector<uint64_t> order;
#pragma omp for schedule(dynamic, 8)
        for (int tile = 0; tile < tiles_x * tiles_y; ++tile)
            draw_tile(s, bins.fragments.get() + bins.begin[tile], bins.begin[tile + 1] - bins.begin[tile],
                      tile % tiles_x * kTile, tile / tiles_x * kTile, order, depth, position);
    }
}

}  // namespace sf
