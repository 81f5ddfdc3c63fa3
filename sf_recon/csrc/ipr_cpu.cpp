// SPDX-License-Identifier: Apache-2.0
// Second half of the rasteriser: each tile is drawn front to back into short lists of its pixels, until all are full.
#include "ipr_cpu.hpp"

#include <omp.h>

#include <cmath>

#include "ipr_bins.hpp"
#include "ipr_pixels.hpp"

namespace sf {
namespace {

constexpr int kBuckets = 256;
constexpr float kInfinity = std::numeric_limits<float>::infinity();
constexpr float kHole = std::numeric_limits<float>::quiet_NaN();

constexpr float kMinStep = 1e-5f;  // of the depth; pixels that show the same point differ by rounding only
constexpr float kMinSine = 1e-2f;  // of the angle between two differences that span a surface

inline float norm_of(const float* v) { return std::sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]); }

struct Item {  // a fragment to be sorted
    uint64_t key;     // bits of the depth (positive floats sort like their bits) above the row in the cloud
    uint32_t window;  // columns of the tile, one bit each | first row << 16 | last row << 24
    uint32_t local;   // number among the fragments of the tile

    bool operator<(const Item& o) const { return key < o.key; }
    float z() const { return from_bits(static_cast<int32_t>(key >> 32)); }
    uint64_t columns() const { return window & 0xffff; }
    int y0() const { return window >> 16 & 255; }
    int y1() const { return window >> 24; }
};

struct TileScratch {
    std::vector<uint32_t> windows;
    std::vector<int32_t> ids;    // rows in the cloud
    std::vector<float> splats;   // [fragments, 4] u, v, z, -1 / (sigma * half-width^2) along x
    std::vector<Item> items;
    std::vector<uint32_t> list;  // [k_ray, pixels] local numbers, front to back
    std::vector<float> weight;   // [k_ray, kTile] of one row of pixels
    int32_t next[kPixels];       // place of the next point in `list`
    int32_t count[kPixels];      // points of the first layer
    Pixels open;                 // whose list takes more points
    Pixels drawn, recent;        // that some point covers; that one covers since `recent_z`
    float recent_z, last_z;      // depth where that began, and of the last point

    void reserve(size_t n) {
        if (windows.size() >= n) return;
        windows.resize(n), ids.resize(n), items.resize(n);
        splats.resize(4 * n);
    }
};

// Fragments from number `first` on.
SF_SIMD void unpack(const RasterSpec& spec, const Fragment* fragments, size_t n, size_t first, int left, int top,
                    TileScratch& t) {
    const RasterSpec s = spec;
    const int right = std::min(left + kTile, s.width) - 1, bottom = std::min(top + kTile, s.height) - 1;
    uint32_t* windows = t.windows.data() + first;
    int32_t* ids = t.ids.data() + first;
    float* splats = t.splats.data() + 4 * first;
#pragma GCC ivdep
    for (size_t i = 0; i < n; ++i) {
        const float u = fragments[i].u, v = fragments[i].v, z = fragments[i].z;
        const float hx = half_width(s, s.fx, z), hy = half_width(s, s.fy, z);
        splats[4 * i] = u, splats[4 * i + 1] = v, splats[4 * i + 2] = z;
        splats[4 * i + 3] = -1.0f / (s.sigma * hx * hx);
        const int x0 = first_pixel(u, hx, left) - left, x1 = last_pixel(u, hx, right) - left;
        const int y0 = first_pixel(v, hy, top) - top, y1 = last_pixel(v, hy, bottom) - top;
        windows[i] = static_cast<uint32_t>((2 << x1) - (1 << x0) + (y0 << 16) + (y1 << 24));
        ids[i] = fragments[i].id;
    }
}

