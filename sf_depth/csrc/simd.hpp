// SPDX-License-Identifier: Apache-2.0
// Vectors of eight, and what the kernels of this block do with them.
#pragma once
#include <cstddef>
#include <cstdint>
#include <cstring>

#include <sf_native/simd.hpp>

namespace sf {

constexpr size_t kLanes = 8;

typedef float Float8 __attribute__((vector_size(32)));
typedef int32_t Int8 __attribute__((vector_size(32)));
typedef double Double8 __attribute__((vector_size(64)));
typedef int64_t Long8 __attribute__((vector_size(64)));

// Eight values, or the last `count` of a row followed by zeros.
template <class V, class T>
SF_INLINE V load(const T* values, size_t count) {
    V out = {};
    if (count >= kLanes)
        std::memcpy(&out, values, sizeof out);
    else
        for (size_t k = 0; k < count; ++k) out[k] = values[k];
    return out;
}

SF_INLINE void store(float* values, const Float8& v, size_t count) {
    if (count >= kLanes)
        std::memcpy(values, &v, sizeof v);
    else
        for (size_t k = 0; k < count; ++k) values[k] = v[k];
}

SF_INLINE Float8 single(const Double8& v) { return __builtin_convertvector(v, Float8); }

SF_INLINE float sum(const Float8& v) { return ((v[0] + v[4]) + (v[1] + v[5])) + ((v[2] + v[6]) + (v[3] + v[7])); }

}  // namespace sf
