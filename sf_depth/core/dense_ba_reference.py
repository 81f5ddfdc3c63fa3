"""What the compiled dense bundle adjustment computes, in numpy; the tests hold one against the other."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np

from sf_depth.core import pinhole
from sf_depth.core.dense_ba import KERNEL, MIN_Z, Estimate, Observations, System, least_information
from sf_interfaces.types import Float64

_SINGLE = np.float32  # of the normal equations; residuals and the estimate are in double precision


def residuals(seen: Observations, at: Estimate) -> Float64:
    """x* - Pi(G Pi^-1(x, d)), [S, 2, N] px; NaN where a source cannot see the point."""
    x = pinhole.rays(at.theta, seen.uv)
    out = np.empty_like(seen.target)
    for j, T in enumerate(at.T):
        X = transformed(T, x, at.inverse_depth)
        X[2][X[2] < MIN_Z] = np.nan
        out[j] = seen.target[j] - pinhole.project(at.theta, X[:2] / X[2])
    return out


def transformed(T: Float64, x: Float64, d: Float64) -> Float64:
    """Points of rays x [2, N] at inverse depth d [N] in a source, in units of the reference depth, [3, N]."""
    return T[:3, :2] @ x + T[:3, 2:3] + T[:3, 3:] * d


def squared(r: Float64) -> Float64:
    """Squared lengths [S, N] of residuals [S, 2, N]."""
    return np.asarray(r[:, 0] ** 2 + r[:, 1] ** 2)


def robust(r: Float64, weight: Float64, sigma: float) -> Float64:
    """Weights [S, N] of the Cauchy kernel times the confidence; 0 behind a camera."""
    with np.errstate(invalid="ignore"):
        w = weight / (1.0 + squared(r) / (KERNEL * sigma) ** 2)
    return np.where(np.isfinite(w), w, 0.0)


def cost(r: Float64, weight: Float64, sigma: float) -> float:
    """Mean robust cost, px^2; a point behind a camera costs as much as one 100 deviations off."""
    c2 = (KERNEL * sigma) ** 2
    squares = squared(r)
    squares[~np.isfinite(squares)] = (100 * sigma) ** 2
    return float((weight * c2 * np.log1p(squares / c2)).sum() / max(weight.sum(), 1e-12))


def linearise(seen: Observations, at: Estimate, weight: Float64, r: Float64, poses: bool, columns: Float64) -> System:
    """Normal equations at an estimate, weights [S, N] and residuals [S, 2, N] given; in single precision."""
    count, K = len(at.T), columns.shape[1]
    own = 6 * count if poses else 0
    P, N = own + K, seen.uv.shape[1]
    H, scores, E = np.zeros((P, P)), np.zeros((P, N), _SINGLE), np.zeros((P, N), _SINGLE)
    C, w = np.zeros(N, _SINGLE), np.zeros(N, _SINGLE)
    x, d = pinhole.rays(at.theta, seen.uv).astype(_SINGLE), at.inverse_depth.astype(_SINGLE)
    dx = pinhole.rays_jacobian(at.theta, x, columns) if K else np.zeros((2, 0, N), _SINGLE)
    for j, T in enumerate(at.T):
        A, a = jacobians(at.theta, T, x, dx, d, poses, columns)
        root = np.sqrt(weight[j]).astype(_SINGLE)
        A *= root  # 0 where the source is blind, and what was clipped there is finite
        a *= root
        b = np.where(root > 0, r[j], 0.0).astype(_SINGLE) * root
        flat = A.reshape(len(A), 2 * N)
        rows = np.r_[6 * j : 6 * j + 6, own:P] if poses else np.arange(own, P)
        H[np.ix_(rows, rows)] += flat @ flat.T
        pose, count = slice(6 * j, 6 * j + 6), len(A) - K
        for total, (first, second) in ((scores, b), (E, a)):
            part = A[:, 0] * first + A[:, 1] * second
            total[pose][:count] = part[:count]  # of this source alone
            total[own:] += part[count:]
        C += a[0] ** 2 + a[1] ** 2
        w += a[0] * b[0] + a[1] * b[1]
    return System(H, scores.sum(axis=1, dtype=np.float64), E, C, w, scores)


def jacobians(
    theta: Float64, T: Float64, x: Float64, dx: Float64, d: Float64, poses: bool, columns: Float64
) -> tuple[Float64, Float64]:
    """d Pi / d (pose, phi) [6 + K, 2, N] and d Pi / d d [2, N] of one source, in the precision of ``x``."""
    theta, T, columns = (array.astype(x.dtype, copy=False) for array in (theta, T, columns))
    X = transformed(T, x, d)
    inverse_z = 1.0 / np.maximum(X[2], MIN_Z)
    y = X[:2] * inverse_z
    uu, uv, vv = pinhole.project_jacobian(theta, y)
    J = np.empty((3, 2, len(d)), x.dtype)  # d uv / d (point in the source)
    J[0] = theta[0] * inverse_z * uu, theta[1] * inverse_z * uv
    J[1] = theta[0] * inverse_z * uv, theta[1] * inverse_z * vv
    J[2] = -(y[0] * J[0] + y[1] * J[1])
    A = np.empty(((6 if poses else 0) + columns.shape[1], 2, len(d)), x.dtype)
    if poses:
        A[:3] = J * d  # translations act on the point of unit ray in proportion to its inverse depth
        A[3] = X[1] * J[2] - X[2] * J[1]
        A[4] = X[2] * J[0] - X[0] * J[2]
        A[5] = X[0] * J[1] - X[1] * J[0]
    if columns.shape[1]:
        own = pinhole.project_parameters(theta, y, columns)
        for k in range(columns.shape[1]):
            v = T[:3, :2] @ dx[:, k]
            A[k - columns.shape[1]] = v[0] * J[0] + v[1] * J[1] + v[2] * J[2] + own[:, k]
    t = T[:3, 3]
    return A, t[0] * J[0] + t[1] * J[1] + t[2] * J[2]


def step(system: System, damping: float) -> tuple[Float64, Float64]:
    """Damped step (dx [P], dd [N]) by the Schur complement of the inverse depths."""
    C = system.C * np.float32(1.0 + damping) + least_information(system.C)
    scaled = system.E / C
    S = system.H - scaled @ system.E.T
    S[np.diag_indices_from(S)] += damping * np.diag(system.H) + 1e-12 * np.trace(system.H)
    dx = np.linalg.solve(S, system.g - scaled @ system.w) if len(S) else np.zeros(0)
    return dx, (system.w - system.E.T @ dx.astype(np.float32)) / C
