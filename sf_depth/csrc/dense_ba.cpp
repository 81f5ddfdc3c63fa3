// SPDX-License-Identifier: Apache-2.0
// Sums run over blocks of pixels in single precision and over the blocks in double, always in the same order.
#include "dense_ba.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "simd.hpp"

namespace sf {
namespace {

constexpr double kMinZ = 0.05;      // of the reference depth
constexpr size_t kBlock = 512;      // pixels
constexpr size_t kPose = 6, kTurn = 3, kFree = 4, kMost = kPose + kTurn + kFree;  // columns of one source

// Eight reference pixels in one source.
struct Seen {
    Double8 X[3];     // point in units of the reference depth, as its row sees it
    Double8 row;      // tangent of that row
    Double8 u, v;     // residual px; 0 where it does not count
    Double8 weight;   // 0 where it does not count
    Long8 blind;      // behind the source, or too near
};

SF_INLINE Seen see(const Views& p, size_t j, size_t k, size_t count) {
    const double *T = p.T + 16 * j, *theta = p.theta, *target = p.target + 2 * j * p.pixels, *turn = p.turn + 3 * j;
    const Double8 x = load<Double8>(p.x + k, count), y = load<Double8>(p.x + p.pixels + k, count);
    const Double8 d = load<Double8>(p.d + k, count);
    Seen s;
    s.weight = load<Double8>(p.weight + j * p.pixels + k, count);
    const Double8 u = load<Double8>(target + k, count), v = load<Double8>(target + p.pixels + k, count);
    s.row = s.weight > 0.0 ? (v - theta[3]) / theta[1] : Double8{};
    Double8 X[3];
    for (int i = 0; i < 3; ++i) X[i] = T[4 * i] * x + T[4 * i + 1] * y + T[4 * i + 2] + T[4 * i + 3] * d;
    for (int i = 0; i < 3; ++i) {
        const int n = (i + 1) % 3, m = (i + 2) % 3;
        s.X[i] = X[i] + s.row * (turn[n] * X[m] - turn[m] * X[n]);
    }
    s.blind = s.X[2] < kMinZ;
    s.weight = s.blind ? Double8{} : s.weight;
    const Double8 iz = 1.0 / (s.blind ? Double8{} + kMinZ : s.X[2]), a = s.X[0] * iz, b = s.X[1] * iz;
    const Double8 drawn = 1.0 + theta[4] * (a * a + b * b);
    s.u = u - (theta[0] * a * drawn + theta[2]);
    s.v = v - (theta[1] * b * drawn + theta[3]);
    const Long8 counts = s.weight > 0.0;
    s.u = counts ? s.u : Double8{};
    s.v = counts ? s.v : Double8{};
    return s;
}

// Derivatives of the projection: A [rows, 2] by pose, turn and intrinsics, a [2] by inverse depth. What a turn changes
// of the others is left out: it is a few thousandths.
struct Jacobian {
    Float8 A[kMost][2], a[2];
};

// Where the columns of a source begin among all: poses, then turns, then intrinsics.
struct Layout {
    Free own;
    size_t sources, pose, first, free;

