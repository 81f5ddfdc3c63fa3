// SPDX-License-Identifier: Apache-2.0
// Hot loops are plain C++ on vectors of eight; on x86-64 Linux the compiler also emits them for AVX2 and AVX-512 and
// the loader picks what the machine has. Without contraction to fused multiply-add (see cmake/sf_native.cmake) all of
// them round alike.
#pragma once

#if defined(__x86_64__) && defined(__linux__) && defined(__GNUC__) && !defined(__clang__) && !defined(SF_NO_CLONES)
#define SF_SIMD __attribute__((target_clones("default", "avx2", "arch=x86-64-v4")))
#else
#define SF_SIMD
#endif
#define SF_INLINE inline __attribute__((always_inline))
