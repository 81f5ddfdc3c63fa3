// SPDX-License-Identifier: Apache-2.0
// Sets of pixels of one tile of the rasteriser.
#pragma once
#include "ipr_window.hpp"

namespace sf {

constexpr int kPixels = kTile * kTile;  // of a tile

// One bit for each pixel of the tile, four rows a word; a word to spare.
struct Pixels {
    uint64_t word[kPixels / 64 + 1] = {};

    bool any() const { return word[0] | word[1] | word[2] | word[3]; }
    // Four rows from row y on.
    uint64_t rows(int y) const {
        const int shift = kTile * (y % 4);
        return word[y / 4] >> shift | word[y / 4 + 1] << 1 << (63 - shift);
    }
    void add(int y, uint64_t rows) {
        const int shift = kTile * (y % 4);
        word[y / 4] |= rows << shift, word[y / 4 + 1] |= rows >> 1 >> (63 - shift);
    }
    void remove(int y, uint64_t rows) {
        const int shift = kTile * (y % 4);
        word[y / 4] &= ~(rows << shift), word[y / 4 + 1] &= ~(rows >> 1 >> (63 - shift));
    }
};

}  // namespace sf
