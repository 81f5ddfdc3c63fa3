// SPDX-License-Identifier: Apache-2.0
// Vectors of eight, and what the kernels of this block do with them.
#pragma once
#include <cstdint>
#include <cstring>

#include <sf_native/simd.hpp>

namespace sf {

typedef float Float8 __attribute__((vector_size(32), aligned(4)));
typedef float Float4 __attribute__((vector_size(16), aligned(4)));
typedef int32_t Int8 __attribute__((vector_size(32), aligned(4)));

SF_INLINE const Float8& load8(const float* values) { return *reinterpret_cast<const Float8*>(values); }

SF_INLINE float from_bits(int32_t bits) {
    float value;
    std::memcpy(&value, &bits, 4);
    return value;
}

SF_INLINE int32_t to_bits(float value) {
    int32_t bits;
    std::memcpy(&bits, &value, 4);
    return bits;
}

// A cast between vectors keeps the bits.
SF_INLINE Float8 from_bits(Int8 bits) { return (Float8)bits; }
SF_INLINE Int8 to_bits(Float8 value) { return (Int8)value; }

// One bit for each lane that a comparison left at -1.
SF_INLINE uint32_t lanes_set(const Int8& comparison) {
    const Int8 bits = comparison & Int8{1, 2, 4, 8, 16, 32, 64, 128};
    uint64_t pairs[4];
    std::memcpy(pairs, &bits, 32);
    const uint64_t both = (pairs[0] | pairs[1]) | (pairs[2] | pairs[3]);
    return static_cast<uint32_t>(both | both >> 32);
}

// Columns of eight rows of four floats; `begin` tells where each row begins, in floats.
SF_INLINE void gather8x4(const float* base, Int8 begin, Float8* columns) {
    int32_t rows[8];
    std::memcpy(rows, &begin, 32);
    Float8 r[4];  // rows i and i + 4 side by side
    for (int i = 0; i < 4; ++i)
        r[i] = __builtin_shufflevector(*reinterpret_cast<const Float4*>(base + rows[i]),
                                       *reinterpret_cast<const Float4*>(base + rows[i + 4]), 0, 1, 2, 3, 4, 5, 6, 7);
    const Float8 low01 = __builtin_shufflevector(r[0], r[1], 0, 8, 1, 9, 4, 12, 5, 13);
    const Float8 high01 = __builtin_shufflevector(r[0], r[1], 2, 10, 3, 11, 6, 14, 7, 15);
    const Float8 low23 = __builtin_shufflevector(r[2], r[3], 0, 8, 1, 9, 4, 12, 5, 13);
    const Float8 high23 = __builtin_shufflevector(r[2], r[3], 2, 10, 3, 11, 6, 14, 7, 15);
    columns[0] = __builtin_shufflevector(low01, low23, 0, 1, 8, 9, 4, 5, 12, 13);
    columns[1] = __builtin_shufflevector(low01, low23, 2, 3, 10, 11, 6, 7, 14, 15);
    columns[2] = __builtin_shufflevector(high01, high23, 0, 1, 8, 9, 4, 5, 12, 13);
    columns[3] = __builtin_shufflevector(high01, high23, 2, 3, 10, 11, 6, 7, 14, 15);
}

// exp(x) for x <= 0, a float or eight, with a relative error below 2e-7; 0 below -87 and for -inf. Without branches.
template <class F>
SF_INLINE F exp_negative(F x) {
    const F lowest = F{} - 87.0f;
    const F clipped = x > lowest ? x : lowest;
    const float magic = 12582912.0f;  // 1.5 * 2^23: adding it rounds to an integer
    const F rounded = clipped * 1.44269504f + magic;
    const F n = rounded - magic;
    const F r = (clipped - n * 0.693145752f) - n * 1.42860677e-6f;  // two-part ln 2
    F p = r * (1.0f / 720) + 1.0f / 120;
    p = p * r + 1.0f / 24;
    p = p * r + 1.0f / 6;
    p = p * r + 0.5f;
    p = p * r + 1.0f;
    p = p * r + 1.0f;
    const F power = from_bits((to_bits(rounded) - to_bits(magic) + 127) * (1 << 23));
    return x > lowest ? p * power : F{};
}

}  // namespace sf
