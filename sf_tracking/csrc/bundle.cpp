// SPDX-License-Identifier: Apache-2.0
#include "bundle.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

#include "simd.hpp"

namespace sf {
namespace {

constexpr double kMinZ = 0.05;

constexpr double kMost = 1e70;  // of a term of the cost, so that products of four stay finite

// Eight patches of one keyframe in another.
struct Seen {
    Double8 x, y, iz;  // on the image plane at unit depth, inverse z
    Double8 u, v;      // whitened residual, 0 where not seen
    Double8 root[3];   // 0 where not seen
    Double8 w;         // inverse depth in its own keyframe
};

// Patches k to k + 7 of keyframe s in keyframe t; false where none of them is seen.
SF_INLINE bool see(const Camera& camera, const Bundle& p, int s, int t, int k, Seen& seen) {
    const size_t source = static_cast<size_t>(s) * p.m + k, pair = static_cast<size_t>(s) * p.n + t;
    const int count = p.m - k;
    const double *root = p.root + 3 * (pair * p.m + k), *T = p.T_ts + 16 * pair, *uv = p.uv + 2 * (pair * p.m + k);
    const Double8 zero = {}, one = zero + 1.0;
    for (int i = 0; i < 3; ++i) seen.root[i] = gather8(root + i, 3, count);
    const Double8 rx = gather8(p.rays + 2 * source, 2, count), ry = gather8(p.rays + 2 * source + 1, 2, count);
    seen.w = gather8(p.w + source, 1, count);
    const Double8 z = T[8] * rx + T[9] * ry + T[10] + seen.w * T[11];
    const Long8 ahead = (z > kMinZ) & ((seen.root[0] != 0.0) | (seen.root[2] != 0.0));
    seen.iz = one / (ahead ? z : one);
    seen.x = (T[0] * rx + T[1] * ry + T[2] + seen.w * T[3]) * seen.iz;
    seen.y = (T[4] * rx + T[5] * ry + T[6] + seen.w * T[7]) * seen.iz;
    const Double8 ru = gather8(uv, 2, count) - (camera.fx * seen.x + camera.cx);
    const Double8 rv = gather8(uv + 1, 2, count) - (camera.fy * seen.y + camera.cy);
    seen.u = seen.root[0] * ru + seen.root[1] * rv;
    seen.v = seen.root[2] * rv;
    const Double8 both = seen.u + seen.v;
    const Long8 good = ahead & (both - both == 0.0);  // false for what is not finite
    seen.u = good ? seen.u : zero;
    seen.v = good ? seen.v : zero;
    for (Double8& r : seen.root) r = good ? r : zero;
    seen.x = good ? seen.x : zero;
    seen.y = good ? seen.y : zero;
    seen.iz = good ? seen.iz : zero;
    seen.w = good ? seen.w : zero;
    int64_t any = 0;
    for (int i = 0; i < 8; ++i) any |= good[i];
    return any != 0;
}

// out [6, 6] = -Ad(T) of a motion [4, 4], tangent (translation, rotation).
void negative_adjoint(const double* T, double* out) {
    const double t[3] = {T[3], T[7], T[11]};
    std::fill_n(out, 36, 0.0);
    for (int j = 0; j < 3; ++j) {
        const double R[3] = {T[j], T[4 + j], T[8 + j]};
        const double hat[3] = {t[1] * R[2] - t[2] * R[1], t[2] * R[0] - t[0] * R[2], t[0] * R[1] - t[1] * R[0]};
        for (int i = 0; i < 3; ++i) {
            out[6 * i + j] = out[6 * (i + 3) + j + 3] = -R[i];
            out[6 * i + j + 3] = -hat[i];
        }
    }
}

struct Pair {
    double own[36], g[6];  // of the target's pose
};

// The sums over the patches of s seen in t; adds to the rows of E, C and c.
SF_INLINE void add_pair(const Camera& camera, const Bundle& p, int s, int t, double scale, const double* A, Pair& pair,
                        const Normal& out) {
    const size_t columns = static_cast<size_t>(p.n) * p.m;
    const double *T = p.T_ts + 16 * (static_cast<size_t>(s) * p.n + t), over = 1.0 / (scale * scale);
    Double8 own[6][6] = {}, g[6] = {};
    Seen q;
    for (int k = 0; k < p.m; k += 8) {
        if (!see(camera, p, s, t, k, q)) continue;
        const int count = p.m - k;
        const size_t column = static_cast<size_t>(s) * p.m + k;
        Double8 weight = 1.0 / (1.0 + (q.u * q.u + q.v * q.v) * over);
        for (int i = 0; i < 8; ++i) weight[i] = std::sqrt(weight[i]);
        const Double8 r[2] = {weight * q.u, weight * q.v}, d = q.w * q.iz;
        const Double8 along_u = (T[3] - T[11] * q.x) * q.iz, along_v = (T[7] - T[11] * q.y) * q.iz;
        const Double8 on[2][2] = {{weight * q.root[0] * camera.fx, weight * q.root[1] * camera.fy},
                                  {Double8{}, weight * q.root[2] * camera.fy}};
        Double8 J[2][6], J_w[2], couple[6];
        by_pose(on, d, q.x, q.y, J);
        for (int i = 0; i < 2; ++i) J_w[i] = on[i][0] * along_u + on[i][1] * along_v;
        for (int i = 0; i < 6; ++i) {
            couple[i] = J[0][i] * J_w[0] + J[1][i] * J_w[1];
            g[i] += J[0][i] * r[0] + J[1][i] * r[1];
            for (int j = 0; j <= i; ++j) own[i][j] += J[0][i] * J[0][j] + J[1][i] * J[1][j];
            add8(out.E + (6 * t + i) * columns + column, couple[i], count);
        }
        for (int i = 0; i < 6; ++i) {
            Double8 moved = {};
            for (int j = 0; j < 6; ++j) moved += A[6 * j + i] * couple[j];
            add8(out.E + (6 * s + i) * columns + column, moved, count);
        }
        add8(out.C + column, J_w[0] * J_w[0] + J_w[1] * J_w[1], count);
        add8(out.c + column, J_w[0] * r[0] + J_w[1] * r[1], count);
    }
    for (int i = 0; i < 6; ++i) {
        pair.g[i] += sum(g[i]);
        for (int j = 0; j < 6; ++j) pair.own[6 * i + j] += sum(j <= i ? own[i][j] : own[j][i]);
    }
}

// The source's Jacobian is that of the target times A = -Ad(T_ts): its blocks follow from the pair's own.
void add_poses(int n, int s, int t, const Pair& pair, const double* A, const Normal& out) {
    const size_t side = 6 * static_cast<size_t>(n);
    double cross[36];
    for (int i = 0; i < 6; ++i)
        for (int j = 0; j < 6; ++j) {
            cross[6 * i + j] = 0;
            for (int k = 0; k < 6; ++k) cross[6 * i + j] += pair.own[6 * i + k] * A[6 * k + j];
        }
    for (int i = 0; i < 6; ++i) {
        double moved = 0;
        for (int k = 0; k < 6; ++k) moved += A[6 * k + i] * pair.g[k];
        out.b[6 * t + i] += pair.g[i];
        out.b[6 * s + i] += moved;
        for (int j = 0; j < 6; ++j) {
            double both = 0;
            for (int k = 0; k < 6; ++k) both += A[6 * k + i] * cross[6 * k + j];
            out.H[(6 * t + i) * side + 6 * t + j] += pair.own[6 * i + j];
            out.H[(6 * s + i) * side + 6 * s + j] += both;
            out.H[(6 * t + i) * side + 6 * s + j] += cross[6 * i + j];
            out.H[(6 * s + j) * side + 6 * t + i] += cross[6 * i + j];
        }
    }
}

SF_INLINE double dot(const double* a, const double* b, size_t count) {
    Double8 sums = {};
    size_t k = 0;
    for (; k + 8 <= count; k += 8) sums += load8(a + k) * load8(b + k);
    double rest = 0;
    for (; k < count; ++k) rest += a[k] * b[k];
    return sum(sums) + rest;
}

}  // namespace

SF_SIMD double bundle_cost(const Camera& camera, const Bundle& p, double scale) {
    const double square = scale * scale;
    double sum = 0;
    Seen q;
    for (int s = 0; s < p.n; ++s)
        for (int t = 0; t < p.n; ++t)
            for (int k = 0; k < p.m; k += 8) {
                if (!see(camera, p, s, t, k, q)) continue;
                Double8 term = 1.0 + (q.u * q.u + q.v * q.v) / square;
                term = term < kMost ? term : Double8{} + kMost;
                // The logarithm of a product is the sum of logarithms, and dearer than the product.
                sum += square * (std::log((term[0] * term[1]) * (term[2] * term[3])) +
                                 std::log((term[4] * term[5]) * (term[6] * term[7])));
            }
    for (size_t k = 0; k < static_cast<size_t>(p.n) * p.m; ++k) {
        const double off = p.prior[k] - p.w[k];
        sum += square * std::log1p(p.prior_weight[k] * off * off / square);
    }
    return sum;
}

SF_SIMD void linearise(const Camera& camera, const Bundle& p, double scale, const double* motion, const double* pull,
                       const Normal& out) {
    const size_t poses = 6 * static_cast<size_t>(p.n), patches = static_cast<size_t>(p.n) * p.m;
    std::fill_n(out.H, poses * poses, 0.0);
    std::fill_n(out.b, poses, 0.0);
    std::fill_n(out.E, poses * patches, 0.0);
    for (size_t k = 0; k < patches; ++k) {
        const double off = p.prior[k] - p.w[k];
        out.C[k] = p.prior_weight[k] / (1.0 + p.prior_weight[k] * off * off / (scale * scale));
        out.c[k] = out.C[k] * off;
    }
    double A[36];
    for (int s = 0; s < p.n; ++s)
        for (int t = 0; t < p.n; ++t) {
            const size_t index = static_cast<size_t>(s) * p.n + t;
            Pair pair;
            std::copy_n(motion + 36 * index, 36, pair.own);
            for (int i = 0; i < 6; ++i) pair.g[i] = -pull[6 * index + i];
            negative_adjoint(p.T_ts + 16 * index, A);
            add_pair(camera, p, s, t, scale, A, pair, out);
            add_poses(p.n, s, t, pair, A, out);
        }
}

SF_SIMD void eliminate(const double* E, const double* C, const double* c, size_t rows, size_t columns, double* S,
                       double* b) {
    std::vector<double> over(columns);
    for (size_t i = 0; i < rows; ++i) {
        for (size_t k = 0; k < columns; ++k) over[k] = E[i * columns + k] / C[k];
        b[i] -= dot(over.data(), c, columns);
        for (size_t j = 0; j <= i; ++j) S[i * rows + j] -= dot(over.data(), E + j * columns, columns);
    }
    for (size_t i = 0; i < rows; ++i)
        for (size_t j = i + 1; j < rows; ++j) S[i * rows + j] = S[j * rows + i];
}

}  // namespace sf
