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
    root: Float64  # [N, N, M, 3] root of the information (information_root); 0: not seen
    motion: Float64  # [N, N, 4, 4] measured T_second_first
    motion_information: Float64  # [N, N, 6, 6] of exp(xi) motion; 0: not measured


@dataclass(frozen=True, slots=True)
class _Linear:
    """The problem linearised: H, b of the poses, C, c of the inverse depths, E their coupling; the cost."""

    H: Float64  # [6N, 6N]
    b: Float64  # [6N]
    C: Float64  # [N, M]
    c: Float64  # [N, M]
    E: Float64  # [N, N, 6, M] keyframe of the patch, pose, pose coordinate, patch


def project(camera: Camera, T_ts: Float64, rays: Float64, w: Float64) -> tuple[Float64, Float64]:
    """Continuous px [..., M, 2] and scaled points [..., M, 3] of rays [..., M, 2] moved by T_ts [..., 4, 4]."""
    R = np.swapaxes(T_ts[..., :3, :3], -1, -2)
    X = rays @ R[..., :2, :] + R[..., 2:, :] + w[..., None] * T_ts[..., None, :3, 3]
    z = np.where(X[..., 2] > _MIN_Z, X[..., 2], np.nan)
    uv = X[..., :2] / z[..., None] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    return uv, X


def jacobians(camera: Camera, X: Float64, w: Float64, t: Float64, root: Float64) -> tuple[Float64, Float64]:
    """Whitened derivatives of the projection at scaled points X [..., M, 3] with inverse depth w [..., M].

    Args:
        t: [..., 3] translation of the motion that brought the points here, m.
        root: [..., M, 3] (a, b, c) of ``[[a, b], [0, c]]``, a root of the information: r -> (a r_u + b r_v, c r_v).

    Returns:
        d(whitened uv)/d(xi) [..., 6, 2, M] for exp(xi) T_cw, and d(whitened uv)/dw [..., 2, M].
    """
    iz = 1.0 / X[..., 2]
    x, y, d = X[..., 0] * iz, X[..., 1] * iz, w * iz
    along_u = (t[..., 0, None] - t[..., 2, None] * x) * iz
    along_v = (t[..., 1, None] - t[..., 2, None] * y) * iz
    J = np.empty((*w.shape[:-1], 6, 2, w.shape[-1]))
    J_w = np.empty((*w.shape[:-1], 2, w.shape[-1]))
    rows = ((camera.fx * root[..., 0], camera.fy * root[..., 1]), (np.zeros_like(w), camera.fy * root[..., 2]))
    for row, (a, b) in enumerate(rows):
        J[..., 0, row, :], J[..., 1, row, :] = a * d, b * d
        J[..., 2, row, :] = -d * (a * x + b * y)
        J[..., 3, row, :] = -a * x * y - b * (1 + y * y)
        J[..., 4, row, :] = a * (1 + x * x) + b * x * y
        J[..., 5, row, :] = b * x - a * y
        J_w[..., row, :] = a * along_u + b * along_v
    return J, J_w


def information_root(information: Float64) -> Float64:
    """(a, b, c) [..., 3] with ``[[a, b], [0, c]]`` a root of the information [..., 2, 2]; 0 where it is 0."""
    a = np.sqrt(information[..., 0, 0])
    b = np.divide(information[..., 0, 1], a, out=np.zeros_like(a), where=a > 0)
    c = np.sqrt(np.maximum(information[..., 1, 1] - b * b, 0.0))
    return np.stack([a, b, c], axis=-1)


def whiten(r: Float64, root: Float64) -> Float64:
    """Residuals [..., M, 2] px in standard deviations, [..., 2, M]."""
    u = root[..., 0] * r[..., 0] + root[..., 1] * r[..., 1]
    return np.stack([u, root[..., 2] * r[..., 1]], axis=-2)


def robust(squared: Float64, scale: float) -> tuple[Float64, Float64]:
    """Cauchy weight and cost of squared Mahalanobis errors; ``scale`` in standard deviations."""
    relative = squared / scale**2
    return 1.0 / (1.0 + relative), scale**2 * np.log1p(relative)


def _residuals(camera: Camera, p: Problem) -> tuple[Float64, Float64, Float64]:
    """Whitened r [N, N, 2, M] (0 where nothing is seen), scaled points [N, N, M, 3] and T_ts [N, N, 4, 4]."""
    T_ts = p.T_cw[None] @ se3.inverse(p.T_cw)[:, None]
    uv, X = project(camera, T_ts, p.rays[:, None], p.w[:, None])
    valid = (X[..., 2] > _MIN_Z)[..., None]
    return whiten(np.where(valid, p.uv - uv, 0.0), p.root), np.where(valid, X, (0.0, 0.0, 1.0)), T_ts


def cost(camera: Camera, p: Problem, scale: float) -> float:
    """Robust cost of all observations and priors."""
    squared = (_residuals(camera, p)[0] ** 2).sum(axis=2)
    depth = p.prior_weight * (p.prior - p.w) ** 2
    moved = np.einsum("sti,stij,stj->", *_motion_error(p, p.T_cw[None] @ se3.inverse(p.T_cw)[:, None]))
    return float(robust(squared, scale)[1].sum() + robust(depth, scale)[1].sum() + moved)


def _motion_error(p: Problem, T_ts: Float64) -> tuple[Float64, Float64, Float64]:
    """log(T_ts motion^-1) [N, N, 6] where a motion was measured, its information, and the error again."""
    e = np.zeros((*T_ts.shape[:2], 6))
    known = p.motion_information.any(axis=(2, 3))
    if known.any():
        e[known] = se3.log(T_ts[known] @ se3.inverse(p.motion[known]))
    return e, p.motion_information, e


def _linearise(camera: Camera, p: Problem, scale: float) -> _Linear:
    n, m = p.w.shape
    r, X, T_ts = _residuals(camera, p)
    weight = np.sqrt(robust((r**2).sum(axis=2), scale)[0])  # [N, N, M]
    w = np.broadcast_to(p.w[:, None], weight.shape)
    J, J_w = jacobians(camera, X, w, T_ts[..., :3, 3], p.root * weight[..., None])
    r = r * weight[:, :, None]
    couple = (J * J_w[:, :, None]).sum(axis=3)  # [N, N, 6, M]
    J = J.reshape(n, n, 6, 2 * m)
    own = J @ J.transpose(0, 1, 3, 2)  # [N, N, 6, 6] of the target's pose, for each pair
    g = (J @ r.reshape(n, n, 2 * m, 1))[..., 0]  # [N, N, 6]
    e, motion_information, _ = _motion_error(p, T_ts)
    own += motion_information
    g -= (motion_information @ e[..., None])[..., 0]
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
    C = (J_w**2).sum(axis=(1, 2)) + on_prior
    c = (J_w * r).sum(axis=(1, 2)) + on_prior * (p.prior - p.w)
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
