// SPDX-License-Identifier: Apache-2.0
// The pixels that a point covers: the same arithmetic, step by step, for all siblings of the rasteriser.
#pragma once
#include <cmath>

#include "ipr_cpu.hpp"

#ifdef __CUDACC__
#define SF_ANYWHERE __host__ __device__ __forceinline__
#else
#define SF_ANYWHERE inline __attribute__((always_inline))
#endif

namespace sf {

constexpr int kTile = 16;  // px

SF_ANYWHERE float half_width(const RasterSpec& s, float focal, float z) {
    const float half = s.radius * focal / z;
    const float wide = half > 0.5f ? half : 0.5f;
    return wide < s.max_half ? wide : s.max_half;
}

// Pixels whose centre lies within `half` of `centre`, clipped to low..high; empty when first > last. The argument must
// be of a size that fits an int. No call to floor: baseline x86-64 has no instruction for it.
SF_ANYWHERE int first_pixel(float centre, float half, int low) {
    const float edge = centre - half - 0.5f;
    const int cut = static_cast<int>(edge), first = cut + (static_cast<float>(cut) < edge);
    return first > low ? first : low;
}

SF_ANYWHERE int last_pixel(float centre, float half, int high) {
    const float edge = centre + half - 0.5f;
    const int cut = static_cast<int>(edge), last = cut - (static_cast<float>(cut) > edge);
    return last < high ? last : high;
}

struct Window {  // inclusive; empty when the point is not visible
    int x0, x1, y0, y1;
};

// False when a point touches no pixel for certain: a cheap test without a division. The bounds are wider than those of
// project() by more than rounding can do.
struct Frustum {
    float left, right, top, bottom;  // bounds of x / z and y / z, times the focal length

    explicit Frustum(const RasterSpec& s) {
        const float margin = s.max_half + 1.0f;
        const float slack = margin + 1.0f + 1e-5f * (std::abs(s.cx) + std::abs(s.cy) + s.width + s.height);
        left = -s.cx - slack, right = s.width - s.cx + slack;
        top = -s.cy - slack, bottom = s.height - s.cy + slack;
    }

    SF_ANYWHERE bool may_show(const RasterSpec& s, const float* p) const {
        const float* R = s.rotation;
        const float x = s.fx * (R[0] * p[0] + R[1] * p[1] + R[2] * p[2] + s.translation[0]);
        const float y = s.fy * (R[3] * p[0] + R[4] * p[1] + R[5] * p[2] + s.translation[1]);
        const float z = R[6] * p[0] + R[7] * p[1] + R[8] * p[2] + s.translation[2];
        return (z >= s.near) & (x > left * z) & (x < right * z) & (y > top * z) & (y < bottom * z);
    }
};

// Continuous pixel and depth of a point, and its window in the image; false when it touches no pixel.
SF_ANYWHERE bool project(const RasterSpec& s, const float* p, float& u, float& v, float& z, Window& w) {
    const float* R = s.rotation;
    z = R[6] * p[0] + R[7] * p[1] + R[8] * p[2] + s.translation[2];
    u = s.fx * (R[0] * p[0] + R[1] * p[1] + R[2] * p[2] + s.translation[0]) / z + s.cx;
    v = s.fy * (R[3] * p[0] + R[4] * p[1] + R[5] * p[2] + s.translation[1]) / z + s.cy;
    const float margin = s.max_half + 1.0f;  // reject before any conversion to int can overflow
    const float right = static_cast<float>(s.width) + margin, bottom = static_cast<float>(s.height) + margin;
    const bool inside = (z >= s.near) & (z <= 3.4028235e38f) & (u > -margin) & (u < right) & (v > -margin) & (v < bottom);
    const float su = inside ? u : -margin, sv = inside ? v : -margin, sz = inside ? z : 1.0f;
    const float hx = half_width(s, s.fx, sz), hy = half_width(s, s.fy, sz);
    w = {first_pixel(su, hx, 0), last_pixel(su, hx, s.width - 1), first_pixel(sv, hy, 0),
         last_pixel(sv, hy, s.height - 1)};
    return inside & (w.x0 <= w.x1) & (w.y0 <= w.y1);
}

}  // namespace sf