// Groups the fragments by depth into buckets begin[b]..begin[b + 1], nearest first; each is sorted only when needed.
// Returns how many buckets there are.
SF_INLINE int bucket_by_depth(size_t n, TileScratch& t, uint32_t* begin) {
    const int buckets = n < 48 ? 16 : n < 192 ? 64 : kBuckets;
    const float* z = t.splats.data() + 2;
    int32_t low = to_bits(z[0]), high = low;
    for (size_t i = 0; i < n; ++i) {
        const int32_t bits = to_bits(z[4 * i]);
        low = bits < low ? bits : low;
        high = bits > high ? bits : high;
    }
    int shift = 0;
    while ((high - low) >> shift >= buckets) ++shift;
    std::fill(begin, begin + buckets + 2, 0u);
    for (size_t i = 0; i < n; ++i) ++begin[((to_bits(z[4 * i]) - low) >> shift) + 2];
    for (int b = 2; b < buckets + 2; ++b) begin[b] += begin[b - 1];
    for (size_t i = 0; i < n; ++i) {
        const uint64_t bits = static_cast<uint64_t>(to_bits(z[4 * i]));
        t.items[begin[((static_cast<int32_t>(bits) - low) >> shift) + 1]++] = {
            bits << 32 | static_cast<uint32_t>(t.ids[i]), t.windows[i], static_cast<uint32_t>(i)};
    }
    return buckets;
}

// Pixels that a fragment covers among the four rows from row y on, which must not lie above it.
SF_INLINE uint64_t covered(const Item& item, int y) {
    const int rows = std::min(item.y1() - y, 3);
    return item.columns() * (0x0001000100010001ull >> (kTile * (3 - rows)));
}

// Leaves out the fragments that cover no open pixel; returns the end of the others.
SF_INLINE Item* keep_open(Item* first, Item* last, const TileScratch& t) {
    Item* kept = first;
    for (; first < last; ++first) {
        const Item item = *first;
        uint64_t open = t.open.rows(item.y0()) & covered(item, item.y0());
        for (int y = item.y0() + 4; y <= item.y1(); y += 4) open |= t.open.rows(y) & covered(item, y);
        *kept = item;
        kept += open != 0;
    }
    return kept;
}

// Closes lists that a point at depth z, and all behind it, cannot join: their last point lies `gap` or more before it.
// This saves work only, and does so after a while; resolve8 finds where a layer ends.
SF_INLINE void end_layers(float z, float gap, TileScratch& t) {
    const bool all = z - t.last_z >= gap;
    for (int i = 0; i < kPixels / 64; ++i) {
        t.open.word[i] &= ~(all ? t.drawn.word[i] | t.recent.word[i] : t.drawn.word[i] & ~t.recent.word[i]);
        t.drawn.word[i] |= t.recent.word[i];
        t.recent.word[i] = 0;
    }
    t.recent_z = z;
}

// One fragment into the lists of the pixels it covers that are still open.
SF_INLINE void draw(const Item& item, int end, float gap, TileScratch& t) {
    const float z = item.z();
    if (!(z - t.recent_z < gap)) end_layers(z, gap, t);
    t.last_z = z;
    uint32_t* list = t.list.data();
    for (int y = item.y0(); y <= item.y1(); y += 4) {
        const uint64_t taken = t.open.rows(y) & covered(item, y);
        uint64_t complete = 0;
        int32_t* next = t.next + kTile * y;
        for (uint64_t bits = taken; bits; bits &= bits - 1) {
            const int bit = __builtin_ctzll(bits), place = next[bit];
            list[place] = item.local;
            next[bit] = place + kPixels;
            complete |= static_cast<uint64_t>(place + kPixels >= end) << bit;
        }
        t.recent.add(y, taken);
        t.open.remove(y, complete);
    }
}

void insertion_sort(Item* first, Item* last) {
    for (Item* i = first + 1; i < last; ++i) {
        const Item item = *i;
        Item* j = i;
        for (; j > first && item < j[-1]; --j) *j = j[-1];
        *j = item;
    }
}

SF_SIMD void fill_lists(const RasterSpec& s, size_t n, int left, int top, TileScratch& t) {
    for (int p = 0; p < kPixels; ++p) t.next[p] = p;
    t.open = t.drawn = t.recent = Pixels();
    const uint64_t columns = (2ull << (std::min(kTile, s.width - left) - 1)) - 1;
    for (int row = 0; row < std::min(kTile, s.height - top); ++row) t.open.add(row, columns);
    if (n == 0) return;
    t.recent_z = -kInfinity, t.last_z = kInfinity;
    uint32_t begin[kBuckets + 2];
    const int buckets = bucket_by_depth(n, t, begin);
    for (int b = 0; b < buckets && t.open.any(); ++b) {
        Item *first = t.items.data() + begin[b], *last = t.items.data() + begin[b + 1];
        if (last - first > 1) last = keep_open(first, last, t);
        if (last - first > 24)
            std::sort(first, last);
        else if (last - first > 1)
            insertion_sort(first, last);
        for (; first < last; ++first) draw(*first, s.k_ray * kPixels, s.layer_gap, t);
    }
}

