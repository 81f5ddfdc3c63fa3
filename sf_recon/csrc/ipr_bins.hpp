// SPDX-License-Identifier: Apache-2.0
// First half of the rasteriser: points are projected, culled and binned into square tiles of the image.
#pragma once
#include <algorithm>
#include <limits>
#include <memory>
#include <vector>

#include "ipr_window.hpp"
#include "simd.hpp"

namespace sf {

struct Fragment {  // a visible point: continuous pixel, depth, row in the cloud
    float u, v, z;
    int32_t id;
};

struct Visible {
    Fragment fragment;
    Window tiles;  // that it touches
};

// What one thread has found, by tile, in lots of equal size. Points are written once, without counting them first.
class Lots {
   public:
    void clear(size_t tiles);

    void add(size_t tile, const Fragment& fragment) {
        Fragment*& end = end_[tile];
        if (reinterpret_cast<uintptr_t>(end) % sizeof(Lot) == 0) end = fresh(tile);  // full, or none yet
        *end++ = fragment;
    }

    // Calls `take(fragments, count)` for each lot of a tile, in any order.
    template <class F>
    void each(size_t tile, const F& take) const {
        for (int32_t lot = newest_[tile]; lot >= 0; lot = before_[lot]) {
            if (before_[lot] >= 0)
                for (size_t i = 0; i < kLot; i += 4) __builtin_prefetch(at(before_[lot]) + i);
            take(at(lot), lot == newest_[tile] ? static_cast<size_t>(end_[tile] - at(lot)) : kLot);
        }
    }

    size_t count(size_t tile) const {
        size_t n = 0;
        each(tile, [&](const Fragment*, size_t count) { n += count; });
        return n;
    }

   private:
    static constexpr size_t kLot = 64, kPage = 256;
    struct alignas(kLot * sizeof(Fragment)) Lot {
        Fragment fragments[kLot];
    };

    Fragment* fresh(size_t tile);
    const Fragment* at(int32_t lot) const { return pages_[lot / kPage][lot % kPage].fragments; }

    std::vector<std::unique_ptr<Lot[]>> pages_;  // kept from frame to frame
    std::vector<int32_t> before_;                // the lot before each in its tile, or -1
    std::vector<int32_t> newest_;                // [tiles] lot, or -1
    std::vector<Fragment*> end_;                 // [tiles] where the next fragment goes
};

// Memory that a thread keeps from frame to frame.
class Binner {
   public:
    void bin(const float* points, size_t n, const RasterSpec& spec, int threads);
    int tiles_x() const { return tiles_x_; }
    int tiles() const { return tiles_x_ * tiles_y_; }

    size_t count(int tile) const {
        size_t n = 0;
        for (const Worker& worker : workers_) n += worker.lots.count(tile);
        return n;
    }

    template <class F>
    void each_lot(int tile, const F& take) const {
        for (const Worker& worker : workers_) worker.lots.each(tile, take);
    }

   private:
    struct Worker {  // of one thread
        Lots lots;
        std::vector<Visible> wide;  // set aside: each may cover a whole tile
    };

    void add(const Fragment& fragment, const Window& tiles, Lots& lots) const {
        for (int ty = tiles.y0; ty <= tiles.y1; ++ty)
            for (int tx = tiles.x0; tx <= tiles.x1; ++tx) lots.add(ty * tiles_x_ + tx, fragment);
    }
    void project(const float* points, size_t first, size_t last, const RasterSpec& s, Worker& worker) const;
    void bound_tiles(const RasterSpec& s);
    void add_wide(Worker& worker) const;

    int tiles_x_ = 0, tiles_y_ = 0;
    std::vector<Worker> workers_;
    std::vector<float> bound_;  // [tiles] no wide point behind it can be drawn
};

}  // namespace sf
