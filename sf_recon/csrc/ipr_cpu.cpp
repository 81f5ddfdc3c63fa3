// SPDX-License-Identifier: Apache-2.0
// Second half of the rasteriser: each tile is drawn front to back into short lists of its pixels, until all are full.
#include "ipr_cpu.hpp"

#include <omp.h>

#include <cmath>

#include "ipr_bins.hpp"

namespace sf {
namespace {

constexpr int kPixels = kTile * kTile, kBuckets = 256;
constexpr float kInfinity = std::numeric_limits<float>::infinity();
constexpr int32_t kClosed = static_cast<int32_t>(0xff800000u);  // bits of -inf
constexpr float kHole = std::numeric_limits<float>::quiet_NaN();

struct Item {  // a fragment to be sorted
    uint64_t key;     // bits of the depth (positive floats sort like their bits) above the row in the cloud
    uint32_t window;  // x0 | x1 << 8 | y0 << 16 | y1 << 24, pixels of the tile
    uint32_t local;   // number among the fragments of the tile

    bool operator<(const Item& o) const { return key < o.key; }
    float z() const { return from_bits(static_cast<int32_t>(key >> 32)); }
};

struct TileScratch {
    std::vector<uint32_t> windows;
    std::vector<float> u, v, z, per_x2, per_y2;  // of the fragments: pixel, depth, -1 / (sigma * half-width^2)
    std::vector<Item> items;
    std::vector<uint32_t> list;  // [k_ray + 1, pixels] local numbers, front to back; the last row takes what is too much
    std::vector<float> weight;   // [k_ray, kTile] of one row of pixels
    int32_t count[kPixels];
    int32_t last_z[kPixels];  // bits of the last point's depth; inf before the first, -inf once the layer is closed