struct RowMeans {  // over the first layer of one row of pixels; `weight` is what turns a weight into its share
    float weight[kTile], x[kTile], y[kTile], z[kTile];
};

// Weighted means of the first layer for eight pixels of a row; `t.weight` keeps the weights before normalisation.
SF_INLINE void resolve8(const RasterSpec& s, float u, float v, int pixel, TileScratch& t, RowMeans& out) {
    const Int8 filled = *reinterpret_cast<const Int8*>(t.next + pixel) / kPixels;
    const Float8 centre = Float8{0, 1, 2, 3, 4, 5, 6, 7} + u;
    const bool square = s.fx == s.fy;
    const int most = *std::max_element(t.next + pixel, t.next + pixel + 8) / kPixels, column = pixel % kTile;
    Float8 sum_w{}, sum_x{}, sum_y{}, sum_z{}, last_z = Float8{} + kInfinity;
    Int8 count{}, used = count == 0;
    for (int c = 0; c < most; ++c) {
        const Int8 there = filled > c;
        const Int8 rows = 4 * *reinterpret_cast<const Int8*>(t.list.data() + c * kPixels + pixel) & there;
        Float8 splat[4];  // u, v, z, -1 / (sigma * half-width^2)
        gather8x4(t.splats.data(), rows, splat);
        const Float8 z = splat[2];
        used &= there & (z - last_z < s.layer_gap);
        count -= used;
        last_z = z;
        Float8 per_y2 = splat[3];
        if (!square) {
            Float8 half = s.radius * s.fy / z;
            half = half > 0.5f ? half : Float8{} + 0.5f;
            half = half < s.max_half ? half : Float8{} + s.max_half;
            per_y2 = -1.0f / (s.sigma * half * half);
        }
        const Float8 dx = centre - splat[0], dy = v - splat[1];
        const Float8 gauss = exp_negative(dx * dx * splat[3] + dy * dy * per_y2);
        const Float8 w = used ? gauss : Float8{};
        std::memcpy(t.weight.data() + c * kTile + column, &w, sizeof(w));
        const Float8 wz = w * z;
        sum_w += w;
        sum_z += wz;
        sum_x += wz * (splat[0] - s.cx);
        sum_y += wz * (splat[1] - s.cy);
    }
    std::memcpy(t.count + pixel, &count, sizeof(count));
    const Float8 scale = count > 0 ? 1.0f / sum_w : Float8{} + kHole;
    const Float8 means[4] = {sum_x * scale / s.fx, sum_y * scale / s.fy, sum_z * scale, scale};
    std::memcpy(out.x + column, &means[0], 32), std::memcpy(out.y + column, &means[1], 32);
    std::memcpy(out.z + column, &means[2], 32), std::memcpy(out.weight + column, &means[3], 32);
}

SF_SIMD void resolve_row(const RasterSpec& spec, int left, int row, int v, TileScratch& t, RowMeans& out) {
    const RasterSpec s = spec;
    for (int i = 0; i < kTile; i += 8)
        resolve8(s, static_cast<float>(left + i) + 0.5f, static_cast<float>(v) + 0.5f, row * kTile + i, t, out);
}

