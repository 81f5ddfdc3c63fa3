// SPDX-License-Identifier: Apache-2.0
// Integer cells of space and an open-addressing hash table from a cell to a dense index.
#pragma once
#include <cmath>
#include <cstdint>
#include <stdexcept>
#include <vector>

namespace sf {

struct Cell {
    int32_t x, y, z;
};

constexpr int32_t kCellLimit = 1 << 20;  // 21 bits per axis in a key

inline int32_t cell_of(float coordinate, float inverse_size) {
    const float c = std::floor(coordinate * inverse_size);
    if (!(c > -kCellLimit && c < kCellLimit))
        throw std::out_of_range("a point is not finite or lies too far from the origin for this resolution");
    return static_cast<int32_t>(c);
}

inline Cell cell_of(const float* p, float inverse_size) {
    return {cell_of(p[0], inverse_size), cell_of(p[1], inverse_size), cell_of(p[2], inverse_size)};
}

class CellMap {
   public:
    CellMap() : slots_(1024) {}

    int32_t find(Cell cell) const {
        const uint64_t key = pack(cell);
        for (size_t i = mix(key) & (slots_.size() - 1);; i = (i + 1) & (slots_.size() - 1)) {
            if (slots_[i].index < 0) return -1;
            if (slots_[i].key == key) return slots_[i].index;
        }
    }

    // Index of the cell; a new cell gets the next free index (= size() before the call).
    int32_t insert(Cell cell) {
        if (2 * (count_ + 1) > slots_.size()) grow();
        Slot& slot = place(pack(cell));
        if (slot.index < 0) {
            slot.key = pack(cell);
            slot.index = static_cast<int32_t>(count_++);
        }
        return slot.index;
    }

    size_t size() const { return count_; }
    size_t nbytes() const { return slots_.capacity() * sizeof(Slot); }

   private:
    struct Slot {
        uint64_t key = 0;
        int32_t index = -1;
    };

    static uint64_t pack(Cell c) {
        const auto part = [](int32_t v) { return static_cast<uint64_t>(v + kCellLimit) & 0x1fffff; };
        return part(c.x) << 42 | part(c.y) << 21 | part(c.z);
    }

    static uint64_t mix(uint64_t key) {  // multiply-xorshift: neighbouring cells land far apart
        key *= 0x9e3779b97f4a7c15ull;
        return key ^ (key >> 29);
    }

    Slot& place(uint64_t key) {
        size_t i = mix(key) & (slots_.size() - 1);
        while (slots_[i].index >= 0 && slots_[i].key != key) i = (i + 1) & (slots_.size() - 1);
        return slots_[i];
    }

    void grow() {
        std::vector<Slot> old(slots_.size() * 2);
        old.swap(slots_);
        for (const Slot& slot : old)
            if (slot.index >= 0) place(slot.key) = slot;
    }

    std::vector<Slot> slots_;
    size_t count_ = 0;
};

}  // namespace sf