    void reserve(size_t n) {
        if (windows.size() >= n) return;
        windows.resize(n), items.resize(n);
        for (auto* values : {&u, &v, &z, &per_x2, &per_y2}) values->resize(n);
    }
};

SF_INLINE void unpack(const RasterSpec& spec, const Fragment* fragments, size_t n, int left, int top, TileScratch& t) {
    const RasterSpec s = spec;
    const int right = std::min(left + kTile, s.width) - 1, bottom = std::min(top + kTile, s.height) - 1;
    uint32_t* windows = t.windows.data();
    float *u = t.u.data(), *v = t.v.data(), *z = t.z.data(), *per_x2 = t.per_x2.data(), *per_y2 = t.per_y2.data();
#pragma GCC ivdep
    for (size_t i = 0; i < n; ++i) {
        u[i] = fragments[i].u, v[i] = fragments[i].v, z[i] = fragments[i].z;
        const float hx = half_width(s, s.fx, z[i]), hy = half_width(s, s.fy, z[i]);
        per_x2[i] = -1.0f / (s.sigma * hx * hx), per_y2[i] = -1.0f / (s.sigma * hy * hy);
        const int x0 = first_pixel(u[i], hx, left) - left, x1 = last_pixel(u[i], hx, right) - left;
        const int y0 = first_pixel(v[i], hy, top) - top, y1 = last_pixel(v[i], hy, bottom) - top;
        windows[i] = static_cast<uint32_t>(x0 | x1 << 8 | y0 << 16 | y1 << 24);
    }
}

// Groups the fragments by depth into buckets begin[b]..begin[b + 1], nearest first; each is sorted only when needed.
SF_INLINE void bucket_by_depth(const Fragment* fragments, size_t n, TileScratch& t, uint32_t* begin) {
    int32_t low = to_bits(fragments[0].z), high = low;
    for (size_t i = 0; i < n; ++i) {
        const int32_t bits = to_bits(fragments[i].z);
        low = bits < low ? bits : low;
        high = bits > high ? bits : high;
    }
    int shift = 0;
    while ((high - low) >> shift >= kBuckets) ++shift;
    std::fill(begin, begin + kBuckets + 2, 0u);
    for (size_t i = 0; i < n; ++i) ++begin[((to_bits(fragments[i].z) - low) >> shift) + 2];
    for (int b = 2; b < kBuckets + 2; ++b) begin[b] += begin[b - 1];
    for (size_t i = 0; i < n; ++i) {
        const uint64_t bits = static_cast<uint64_t>(to_bits(fragments[i].z));
        t.items[begin[((static_cast<int32_t>(bits) - low) >> shift) + 1]++] = {
            bits << 32 | static_cast<uint32_t>(fragments[i].id), t.windows[i], static_cast<uint32_t>(i)};
    }
}

// One fragment into the lists of the pixels it covers; returns how many of them it closes. Free of branches.
SF_INLINE int draw(const Item& item, int k, float gap, TileScratch& t) {
    const int x0 = item.window & 255, x1 = item.window >> 8 & 255;
    const int y0 = item.window >> 16 & 255, y1 = item.window >> 24;
    const float z = item.z();
    const int32_t bits = to_bits(z);
    int closed = 0;
    for (int j = y0; j <= y1; ++j)
        for (int p = j * kTile + x0; p <= j * kTile + x1; ++p) {
            const int32_t last = t.last_z[p], count = t.count[p];
            const int32_t taken = z - from_bits(last) < gap;
            const int32_t open = taken & (count + 1 < k), mask = -open;
            t.list[static_cast<size_t>(count * kPixels + p)] = item.local;
            t.count[p] = count + taken;
            t.last_z[p] = (bits & mask) | (kClosed & ~mask);
            closed += (last != kClosed) & ~open;
        }
    return closed;
}

void insertion_sort(Item* first, Item* last) {
    for (Item* i = first + 1; i < last; ++i) {
        const Item item = *i;
        Item* j = i;
        for (; j > first && item < j[-1]; --j) *j = j[-1];
        *j = item;
    }
}

SF_SIMD void fill_lists(const RasterSpec& s, const Fragment* fragments, size_t n, int left, int top, TileScratch& t) {
    std::fill(t.count, t.count + kPixels, 0);
    std::fill(t.last_z, t.last_z + kPixels, to_bits(kInfinity));
    if (n == 0) return;
    t.reserve(n);
    unpack(s, fragments, n, left, top, t);
    uint32_t begin[kBuckets + 2];
    bucket_by_depth(fragments, n, t, begin);
    int open = std::min(kTile, s.width - left) * std::min(kTile, s.height - top);
    for (int b = 0; b < kBuckets && open > 0; ++b) {
        Item *first = t.items.data() + begin[b], *last = t.items.data() + begin[b + 1];
        if (last - first > 24)
            std::sort(first, last);
        else if (last - first > 1)
            insertion_sort(first, last);
        for (; first < last && open > 0; ++first) open -= draw(*first, s.k_ray, s.layer_gap, t);
    }
}

struct RowMeans {  // over the first layer of one row of pixels; `weight` is what turns a weight into its share
    float weight[kTile], x[kTile], y[kTile], z[kTile];
};

// Weighted mean of the first layer for a row of the tile; `t.weight` keeps the weights before normalisation.
SF_SIMD void resolve_row(const RasterSpec& s, int left, int row, int v, TileScratch& t, RowMeans& out) {
    const int32_t* count = t.count + row * kTile;
    const float cx = s.cx, cy = s.cy, py = static_cast<float>(v) + 0.5f;
    const int most = *std::max_element(count, count + kTile);
    float sum_w[kTile] = {}, sum_x[kTile] = {}, sum_y[kTile] = {}, sum_z[kTile] = {}, px[kTile];
    for (int i = 0; i < kTile; ++i) px[i] = static_cast<float>(left + i) + 0.5f;
    for (int c = 0; c < most; ++c) {
        const uint32_t* list = t.list.data() + c * kPixels + row * kTile;
        float* weight = t.weight.data() + c * kTile;
        float u[kTile], w[kTile], z[kTile], y[kTile], ax[kTile], ay[kTile];
        uint32_t at[kTile];
        for (int i = 0; i < kTile; ++i) at[i] = c < count[i] ? list[i] : 0;
        for (int i = 0; i < kTile; ++i) u[i] = t.u[at[i]], y[i] = t.v[at[i]], z[i] = t.z[at[i]];
        for (int i = 0; i < kTile; ++i) ax[i] = t.per_x2[at[i]], ay[i] = t.per_y2[at[i]];
        for (int i = 0; i < kTile; ++i) {
            const float dx = px[i] - u[i], dy = py - y[i];
            w[i] = c < count[i] ? exp_negative(dx * dx * ax[i] + dy * dy * ay[i]) : 0.0f;
            sum_w[i] += w[i];
            sum_z[i] += w[i] * z[i];
            sum_x[i] += w[i] * (u[i] - cx) * z[i];
            sum_y[i] += w[i] * (y[i] - cy) * z[i];
        }
        std::memcpy(weight, w, sizeof(w));
    }
    for (int i = 0; i < kTile; ++i) {
        const float scale = count[i] > 0 ? 1.0f / sum_w[i] : kHole;
        out.x[i] = sum_x[i] * (scale / s.fx), out.y[i] = sum_y[i] * (scale / s.fy);
        out.z[i] = sum_z[i] * scale, out.weight[i] = scale;
    }
}

// Mean of the points' normals, each turned towards the camera.
void blend_normals(const RasterSpec& s, const float* normals, const int32_t* index, const float* weight, int count,
                   const float* position, float* out) {
    const float* R = s.rotation;
    float sum[3] = {0.0f, 0.0f, 0.0f};
    for (int c = 0; c < count; ++c) {
        const float* n = normals + 3 * static_cast<size_t>(index[c]);
        float m[3];
        for (int a = 0; a < 3; ++a) m[a] = R[3 * a] * n[0] + R[3 * a + 1] * n[1] + R[3 * a + 2] * n[2];
        const float towards = m[0] * position[0] + m[1] * position[1] + m[2] * position[2] > 0.0f ? -1.0f : 1.0f;
        for (int a = 0; a < 3; ++a) sum[a] += towards * weight[c] * m[a];
    }
    const float norm = std::sqrt(sum[0] * sum[0] + sum[1] * sum[1] + sum[2] * sum[2]);
    for (int a = 0; a < 3; ++a) out[a] = norm > 1e-6f ? sum[a] / norm : kHole;
}

void write_row(const RasterSpec& s, const float* normals, const Fragment* fragments, int row, size_t at, int width,
               const TileScratch& t, const RowMeans& sums, const RasterImages& out) {
    std::copy(sums.z, sums.z + width, out.depth + at);
    for (int i = 0; i < width && out.position; ++i) {
        float* p = out.position + 3 * (at + i);
        p[0] = sums.x[i], p[1] = sums.y[i], p[2] = sums.z[i];
    }
    if (!out.index && !out.weight && !(out.normal && normals)) return;
    std::vector<int32_t> ids(s.k_ray);
    std::vector<float> weights(s.k_ray);
    for (int i = 0; i < width; ++i) {
        const int count = t.count[row * kTile + i];
        for (int c = 0; c < s.k_ray; ++c) {
            ids[c] = c < count ? fragments[t.list[c * kPixels + row * kTile + i]].id : -1;
            weights[c] = c < count ? t.weight[c * kTile + i] * sums.weight[i] : 0.0f;
        }
        if (out.index) std::copy(ids.begin(), ids.end(), out.index + (at + i) * s.k_ray);
        if (out.weight) std::copy(weights.begin(), weights.end(), out.weight + (at + i) * s.k_ray);
        if (!out.normal || !normals) continue;
        const float position[3] = {sums.x[i], sums.y[i], sums.z[i]};
        blend_normals(s, normals, ids.data(), weights.data(), count, position, out.normal + 3 * (at + i));
    }
}

void draw_tile(const RasterSpec& s, const float* normals, const Bins& bins, int tile, TileScratch& t,
               const RasterImages& out) {
    const int left = tile % bins.tiles_x * kTile, top = tile / bins.tiles_x * kTile;
    const Fragment* fragments = bins.fragments.get() + bins.begin[tile];
    fill_lists(s, fragments, bins.begin[tile + 1] - bins.begin[tile], left, top, t);
    for (int v = top; v < std::min(top + kTile, s.height); ++v) {
        RowMeans sums;
        resolve_row(s, left, v - top, v, t, sums);
        write_row(s, normals, fragments, v - top, static_cast<size_t>(v) * s.width + left,
                  std::min(kTile, s.width - left), t, sums, out);
    }
}

}  // namespace

void rasterize(const float* points, const float* normals, size_t n, const RasterSpec& s, const RasterImages& wanted) {
    const int threads = s.threads > 0 ? s.threads : omp_get_max_threads();
    thread_local Binner binner;  // a render loop does not pay for fresh memory in every frame
    const Bins& bins = binner.bin(points, n, s, threads);
    RasterImages out = wanted;
    std::unique_ptr<float[]> position;
    if (out.normal && !normals && !out.position) {
        position.reset(new float[3 * static_cast<size_t>(s.width) * s.height]);
        out.position = position.get();
    }
#pragma omp parallel num_threads(threads)
    {
        TileScratch scratch;
        scratch.list.resize(static_cast<size_t>(s.k_ray + 1) * kPixels);
        scratch.weight.resize(static_cast<size_t>(s.k_ray) * kTile);
#pragma omp for schedule(dynamic, 8)
        for (int tile = 0; tile < bins.tiles_x * bins.tiles_y; ++tile) draw_tile(s, normals, bins, tile, scratch, out);
    }
    if (out.normal && !normals) normals_of(out.position, s.width, s.height, s.layer_gap, threads, out.normal);
}

void normals_of(const float* position, int width, int height, float layer_gap, int threads, float* normal) {
    const auto at = [&](int u, int v) { return position + 3 * (static_cast<size_t>(v) * width + u); };
#pragma omp parallel for num_threads(threads)
    for (int v = 0; v < height; ++v)
        for (int u = 0; u < width; ++u) {
            const float* p = at(u, v);
            const auto same_layer = [&](int i, int j) {  // the neighbour, or the pixel itself
                if (i < 0 || j < 0 || i >= width || j >= height) return p;
                return std::abs(at(i, j)[2] - p[2]) < layer_gap ? at(i, j) : p;
            };
            const float *l = same_layer(u - 1, v), *r = same_layer(u + 1, v);
            const float *a = same_layer(u, v - 1), *b = same_layer(u, v + 1);
            const float x[3] = {r[0] - l[0], r[1] - l[1], r[2] - l[2]}, y[3] = {b[0] - a[0], b[1] - a[1], b[2] - a[2]};
            float n[3] = {y[1] * x[2] - y[2] * x[1], y[2] * x[0] - y[0] * x[2], y[0] * x[1] - y[1] * x[0]};
            const float norm = std::sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]);
            float* out = normal + 3 * (static_cast<size_t>(v) * width + u);
            for (int c = 0; c < 3; ++c) out[c] = norm > 0.0f ? n[c] / norm : kHole;
        }
}

}  // namespace sf