    Layout(Free own_, size_t sources_)
        : own(own_), sources(sources_), pose(own.poses ? kPose : 0), first(own.columns()), free(first * sources) {}
    size_t row(size_t j, size_t column) const {
        if (column < pose) return pose * j + column;
        if (column < first) return pose * sources + kTurn * j + column - pose;
        return free + column - first;
    }
};

SF_INLINE void differentiate(const Views& p, const Intrinsics& free, Free parts, size_t j, size_t k, size_t count,
                             const Seen& s, Jacobian& out) {
    const double* T = p.T + 16 * j;
    const float fx = p.theta[0], fy = p.theta[1], k1 = p.theta[4];
    const Float8 X[3] = {single(s.X[0]), single(s.X[1]), single(s.X[2])}, row = single(s.row);
    const Float8 d = single(load<Double8>(p.d + k, count));
    const Float8 near = Float8{} + static_cast<float>(kMinZ), iz = 1.0f / (X[2] < near ? near : X[2]);
    const Float8 x = X[0] * iz, y = X[1] * iz, r2 = x * x + y * y, drawn = 1.0f + k1 * r2;
    Float8 J[3][2];  // by the point
    J[0][0] = fx * iz * (drawn + 2 * k1 * x * x);
    J[0][1] = fy * iz * (2 * k1 * x * y);
    J[1][0] = fx * iz * (2 * k1 * x * y);
    J[1][1] = fy * iz * (drawn + 2 * k1 * y * y);
    const float t[3] = {static_cast<float>(T[3]), static_cast<float>(T[7]), static_cast<float>(T[11])};
    const size_t first = parts.columns();
    for (int i = 0; i < 2; ++i) {
        J[2][i] = -(x * J[0][i] + y * J[1][i]);
        out.a[i] = t[0] * J[0][i] + t[1] * J[1][i] + t[2] * J[2][i];
        const Float8 turned[3] = {X[1] * J[2][i] - X[2] * J[1][i], X[2] * J[0][i] - X[0] * J[2][i],
                                  X[0] * J[1][i] - X[1] * J[0][i]};
        for (int c = 0; c < 3; ++c) {
            if (parts.poses) out.A[c][i] = J[c][i] * d;
            if (parts.poses) out.A[3 + c][i] = turned[c];
            if (parts.turn) out.A[first - kTurn + c][i] = row * turned[c];
        }
    }
    if (free.count == 0) return;
    const Float8 own[2] = {x * drawn, y * drawn}, bent[2] = {fx * x * r2, fy * y * r2};
    for (size_t f = 0; f < free.count; ++f) {
        const Float8 du = load<Float8>(free.dx + f * p.pixels + k, count);
        const Float8 dv = load<Float8>(free.dx + (free.count + f) * p.pixels + k, count);
        const double* c = free.columns + f;
        for (int i = 0; i < 2; ++i) {
            Float8 sum = static_cast<float>(c[i * free.count]) * own[i] + static_cast<float>(c[(2 + i) * free.count]) +
                         static_cast<float>(c[4 * free.count]) * bent[i];
            for (int r = 0; r < 3; ++r)
                sum += (static_cast<float>(T[4 * r]) * du + static_cast<float>(T[4 * r + 1]) * dv) * J[r][i];
            out.A[first + f][i] = sum;
        }
    }
}

SF_INLINE void add(float* values, const Float8& v, size_t count, bool fresh) {
    store(values, fresh ? v : load<Float8>(values, count) + v, count);
}

// Logarithm of 1 + x for x >= 0: exponent and a series in (m - 1) / (m + 1) of the mantissa m.
SF_INLINE Float8 log1p8(const Float8& x) {
    const Float8 y = 1.0f + x;
    const Int8 bits = (Int8)y;
    const Int8 mantissa = (bits & 0x7fffff) | 0x3f800000;
    const Float8 m = (Float8)mantissa;
    const Int8 large = m > 1.41421356f;
    const Float8 half = large ? 0.5f * m : m, t = (half - 1.0f) / (half + 1.0f), q = t * t;
    const Float8 exponent = __builtin_convertvector((bits >> 23) - 127 - large, Float8);  // large is -1
    const Float8 series = 2.0f * t * (1.0f + q * (1.0f / 3 + q * (1.0f / 5 + q * (1.0f / 7 + q * (1.0f / 9)))));
    return exponent * 0.69314718f + series + (x - (y - 1.0f)) / y;  // what 1 + x has rounded off
}

struct Sums {  // of one source over one block
    Float8 H[kMost * (kMost + 1) / 2], g[kMost];
};

// One block of one source; writes the rows of E and scores of its pose, adds to the others.
SF_INLINE void add_block(const Views& p, const Intrinsics& free, const Layout& layout, double c2, size_t j, size_t begin,
                         size_t end, const Equations& out, Sums& sums) {
    const size_t first = layout.first, rows = first + free.count;
    const float inverse = static_cast<float>(1.0 / c2);
    Jacobian J;
    for (size_t k = begin; k < end; k += kLanes) {
        const size_t count = end - k;
        const Seen s = see(p, j, k, count);
        differentiate(p, free, layout.own, j, k, count, s, J);
        const Float8 r[2] = {single(s.u), single(s.v)};
        const Float8 weight = single(s.weight) / (1.0f + (r[0] * r[0] + r[1] * r[1]) * inverse);
        const Float8 wa[2] = {weight * J.a[0], weight * J.a[1]}, wr[2] = {weight * r[0], weight * r[1]};
        for (size_t i = 0, at = 0; i < rows; ++i) {
            const size_t row = layout.row(j, i);
            const bool fresh = i < first || j == 0;
            const Float8 score = J.A[i][0] * wr[0] + J.A[i][1] * wr[1];
            const Float8 A[2] = {weight * J.A[i][0], weight * J.A[i][1]};
            for (size_t c = 0; c <= i; ++c, ++at) sums.H[at] += A[0] * J.A[c][0] + A[1] * J.A[c][1];
            sums.g[i] += score;
            add(out.E + row * p.pixels + k, J.A[i][0] * wa[0] + J.A[i][1] * wa[1], count, fresh);
            if (out.scores) add(out.scores + row * p.pixels + k, score, count, fresh);
        }
        add(out.C + k, J.a[0] * wa[0] + J.a[1] * wa[1], count, j == 0);
        add(out.w + k, J.a[0] * wr[0] + J.a[1] * wr[1], count, j == 0);
    }
}

}  // namespace

SF_SIMD void squared_residuals(const Views& p, float* out) {
    const Float8 nan = Float8{} + std::numeric_limits<float>::quiet_NaN();
    for (size_t j = 0; j < p.sources; ++j)
        for (size_t k = 0; k < p.pixels; k += kLanes) {
            const Seen s = see(p, j, k, p.pixels - k);
            const Int8 counts = single(s.weight) > 0.0f;
            store(out + j * p.pixels + k, counts ? single(s.u * s.u + s.v * s.v) : nan, p.pixels - k);
        }
}

SF_SIMD void robust_cost(const float* squares, const double* weight, size_t count, double c2, double blind,
                         double& cost, double& total) {
    const float inverse = static_cast<float>(1.0 / c2);
    const Float8 far = Float8{} + static_cast<float>(blind);
    cost = total = 0;
    for (size_t begin = 0; begin < count; begin += kBlock) {
        Float8 costs = {}, weights = {};
        const size_t end = std::min(begin + kBlock, count);
        for (size_t k = begin; k < end; k += kLanes) {
            const Float8 s = load<Float8>(squares + k, end - k), w = single(load<Double8>(weight + k, end - k));
            costs += w * log1p8((s == s ? s : far) * inverse);
            weights += w;
        }
        cost += sum(costs);
        total += sum(weights);
    }
    cost *= c2;
}

SF_SIMD void linearise(const Views& p, const Intrinsics& free, Free own, double c2, const Equations& out) {
    const Layout layout(own, p.sources);
    const size_t rows = layout.first + free.count, side = layout.free + free.count;
    std::fill_n(out.H, side * side, 0.0);
    std::fill_n(out.g, side, 0.0);
    for (size_t begin = 0; begin < p.pixels; begin += kBlock)
        for (size_t j = 0; j < p.sources; ++j) {
            Sums sums = {};
            add_block(p, free, layout, c2, j, begin, std::min(begin + kBlock, p.pixels), out, sums);
            for (size_t i = 0, at = 0; i < rows; ++i) {
                const size_t row = layout.row(j, i);
                out.g[row] += sum(sums.g[i]);
                for (size_t c = 0; c <= i; ++c, ++at) out.H[row * side + layout.row(j, c)] += sum(sums.H[at]);
            }
        }
    for (size_t i = 0; i < side; ++i)
        for (size_t c = 0; c < i; ++c) out.H[c * side + i] = out.H[i * side + c];
}

SF_SIMD void eliminate(const float* E, const float* C, const float* w, const double* H, const double* g, size_t rows,
                       size_t pixels, double* S, double* b) {
    std::copy_n(H, rows * rows, S);
    std::copy_n(g, rows, b);
    Float8 over[kBlock / kLanes];
    for (size_t begin = 0; begin < pixels; begin += kBlock) {
        const size_t end = std::min(begin + kBlock, pixels);
        for (size_t i = 0; i < rows; ++i) {
            Float8 right = {};
            for (size_t k = begin; k < end; k += kLanes) {
                const Float8 e = load<Float8>(E + i * pixels + k, end - k);
                Float8& scaled = over[(k - begin) / kLanes];
                scaled = e == 0.0f ? e : e / load<Float8>(C + k, end - k);  // behind the last pixel C is 0
                right += scaled * load<Float8>(w + k, end - k);
            }
            b[i] -= sum(right);
            for (size_t c = 0; c <= i; c += 4) {  // four at a time; the last are repeated
                Float8 sums[4] = {};
                const float* row[4];
                for (size_t q = 0; q < 4; ++q) row[q] = E + std::min(c + q, i) * pixels;
                for (size_t k = begin; k < end; k += kLanes)
                    for (size_t q = 0; q < 4; ++q)
                        sums[q] += over[(k - begin) / kLanes] * load<Float8>(row[q] + k, end - k);
                for (size_t q = 0; q < 4 && c + q <= i; ++q) S[i * rows + c + q] -= sum(sums[q]);
            }
        }
    }
    for (size_t i = 0; i < rows; ++i)
        for (size_t c = 0; c < i; ++c) S[c * rows + i] = S[i * rows + c];
}

SF_SIMD void substitute(const float* E, const float* C, const float* w, const double* dx, size_t rows, size_t pixels,
                        double* dd) {
    for (size_t k = 0; k < pixels; k += kLanes) {
        const size_t count = pixels - k;
        Float8 left = load<Float8>(w + k, count);
        for (size_t i = 0; i < rows; ++i) left -= static_cast<float>(dx[i]) * load<Float8>(E + i * pixels + k, count);
        left /= load<Float8>(C + k, count);
        for (size_t q = 0; q < std::min(count, kLanes); ++q) dd[k + q] = left[q];
    }
}

}  // namespace sf
