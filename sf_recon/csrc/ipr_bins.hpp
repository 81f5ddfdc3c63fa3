// SPDX-License-Identifier: Apache-2.0
// First half of the rasteriser: points are projected, culled and binned into square tiles of the image.
#pragma once
#include <algorithm>
#include <limits>
#include <memory>
#include <vector>

#include "ipr_cpu.hpp"
#include "simd.hpp"

namespace sf {

constexpr int kTile = 16;  // px

struct Fragment {  // a visible point: continuous pixel, depth, row in the cloud
    float u, v, z;
    int32_t id;
};

struct Bins {
    std::unique_ptr<Fragment[]> fragments;  // grouped by tile, in any order within a tile
    size_t capacity = 0;
    std::vector<size_t> begin;  // [tiles + 1]
    int tiles_x = 0, tiles_y = 0;
};

SF_INLINE float half_width(const RasterSpec& s, float focal, float z) {
    const float half = s.radius * focal / z;
    const float wide = half > 0.5f ? half : 0.5f;
    return wide < s.max_half ? wide : s.max_half;
}

// Pixels whose centre lies within `half` of `centre`, clipped to low..high; empty when first > last. The argument must
// be of a size that fits an int. No call to floor: baseline x86-64 has no instruction for it.
SF_INLINE int first_pixel(float centre, float half, int low) {
    const float edge = centre - half - 0.5f;
    const int cut = static_cast<int>(edge), first = cut + (static_cast<float>(cut) < edge);
    return first > low ? first : low;
}

SF_INLINE int last_pixel(float centre, float half, int high) {
    const float edge = centre + half - 0.5f;
    const int cut = static_cast<int>(edge), last = cut - (static_cast<float>(cut) > edge);
    return last < high ? last : high;
}

// Memory that a thread keeps from frame to frame.
class Binner {
   public:
    const Bins& bin(const float* points, size_t n, const RasterSpec& spec, int threads);

   private:
    struct Visible {
        Fragment fragment;
        uint16_t x0, x1, y0, y1;  // tiles, inclusive
    };

    void project(const float* points, size_t first, size_t last, const RasterSpec& s, int chunk);
    void count(int chunk);
    bool bound_tiles(const RasterSpec& s, int chunks);
    size_t place(int chunks);
    void scatter(int chunk);

    Bins bins_;
    std::unique_ptr<Visible[]> visible_;
    size_t capacity_ = 0;
    std::vector<size_t> first_, found_;  // of the visible points of each chunk
    std::vector<size_t> offset_;         // [chunks, tiles] counts, then write positions
    std::vector<uint8_t> covers_;        // per chunk: some point covers a whole tile
    std::vector<float> bound_;           // [tiles] nothing behind it can be drawn
};

}  // namespace sf
