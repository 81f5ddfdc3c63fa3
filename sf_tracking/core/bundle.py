"""Sparse bundle adjustment of poses and inverse depths: minimises L_track(G, P) (Sec. III-A).

A patch is a ray (x, y, 1) of its keyframe with inverse depth w. In another camera it lies at
``R (x, y, 1) + w t``: nothing is divided by w, so a patch may move to infinity. Inverse depths are
eliminated by their Schur complement; those with a measured depth carry it as a prior, the others are free.
The sums are compiled; :mod:`.bundle_reference` is the same in numpy.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera, Float64
from sf_tracking.core.native import intrinsics, native

MIN_Z = 0.05  # of the unit ray; a patch nearer to the target's image plane or behind it carries no information
_DAMPING = 1e-4  # first Levenberg-Marquardt damping, relative to the diagonal
_MAX_DAMPING = 1e4
_CONVERGED = 1e-4  # of the cost: a step that lowers it by less is the last
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
class Linear:
    """The problem linearised: H, b of the poses, C, c of the inverse depths, E their coupling."""

    H: Float64  # [6N, 6N]
    b: Float64  # [6N]
    C: Float64  # [N, M]
    c: Float64  # [N, M]
    E: Float64  # [6N, N M]


def project(camera: Camera, T_ts: Float64, rays: Float64, w: Float64) -> tuple[Float64, Float64]:
    """Continuous px [..., M, 2] and scaled points [..., M, 3] of rays [..., M, 2] moved by T_ts [..., 4, 4]."""
    R = np.swapaxes(T_ts[..., :3, :3], -1, -2)
    X = rays @ R[..., :2, :] + R[..., 2:, :] + w[..., None] * T_ts[..., None, :3, 3]
    z = np.where(X[..., 2] > MIN_Z, X[..., 2], np.nan)
    uv = X[..., :2] / z[..., None] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    return uv, X


def information_root(information: Float64) -> Float64:
    """(a, b, c) [..., 3] with ``[[a, b], [0, c]]`` a root of the information [..., 2, 2]; 0 where it is 0."""
    a = np.sqrt(information[..., 0, 0])
    b = np.divide(information[..., 0, 1], a, out=np.zeros_like(a), where=a > 0)
    c = np.sqrt(np.maximum(information[..., 1, 1] - b * b, 0.0))
    return np.stack([a, b, c], axis=-1)


def motions(p: Problem) -> Float64:
    """T_ts [N, N, 4, 4] from every keyframe, the first index, to every other."""
    return np.asarray(p.T_cw[None] @ se3.inverse(p.T_cw)[:, None])


def motion_error(p: Problem, T_ts: Float64) -> tuple[Float64, Float64]:
    """log(T_ts motion^-1) [N, N, 6], 0 where no motion was measured, and its information times that."""
    e = np.zeros((*T_ts.shape[:2], 6))
    known = p.motion_information.any(axis=(2, 3))
    if known.any():
        e[known] = se3.log(T_ts[known] @ se3.inverse(p.motion[known]))
    return e, (p.motion_information @ e[..., None])[..., 0]


def _arrays(p: Problem, T_ts: Float64) -> tuple[Float64, ...]:
    return T_ts, p.rays, p.w, p.prior, p.prior_weight, p.uv, p.root


def cost(camera: Camera, p: Problem, scale: float) -> float:
    """Robust cost of all observations, priors and measured motions."""
    T_ts = motions(p)
    e, pull = motion_error(p, T_ts)
    return float(native().bundle_cost(intrinsics(camera), scale, *_arrays(p, T_ts)) + (e * pull).sum())


def linearise(camera: Camera, p: Problem, scale: float) -> Linear:
    """The normal equations at the present poses and inverse depths."""
    T_ts = motions(p)
    pull = motion_error(p, T_ts)[1]
    found = native().linearise(intrinsics(camera), scale, p.motion_information, pull, *_arrays(p, T_ts))
    return Linear(*found)


def _step(linear: Linear, free: NDArray[np.bool_], damping: float) -> tuple[Float64, Float64]:
    """Pose steps [N, 6] (0 where fixed) and inverse depth steps [N, M] of the damped normal equations."""
    n = len(free)
    C = (linear.C * (1 + damping) + _FLOOR).reshape(-1)
    H = linear.H + np.diag(damping * np.diag(linear.H) + _FLOOR)
    S, b = native().eliminate(linear.E, C, linear.c.reshape(-1), H, linear.b)
    on = np.repeat(free, 6)
    xi = np.zeros(6 * n)
    xi[on] = np.linalg.solve(S[np.ix_(on, on)], b[on])
    dw = (linear.c.reshape(-1) - xi @ linear.E) / C
    return xi.reshape(n, 6), dw.reshape(linear.C.shape)


def adjusting(
    camera: Camera, p: Problem, free: NDArray[np.bool_], scale: float, iterations: int
) -> Iterator[tuple[Problem, Float64]]:
    """Levenberg-Marquardt steps that never raise the cost, until they hardly lower it; see :func:`adjust`.

    Yields:
        After each step what :func:`adjust` returns at last.
    """
    damping, now, linear = _DAMPING, cost(camera, p, scale), None
    for _ in range(iterations):
        linear = linear or linearise(camera, p, scale)
        xi, dw = _step(linear, free, damping)
        # Poses are products of products: without this their rotations drift from orthonormal frame by frame.
        T_cw = np.where(free[:, None, None], se3.orthonormalise(se3.exp(xi) @ p.T_cw), p.T_cw)
        trial = replace(p, T_cw=T_cw, w=np.maximum(p.w + dw, 0.0))
        trial_cost, information = cost(camera, trial, scale), linear.C
        if trial_cost > now:
            damping *= 10
            yield p, information
            if damping > _MAX_DAMPING:
                return
            continue
        converged = now - trial_cost < _CONVERGED * now
        p, now, damping, linear = trial, trial_cost, max(damping / 10, 1e-9), None
        yield p, information
        if converged:
            return


def adjust(
    camera: Camera, p: Problem, free: NDArray[np.bool_], scale: float, iterations: int
) -> tuple[Problem, Float64]:
    """Optimise the free poses and all inverse depths.

    Args:
        free: [N] poses to optimise; the others hold the gauge (without measured depth two of them also hold
            the scale).
        scale: where the robust kernel sets in, in standard deviations.

    Returns:
        The optimised problem, and the information [N, M] of its inverse depths, 1 / variance given the poses, at the
        last linearisation.
    """
    *_, last = adjusting(camera, p, free, scale, iterations)
    return last
