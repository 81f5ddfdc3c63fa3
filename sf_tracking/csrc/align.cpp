// SPDX-License-Identifier: Apache-2.0
#include "align.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>

#include "linear.hpp"
#include "simd.hpp"

namespace sf {
namespace {

constexpr float kGrey = 128.0f;
constexpr double kRidge = 1e-3, kStopPx = 0.01, kMinGain = 0.05, kMaxShift = 2.0;
constexpr int kPixels = (kMaxSide + 2) * (kMaxSide + 2), kRoom = kPixels + 8;

// Bilinear grey levels less 128 at count continuous pixels; the border repeats outside. Rooms of eight are filled.
SF_INLINE void sample(const Image& image, const float* u, const float* v, int count, float* values) {
    const float last_u = static_cast<float>(image.width - 1), last_v = static_cast<float>(image.height - 1);
    const int right = image.width > 1, down = image.height > 1 ? image.width : 0;
    const Int8 last_col = Int8{} + std::max(image.width - 2, 0), last_row = Int8{} + std::max(image.height - 2, 0);
    for (int k = 0; k < count; k += 8) {
        Float8 x = load8(u + k) - 0.5f, y = load8(v + k) - 0.5f;
        x = x > 0.0f ? x : Float8{};  // NaN becomes 0
        y = y > 0.0f ? y : Float8{};
        x = x < last_u ? x : Float8{} + last_u;
        y = y < last_v ? y : Float8{} + last_v;
        Int8 col = __builtin_convertvector(x, Int8), row = __builtin_convertvector(y, Int8);
        col = col < last_col ? col : last_col;
        row = row < last_row ? row : last_row;
        const Float8 fx = x - __builtin_convertvector(col, Float8), fy = y - __builtin_convertvector(row, Float8);
        int32_t at[8];
        const Int8 index = row * image.width + col;
        std::memcpy(at, &index, sizeof(at));
        float corner[4][8];
        for (int i = 0; i < 8; ++i) {
            const float* grey = image.grey + at[i];
            corner[0][i] = grey[0];
            corner[1][i] = grey[right];
            corner[2][i] = grey[down];
            corner[3][i] = grey[down + right];
        }
        const Float8 a = load8(corner[0]), b = load8(corner[1]), c = load8(corner[2]), d = load8(corner[3]);
        const Float8 top = a + fx * (b - a), bottom = c + fx * (d - c);
        store8(values + k) = top + fy * (bottom - top) - kGrey;
    }
}

// The sums of four rows [4, count] times values, and of the squared values.
SF_INLINE void moments(const float* J, const float* values, int count, double* moment, double* energy) {
    Float8 sums[4] = {}, squares = {};
    int k = 0;
    for (; k + 8 <= count; k += 8) {
        const Float8 v = load8(values + k);
        for (int i = 0; i < 4; ++i) sums[i] += load8(J + i * count + k) * v;
        squares += v * v;
    }
    float rest[5] = {};
    for (; k < count; ++k) {
        for (int i = 0; i < 4; ++i) rest[i] += J[i * count + k] * values[k];
        rest[4] += values[k] * values[k];
    }
    for (int i = 0; i < 4; ++i) moment[i] = sum(sums[i]) + rest[i];
    *energy = sum(squares) + rest[4];
}

// Pixels of a square patch of `side` round (u, v), warped by A; the room behind them repeats the centre.
SF_INLINE void spread(int side, const double* A, float* du, float* dv) {
    const float a = A[0], b = A[1], c = A[2], d = A[3], middle = 0.5f * (side - 1);
    int k = 0;
    for (int row = 0; row < side; ++row)
        for (int col = 0; col < side; ++col, ++k) {
            const float x = col - middle, y = row - middle;
            du[k] = a * x + b * y;
            dv[k] = c * x + d * y;
        }
    for (const int end = k + 8; k < end; ++k) du[k] = dv[k] = 0.0f;
}

SF_INLINE void place(double cu, double cv, const float* du, const float* dv, int count, float* u, float* v) {
    const float fu = static_cast<float>(cu), fv = static_cast<float>(cv);
    for (int k = 0; k < count; k += 8) {
        store8(u + k) = load8(du + k) + fu;
        store8(v + k) = load8(dv + k) + fv;
    }
}

// The rows of a normal matrix [4, 4] inverted.
bool invert4(const double* A, double* inverse) {
    double column[4];
    for (int j = 0; j < 4; ++j) {
        const double unit[4] = {double(j == 0), double(j == 1), double(j == 2), double(j == 3)};
        if (!solve_spd<4>(A, unit, column)) return false;
        for (int i = 0; i < 4; ++i) inverse[4 * i + j] = column[i];
    }
    return true;
}

}  // namespace

SF_SIMD void describe(const Image& image, const double* uv, size_t count, int side, float* J, double* inverse) {
    const int wide = side + 2, pixels = side * side;
    const double identity[4] = {1, 0, 0, 1};
    float du[kRoom], dv[kRoom], u[kRoom], v[kRoom], grey[kRoom];
    spread(wide, identity, du, dv);
    for (size_t m = 0; m < count; ++m) {
        place(uv[2 * m], uv[2 * m + 1], du, dv, wide * wide, u, v);
        sample(image, u, v, wide * wide, grey);
        float* rows = J + 4 * pixels * m;
        for (int row = 0, k = 0; row < side; ++row)
            for (int col = 0; col < side; ++col, ++k) {
                const float* at = grey + (row + 1) * wide + col + 1;
                rows[k] = (at[1] - at[-1]) / 2;
                rows[pixels + k] = (at[wide] - at[-wide]) / 2;
                rows[2 * pixels + k] = at[0];
                rows[3 * pixels + k] = 1.0f;
            }
        double normal[16], energy;
        for (int i = 0; i < 4; ++i) {
            moments(rows, rows + i * pixels, pixels, normal + 4 * i, &energy);
            normal[5 * i] += kRidge * pixels;
        }
        if (!invert4(normal, inverse + 16 * m)) std::fill_n(inverse + 16 * m, 16, std::nan(""));
    }
}

SF_SIMD void align(const Image& image, const float* J, const double* inverse, const int64_t* rows, size_t edges,
                   int side, int iterations, const double* start, const double* warp, const Alignment& out) {
    const int pixels = side * side;
    float du[kRoom], dv[kRoom], u[kRoom], v[kRoom], values[kRoom];
    for (size_t e = 0; e < edges; ++e) {
        const float* templ = J + 4 * static_cast<size_t>(pixels) * rows[e];
        const double *inv = inverse + 16 * rows[e], *A = warp + 4 * e;
        double cu = start[2 * e], cv = start[2 * e + 1], gain = 0, left = std::numeric_limits<double>::infinity();
        double explained = 0;
        bool good = std::isfinite(cu + cv + A[0] + A[1] + A[2] + A[3]);
        if (good) spread(side, A, du, dv);
        for (int step = 0; good && step < iterations; ++step) {
            place(cu, cv, du, dv, pixels, u, v);
            sample(image, u, v, pixels, values);
            double moment[4], energy, x[4], fitted = 0;
            moments(templ, values, pixels, moment, &energy);
            for (int i = 0; i < 4; ++i) {
                x[i] = 0;
                for (int j = 0; j < 4; ++j) x[i] += inv[4 * i + j] * moment[j];
                fitted += moment[i] * x[i];
            }
            good = std::isfinite(x[0] + x[1] + x[2]);
            gain = x[2];
            left = std::max(energy - fitted, 0.0);
            explained = 1.0 - left / std::max(energy - moment[3] * moment[3] / pixels, 1e-9);
            const double scale = std::abs(gain) > kMinGain ? 1.0 / gain : 0.0;
            const double su = std::clamp(x[0] * scale, -kMaxShift, kMaxShift);
            const double sv = std::clamp(x[1] * scale, -kMaxShift, kMaxShift);
            const double step_u = A[0] * su + A[1] * sv, step_v = A[2] * su + A[3] * sv;
            cu -= step_u;
            cv -= step_v;
            if (std::max(std::abs(step_u), std::abs(step_v)) <= kStopPx) break;
        }
        const double noise = good ? left / (pixels - 4) : std::numeric_limits<double>::infinity();
        const double px = noise / std::max(gain * gain, 1e-4);
        out.centre[2 * e] = good ? cu : std::nan("");
        out.centre[2 * e + 1] = good ? cv : std::nan("");
        out.gain[e] = good ? gain : 0.0;
        out.residual[e] = std::sqrt(noise);
        out.explained[e] = good ? explained : 0.0;
        for (int i = 0; i < 2; ++i)
            for (int j = 0; j < 2; ++j) {
                double s = 0;
                for (int k = 0; k < 2; ++k)
                    for (int l = 0; l < 2; ++l) s += A[2 * i + k] * inv[4 * k + l] * A[2 * j + l];
                out.covariance[4 * e + 2 * i + j] = good ? s * px : std::nan("");
            }
    }
}

void judge(const double* start, const Aligned& found, size_t edges, int width, int height, const Limits& limits,
           double* information, bool* valid) {
    for (size_t e = 0; e < edges; ++e) {
        const double *at = found.centre + 2 * e, *cov = found.covariance + 4 * e, border = limits.border;
        const double moved = std::hypot(at[0] - start[2 * e], at[1] - start[2 * e + 1]);
        const bool inside = at[0] >= border && at[1] >= border && at[0] <= width - border && at[1] <= height - border;
        const bool alike = found.explained[e] > limits.explained || found.residual[e] < limits.noise;
        valid[e] = inside && alike && moved < limits.reach && found.residual[e] < limits.residual &&
                   found.gain[e] > 1 / limits.gain && found.gain[e] < limits.gain;
        const double own = limits.own * limits.own, a = cov[0] + own, b = cov[1], c = cov[2], d = cov[3] + own;
        const double inverse[4] = {d, -b, -c, a}, area = a * d - b * c;
        for (int i = 0; i < 4; ++i) information[4 * e + i] = inverse[i] / area;
    }
}

}  // namespace sf
