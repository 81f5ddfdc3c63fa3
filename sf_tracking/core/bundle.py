"""Sparse bundle adjustment of poses and inverse depths: minimises L_track(G, P) (Sec. III-A).

A patch is a ray (x, y, 1) of its keyframe with inverse depth w. In another camera it lies at
``R (x, y, 1) + w t``: nothing is divided by w, so a patch may move to infinity. Inverse depths are
eliminated by their Schur complement; those with a measured depth carry it as a prior, the others are free.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera, Float64

_MIN_Z = 0.05  # of the unit ray; a patch nearer to the target's image plane or behind it carries no information
_DAMPING = 1e-4  # first Levenberg-Marquardt damping, relative to the diagonal
_MAX_DAMPING = 1e4
_FLOOR = 1e-9  # of a diagonal: a pose or a depth without any observation stays where it is


@dataclass(frozen=True, slots=True)
class Problem:
    """N keyframes of M patches each, and where every keyframe saw the patches of every other."""

    T_cw: Float64  # [N, 4, 4] world to camera
    rays: Float64  # [N, M, 2] (x, y) of the patch at unit depth, own camera
    w: Float64  # [N, M] inverse depth, 1/m
    prior: Float64  # [N, M] measured or expected inverse depth
    prior_weight: Float64  # [N, M] 1 / variance of the prior; 0: the inverse depth is free
    uv: Float64  # [N, N, M, 2] px, patch of the first index seen in the second
    information: Float64  # [N, N, M, 2, 2] 1/px^2; 0: not seen


@dataclass(frozen=True, slots=True)
class _Linear:
    """The problem linearised: H, b of the poses, C, c of the inverse depths, E their coupling; the cost."""

    H: Float64  # [6N, 6N]
    b: Float64  # [6N]
    C: Float64  # [N, M]
    c: Float64  # [N, M]
    E: Float64  # [N, N, 6, M] keyframe of the patch, pose, pose coordinate, patch


def project(camera: Camera, T_ts: Float64, rays: Float64, w: Float64) -> tuple[Float64, Float64]:
    """Continuous px [..., 2] and scaled points [..., 3] of rays [..., 2] moved by T_ts [..., 4, 4]."""
    X = np.einsum("...ij,...j->...i", T_ts[..., :3, :2], rays) + T_ts[..., :3, 2] + w[..., None] * T_ts[..., :3, 3]
    z = np.where(X[..., 2] > _MIN_Z, X[..., 2], np.nan)
    uv = X[..., :2] / z[..., None] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    return uv, X


def jacobians(camera: Camera, X: Float64, w: Float64, t: Float64) -> tuple[Float64, Float64]:
    """d(uv)/d(xi) [..., 2, 6] for exp(xi) T_cw of the target, and d(uv)/dw [..., 2], at scaled points X."""
    iz = 1.0 / X[..., 2]
    x, y, d = X[..., 0] * iz, X[..., 1] * iz, w * iz
    J = np.zeros((*X.shape[:-1], 2, 6))
    J[..., 0, 0], J[..., 0, 2], J[..., 0, 3] = d, -x * d, -x * y
    J[..., 0, 4], J[..., 0, 5] = 1 + x * x, -y
    J[..., 1, 1], J[..., 1, 2], J[..., 1, 3] = d, -y * d, -1 - y * y
    J[..., 1, 4], J[..., 1, 5] = x * y, x
    J[..., 0, :] *= camera.fx
    J[..., 1, :] *= camera.fy
    J_w = np.stack([camera.fx * (t[..., 0] - t[..., 2] * x) * iz, camera.fy * (t[..., 1] - t[..., 2] * y) * iz], -1)
    return J, J_w


def robust(squared: Float64, scale: float) -> tuple[Float64, Float64]:
    """Cauchy weight and cost of squared Mahalanobis errors; ``scale`` in standard deviations."""
    relative = squared / scale**2
    return 1.0 / (1.0 + relative), scale**2 * np.log1p(relative)


def _residuals(camera: Camera, p: Problem) -> tuple[Float64, Float64, Float64]:
    """r [N, N, M, 2] (0 where nothing is seen), scaled points [N, N, M, 3] and T_ts [N, N, 4, 4]."""
    T_ts = p.T_cw[None] @ se3.inverse(p.T_cw)[:, None]
    uv, X = project(camera, T_ts[:, :, None], p.rays[:, None], p.w[:, None])
    r = np.where(np.isfinite(uv), p.uv - uv, 0.0)
    X = np.where((X[..., 2] > _MIN_Z)[..., None], X, (0.0, 0.0, 1.0))
    return r, X, T_ts


def _squared(r: Float64, information: Float64) -> Float64:
    a, b = r[..., 0], r[..., 1]
    return a * a * information[..., 0, 0] + 2 * a * b * information[..., 0, 1] + b * b * information[..., 1, 1]


def cost(camera: Camera, p: Problem, scale: float) -> float:
    """Robust cost of all observations and priors."""
    r = _residuals(camera, p)[0]
    depth = p.prior_weight * (p.prior - p.w) ** 2
    return float(robust(_squared(r, p.information), scale)[1].sum() + robust(depth, scale)[1].sum())


def _linearise(camera: Camera, p: Problem, scale: float) -> _Linear:
    n, m = p.w.shape
    r, X, T_ts = _residuals(camera, p)
    W = p.information * robust(_squared(r, p.information), scale)[0][..., None, None]
    J, J_w = jacobians(camera, X, np.broadcast_to(p.w[:, None], X.shape[:-1]), T_ts[:, :, None, :3, 3])
    WJ = (W @ J).reshape(n, n, 2 * m, 6)
    own = WJ.transpose(0, 1, 3, 2) @ J.reshape(n, n, 2 * m, 6)  # [N, N, 6, 6] of the target's pose, for each pair
    g = (WJ.transpose(0, 1, 3, 2) @ r.reshape(n, n, 2 * m, 1))[..., 0]  # [N, N, 6]
    WJ_w = (W @ J_w[..., None])[..., 0]
    couple = np.einsum("stmki,stmk->stim", J, WJ_w)  # [N, N, 6, M]
    # The source's Jacobian is that of the target times -Ad(T_ts): its blocks follow from the pair's own.
    A = -se3.adjoint(T_ts)
    At = A.transpose(0, 1, 3, 2)
    H = np.zeros((n, n, 6, 6))
    diagonal = np.arange(n)
    H[diagonal, diagonal] = own.sum(axis=0) + (At @ own @ A).sum(axis=1)
    cross = own @ A  # target rows, source columns
    H += cross.transpose(1, 0, 2, 3) + cross.transpose(0, 1, 3, 2)
    b = g.sum(axis=0) + (At @ g[..., None])[..., 0].sum(axis=1)
    E = couple.copy()
    E[diagonal, diagonal] += (At @ couple).sum(axis=1)
    on_prior = p.prior_weight * robust(p.prior_weight * (p.prior - p.w) ** 2, scale)[0]
    C = np.einsum("stmk,stmk->sm", J_w, WJ_w) + on_prior
    c = np.einsum("stmk,stmk->sm", WJ_w, r) + on_prior * (p.prior - p.w)
    return _Linear(H.transpose(0, 2, 1, 3).reshape(6 * n, 6 * n), b.reshape(-1), C, c, E)


def _step(linear: _Linear, free: NDArray[np.bool_], damping: float) -> tuple[Float64, Float64]:
    """Pose steps [N, 6] (0 where fixed) and inverse depth steps [N, M] of the damped normal equations."""
    n = len(free)
    C = linear.C * (1 + damping) + _FLOOR
    E = linear.E.transpose(1, 2, 0, 3).reshape(6 * n, -1)
    over = E / C.reshape(-1)
    S = linear.H + np.diag(damping * np.diag(linear.H) + _FLOOR) - over @ E.T
    b = linear.b - over @ linear.c.reshape(-1)
    on = np.repeat(free, 6)
    xi = np.zeros(6 * n)
    xi[on] = np.linalg.solve(S[np.ix_(on, on)], b[on])
    dw = (linear.c.reshape(-1) - xi @ E) / C.reshape(-1)
    return xi.reshape(n, 6), dw.reshape(linear.C.shape)


def adjust(
    camera: Camera, p: Problem, free: NDArray[np.bool_], scale: float, iterations: int
) -> tuple[Problem, Float64]:
    """Optimise the free poses and all inverse depths; Levenberg-Marquardt steps that never raise the cost.

    Args:
        free: [N] poses to optimise; the others hold the gauge (without measured depth two of them also hold
            the scale).
        scale: where the robust kernel sets in, in standard deviations.

    Returns:
        The optimised problem, and the information [N, M] of its inverse depths, 1 / variance given the poses.
    """
    damping, now = _DAMPING, cost(camera, p, scale)
    linear = _linearise(camera, p, scale)
    for _ in range(iterations):
        xi, dw = _step(linear, free, damping)
        # Poses are products of products: without this their rotations drift from orthonormal frame by frame.
        T_cw = np.where(free[:, None, None], se3.orthonormalise(se3.exp(xi) @ p.T_cw), p.T_cw)
        trial = replace(p, T_cw=T_cw, w=np.maximum(p.w + dw, 0.0))
        trial_cost = cost(camera, trial, scale)
        if trial_cost > now:
            damping *= 10
            if damping > _MAX_DAMPING:
                break
            continue
        converged = now - trial_cost < 1e-4 * now
        p, now, damping = trial, trial_cost, max(damping / 10, 1e-9)
        linear = _linearise(camera, p, scale)
        if converged:
            break
    return p, linear.C