// Mean of the points' normals, each turned towards the camera.
void blend_normals(const RasterSpec& s, const float* normals, const TileScratch& t,
                   int pixel, float* out) {
    const float* R = s.rotation;
    float sum[3] = {0.0f, 0.0f, 0.0f}, total = 0.0f;
    for (int c = 0; c < t.count[pixel]; ++c) {
        const size_t local = t.list[c * kPixels + pixel];
        const float* splat = t.splats.data() + 4 * local;
        const float* n = normals + 3 * static_cast<size_t>(t.ids[local]);
        const float weight = t.weight[c * kTile + pixel % kTile];
        total += weight;
        float m[3];
        for (int a = 0; a < 3; ++a) m[a] = R[3 * a] * n[0] + R[3 * a + 1] * n[1] + R[3 * a + 2] * n[2];
        const float along = m[0] * (splat[0] - s.cx) / s.fx + m[1] * (splat[1] - s.cy) / s.fy + m[2];
        for (int a = 0; a < 3; ++a) sum[a] += (along > 0.0f ? -weight : weight) * m[a];
    }
    const float norm = norm_of(sum);
    for (int a = 0; a < 3; ++a) out[a] = norm > 1e-6f * total && total > 0.0f ? sum[a] / norm : kHole;
}

void write_row(const RasterSpec& s, const float* normals, int row, size_t at, int width,
               const TileScratch& t, const RowMeans& means, const RasterImages& out) {
    std::copy(means.z, means.z + width, out.depth + at);
    for (int i = 0; i < width && out.position; ++i) {
        float* p = out.position + 3 * (at + i);
        p[0] = means.x[i], p[1] = means.y[i], p[2] = means.z[i];
    }
    const size_t k = s.k_ray;
    for (int i = 0; i < width && (out.index || out.weight); ++i) {
        const size_t count = t.count[row * kTile + i];
        const uint32_t* list = t.list.data() + row * kTile + i;
        for (size_t c = 0; c < k && out.index; ++c)
            out.index[(at + i) * k + c] = c < count ? t.ids[list[c * kPixels]] : -1;
        for (size_t c = 0; c < k && out.weight; ++c)
            out.weight[(at + i) * k + c] = c < count ? t.weight[c * kTile + i] * means.weight[i] : 0.0f;
    }
    for (int i = 0; i < width && out.normal && normals; ++i)
        blend_normals(s, normals, t, row * kTile + i, out.normal + 3 * (at + i));
}

void draw_tile(const RasterSpec& s, const float* normals, const Binner& bins, int tile, TileScratch& t,
               const RasterImages& out) {
    const int left = tile % bins.tiles_x() * kTile, top = tile / bins.tiles_x() * kTile;
    t.reserve(bins.count(tile));
    size_t n = 0;
    bins.each_lot(tile, [&](const Fragment* fragments, size_t count) {
        unpack(s, fragments, count, n, left, top, t);
        n += count;
    });
    fill_lists(s, n, left, top, t);
    for (int v = top; v < std::min(top + kTile, s.height); ++v) {
        RowMeans sums;
        resolve_row(s, left, v - top, v, t, sums);
        write_row(s, normals, v - top, static_cast<size_t>(v) * s.width + left,
                  std::min(kTile, s.width - left), t, sums, out);
    }
}

}  // namespace

void rasterize(const float* points, const float* normals, size_t n, const RasterSpec& s, const RasterImages& wanted) {
    const int threads = s.threads > 0 ? s.threads : omp_get_max_threads();
    thread_local Binner own;  // a render loop does not pay for fresh memory in every frame
    Binner& bins = own;  // the team of threads below has none of its own
    bins.bin(points, n, s, threads);
    RasterImages out = wanted;
    std::unique_ptr<float[]> position;
    if (out.normal && !normals && !out.position) {
        position.reset(new float[3 * static_cast<size_t>(s.width) * s.height]);
        out.position = position.get();
    }
#pragma omp parallel num_threads(threads)
    {
        TileScratch scratch;
        scratch.list.resize(static_cast<size_t>(s.k_ray) * kPixels);
        scratch.weight.resize(static_cast<size_t>(s.k_ray) * kTile);
#pragma omp for schedule(dynamic, 8)
        for (int tile = 0; tile < bins.tiles(); ++tile) draw_tile(s, normals, bins, tile, scratch, out);
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
            const float norm = norm_of(n);
            const float across = norm_of(x), down = norm_of(y);
            const bool sound = std::min(across, down) > kMinStep * p[2] && norm > kMinSine * across * down;
            float* out = normal + 3 * (static_cast<size_t>(v) * width + u);
            for (int c = 0; c < 3; ++c) out[c] = sound ? n[c] / norm : kHole;
        }
}

}  // namespace sf
