"""What the compiled dense bundle adjustment computes, in numpy; the tests hold one against the other."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np

from sf_depth.core import pinhole
from sf_depth.core.dense_ba import (
    KERNEL,
    MIN_Z,
    Estimate,
    Observations,
    System,
    bend_information,
    least_information,
    turn_information,
)
from sf_interfaces.types import Float64

_SINGLE = np.float32  # of the normal equations; residuals and the estimate are in double precision


def residuals(seen: Observations, at: Estimate) -> Float64:
    """x* - Pi(G Pi^-1(x, d)), [S, 2, N] px; NaN where a source cannot see the point."""
    x = pinhole.rays(at.theta, seen.uv)
    out = np.empty_like(seen.target)
    for j, T in enumerate(at.T):
        X = turned(at, j, transformed(T, x, at.inverse_depth), rows(seen, at, j))
        X[2][X[2] < MIN_Z] = np.nan
        out[j] = seen.target[j] - pinhole.project(at.theta, X[:2] / X[2])
    return out


def rows(seen: Observations, at: Estimate, j: int) -> Float64:
    """Tangents of the rows in which source j sees the pixels, [N]; 0 where it does not."""
    return np.where(seen.weight[j] > 0, (seen.target[j, 1] - at.theta[3]) / at.theta[1], 0.0)


def turned(at: Estimate, j: int, X: Float64, row: Float64) -> Float64:
    """Points [3, N] in source j as it sees them when it reads their rows."""
    return X + row.astype(X.dtype) * np.cross(at.turned[j].astype(X.dtype), X, axisb=0).T


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


def linearise(
    seen: Observations, at: Estimate, weight: Float64, r: Float64, sigma: float, poses: bool, columns: Float64
) -> System:
    """Normal equations at an estimate, weights [S, N] and residuals [S, 2, N] given; in single precision."""
    count, K = len(at.T), columns.shape[1]
    pose, turn = 6 if poses else 0, 3 if at.turn is not None else 0
    own = (pose + turn) * count
    P, N = own + K, seen.uv.shape[1]
    H, scores, E = np.zeros((P, P)), np.zeros((P, N), _SINGLE), np.zeros((P, N), _SINGLE)
    C, w = np.zeros(N, _SINGLE), np.zeros(N, _SINGLE)
    x, d = pinhole.rays(at.theta, seen.uv).astype(_SINGLE), at.inverse_depth.astype(_SINGLE)
    dx = pinhole.rays_jacobian(at.theta, x, columns) if K else np.zeros((2, 0, N), _SINGLE)
    for j in range(count):
        row = rows(seen, at, j).astype(_SINGLE)
        A, a = jacobians(at, j, x, row, dx, d, poses, columns)
        root = np.sqrt(weight[j]).astype(_SINGLE)
        A *= root  # 0 where the source is blind, and what was clipped there is finite
        a *= root
        b = np.where(root > 0, r[j], 0.0).astype(_SINGLE) * root
        flat = A.reshape(len(A), 2 * N)
        first = pose * count + turn * j
        where = np.r_[pose * j : pose * (j + 1), first : first + turn, own:P]
        H[np.ix_(where, where)] += flat @ flat.T
        scores[where] += A[:, 0] * b[0] + A[:, 1] * b[1]
        E[where] += A[:, 0] * a[0] + A[:, 1] * a[1]
        C += a[0] ** 2 + a[1] ** 2
        w += a[0] * b[0] + a[1] * b[1]
    g = scores.sum(axis=1, dtype=np.float64)
    if at.turn is not None:
        where, information = pose * count + np.arange(3 * count), np.repeat(turn_information(seen, at, sigma), 3)
        H[where, where] += information
        g[where] -= information * at.turn.ravel()
    bent, known = own + np.flatnonzero(columns[4]), bend_information(seen, at, sigma)
    H[bent, bent] += known
    g[bent] -= known * at.theta[4]
    return System(H, g, E, C, w, scores)


def jacobians(
    at: Estimate, j: int, x: Float64, row: Float64, dx: Float64, d: Float64, poses: bool, columns: Float64
) -> tuple[Float64, Float64]:
    """d Pi / d (pose, turn, phi) [6 + 3 + K, 2, N] and d Pi / d d [2, N] of source j, in the precision of ``x``.

    What a turn changes of the others is left out: it is a few thousandths.
    """
    theta, T, columns = (array.astype(x.dtype, copy=False) for array in (at.theta, at.T[j], columns))
    X = turned(at, j, transformed(T, x, d), row)
    inverse_z = 1.0 / np.maximum(X[2], MIN_Z)
    y = X[:2] * inverse_z
    uu, uv, vv = pinhole.project_jacobian(theta, y)
    fx, fy = theta[:2]
    J = np.empty((3, 2, len(d)), x.dtype)  # d uv / d (point in the source)
    J[0] = np.stack([fx * inverse_z * uu, fy * inverse_z * uv])
    J[1] = np.stack([fx * inverse_z * uv, fy * inverse_z * vv])
    J[2] = -(y[0] * J[0] + y[1] * J[1])
    rotated = np.stack([X[1] * J[2] - X[2] * J[1], X[2] * J[0] - X[0] * J[2], X[0] * J[1] - X[1] * J[0]])
    parts = []
    if poses:
        parts += [J * d, rotated]  # translations move the point of unit ray in proportion to its inverse depth
    if at.turn is not None:
        parts.append(row * rotated)
    if columns.shape[1]:
        own = pinhole.project_parameters(theta, y, columns)
        moved = np.einsum("ij,jkn->kin", T[:3, :2], dx)
        parts.append(np.einsum("kin,icn->kcn", moved, J) + own.transpose(1, 0, 2))
    A = np.concatenate(parts) if parts else np.empty((0, 2, len(d)), x.dtype)
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
