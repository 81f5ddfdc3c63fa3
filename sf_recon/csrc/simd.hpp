// SPDX-License-Identifier: Apache-2.0
// Hot loops are plain C++ that vectorises; on x86-64 Linux the compiler also emits them for AVX2 and AVX-512 and the
// loader picks what the machine has. No contraction to fused multiply-add (see CMakeLists.txt): all give equal bits.
#pragma once
#include <cstdint>
#include <cstring>

#if defined(__x86_64__) && defined(__linux__) && defined(__GNUC__) && !defined(__clang__) && !defined(SF_NO_CLONES)
#define SF_SIMD __attribute__((target_clones("default", "avx2", "arch=x86-64-v4")))
#else
#define SF_SIMD
#endif
#define SF_INLINE inline __attribute__((always_inline))

namespace sf {

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

typedef float Float8 __attribute__((vector_size(32), aligned(4)));
typedef int32_t Int8 __attribute__((vector_size(32), aligned(4)));

SF_INLINE const Float8& load8(const float* values) { return *reinterpret_cast<const Float8*>(values); }

// One bit for each lane that a comparison left at -1.
SF_INLINE uint32_t lanes_set(const Int8& comparison) {
    const Int8 bits = comparison & Int8{1, 2, 4, 8, 16, 32, 64, 128};
    uint64_t pairs[4];
    std::memcpy(pairs, &bits, 32);
    const uint64_t both = (pairs[0] | pairs[1]) | (pairs[2] | pairs[3]);
    return static_cast<uint32_t>(both | both >> 32);
}

// exp(x) for x <= 0 with a relative error below 2e-7; 0 below -87 and for -inf. Free of branches, so that it vectorises.
SF_INLINE float exp_negative(float x) {
    const float clipped = x > -87.0f ? x : -87.0f;
    const float magic = 12582912.0f;  // 1.5 * 2^23: adding it rounds to an integer
    const float rounded = clipped * 1.44269504f + magic;
    const float n = rounded - magic;
    const float r = (clipped - n * 0.693145752f) - n * 1.42860677e-6f;  // two-part ln 2
    float p = 1.0f / 720;
    p = p * r + 1.0f / 120;
    p = p * r + 1.0f / 24;
    p = p * r + 1.0f / 6;
    p = p * r + 0.5f;
    p = p * r + 1.0f;
    p = p * r + 1.0f;
    const float scaled = p * from_bits((to_bits(rounded) - to_bits(magic) + 127) * (1 << 23));
    return x > -87.0f ? scaled : 0.0f;
}

}  // namespace sf
