// SPDX-License-Identifier: Apache-2.0
// Vectors of eight, and what the kernels of this block do with them.
#pragma once
#include <cmath>
#include <cstddef>
#include <cstdint>

#include <sf_native/simd.hpp>

namespace sf {

typedef float Float8 __attribute__((vector_size(32), aligned(4)));
typedef int32_t Int8 __attribute__((vector_size(32), aligned(4)));
typedef double Double8 __attribute__((vector_size(64), aligned(8)));
typedef int64_t Long8 __attribute__((vector_size(64), aligned(8)));

SF_INLINE const Float8& load8(const float* values) { return *reinterpret_cast<const Float8*>(values); }
SF_INLINE Float8& store8(float* values) { return *reinterpret_cast<Float8*>(values); }

SF_INLINE const Double8& load8(const double* values) { return *reinterpret_cast<const Double8*>(values); }
SF_INLINE Double8& store8(double* values) { return *reinterpret_cast<Double8*>(values); }

// Eight numbers, `stride` apart; 0 beyond `count` of them.
SF_INLINE Double8 gather8(const double* values, int stride, int count) {
    Double8 out = {};
    if (count >= 8)
        for (int i = 0; i < 8; ++i) out[i] = values[i * stride];
    else
        for (int i = 0; i < count; ++i) out[i] = values[i * stride];
    return out;
}

// Adds the first `count` of eight numbers to those at `to`.
SF_INLINE void add8(double* to, const Double8& values, int count) {
    if (count >= 8)
        store8(to) += values;
    else
        for (int i = 0; i < count; ++i) to[i] += values[i];
}

SF_INLINE double sum(const Double8& v) { return ((v[0] + v[4]) + (v[1] + v[5])) + ((v[2] + v[6]) + (v[3] + v[7])); }
SF_INLINE float sum(const Float8& v) { return ((v[0] + v[4]) + (v[1] + v[5])) + ((v[2] + v[6]) + (v[3] + v[7])); }

}  // namespace sf
