// SPDX-License-Identifier: Apache-2.0
#include "bundle.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

#include "simd.hpp"

namespace sf {
namespace {

constexpr double kMinZ = 0.05;

struct Seen {
    double x, y, iz, u, v;  // on the image plane at unit depth, inverse z, whitened residual
};

// Patch k of keyframe s in keyframe t; false where it is not seen, or behind the camera.
bool see(const Camera& camera, const Bundle& p, int s, int t, int k, Seen& seen) {
    const size_t source = static_cast<size_t>(s) * p.m + k, pair = static_cast<size_t>(s) * p.n + t;
    const double *root = p.root + 3 * (pair * p.m + k), *T = p.T_ts + 16 * pair;
    if (root[0] == 0 && root[2] == 0) return false;
    const double rx = p.rays[2 * source], ry = p.rays[2 * source + 1], w = p.w[source];
    const double z = T[8] * rx + T[9] * ry + T[10] + w * T[11];
    if (!(z > kMinZ)) return false;
    seen.iz = 1.0 / z;
    seen.x = (T[0] * rx + T[1] * ry + T[2] + w * T[3]) * seen.iz;
    seen.y = (T[4] * rx + T[5] * ry + T[6] + w * T[7]) * seen.iz;
    const double* uv = p.uv + 2 * (pair * p.m + k);
    const double ru = uv[0] - (camera.fx * seen.x + camera.cx), rv = uv[1] - (camera.fy * seen.y + camera.cy);
    seen.u = root[0] * ru + root[1] * rv;
    seen.v = root[2] * rv;
    return std::isfinite(seen.u + seen.v);
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
void add_pair(const Camera& camera, const Bundle& p, int s, int t, double scale, const double* A, Pair& pair,
              const Normal& out) {
    const size_t columns = static_cast<size_t>(p.n) * p.m;
    const double *root_of = p.root + 3 * (static_cast<size_t>(s) * p.n + t) * p.m;
    const double* T = p.T_ts + 16 * (static_cast<size_t>(s) * p.n + t);
    Seen q;
    for (int k = 0; k < p.m; ++k) {
        if (!see(camera, p, s, t, k, q)) continue;
        const size_t column = static_cast<size_t>(s) * p.m + k;
        const double weight = std::sqrt(1.0 / (1.0 + (q.u * q.u + q.v * q.v) / (scale * scale)));
        const double d = p.w[column] * q.iz, *root = root_of + 3 * k, r[2] = {weight * q.u, weight * q.v};
        const double along_u = (T[3] - T[11] * q.x) * q.iz, along_v = (T[7] - T[11] * q.y) * q.iz;
        const double on[2][2] = {{weight * root[0] * camera.fx, weight * root[1] * camera.fy},
                                 {0.0, weight * root[2] * camera.fy}};
        double J[2][6], J_w[2], couple[6];
        by_pose(on, d, q.x, q.y, J);
        for (int i = 0; i < 2; ++i) J_w[i] = on[i][0] * along_u + on[i][1] * along_v;
        for (int i = 0; i < 6; ++i) {
            couple[i] = J[0][i] * J_w[0] + J[1][i] * J_w[1];
            pair.g[i] += J[0][i] * r[0] + J[1][i] * r[1];
            for (int j = 0; j < 6; ++j) pair.own[6 * i + j] += J[0][i] * J[0][j] + J[1][i] * J[1][j];
            out.E[(6 * t + i) * columns + column] += couple[i];
        }
        for (int i = 0; i < 6; ++i) {
            double moved = 0;
            for (int j = 0; j < 6; ++j) moved += A[6 * j + i] * couple[j];
            out.E[(6 * s + i) * columns + column] += moved;
        }
        out.C[column] += J_w[0] * J_w[0] + J_w[1] * J_w[1];
        out.c[column] += J_w[0] * r[0] + J_w[1] * r[1];
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
    for (; k + 8 <= count; k += 8)
        sums += *reinterpret_cast<const Double8*>(a + k) * *reinterpret_cast<const Double8*>(b + k);
    double rest = 0;
    for (; k < count; ++k) rest += a[k] * b[k];
    return (((sums[0] + sums[4]) + (sums[1] + sums[5])) + ((sums[2] + sums[6]) + (sums[3] + sums[7]))) + rest;
}

}  // namespace

double bundle_cost(const Camera& camera, const Bundle& p, double scale) {
    const double square = scale * scale;
    double sum = 0;
    Seen q;
    for (int s = 0; s < p.n; ++s)
        for (int t = 0; t < p.n; ++t)
            for (int k = 0; k < p.m; ++k)
                if (see(camera, p, s, t, k, q)) sum += square * std::log1p((q.u * q.u + q.v * q.v) / square);
    for (size_t k = 0; k < static_cast<size_t>(p.n) * p.m; ++k) {
        const double off = p.prior[k] - p.w[k];
        sum += square * std::log1p(p.prior_weight[k] * off * off / square);
    }
    return sum;
}

void linearise(const Camera& camera, const Bundle& p, double scale, const double* motion, const double* pull,
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
