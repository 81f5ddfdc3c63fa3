"""Sparse bundle adjustment of poses with fixed inverse depths: Gauss-Newton on L_track (Sec. III-A)."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera, Float64

_MIN_DEPTH = 0.1  # m; a patch nearer to or behind the target camera carries no information
_DAMPING = 1e-6  # relative to the diagonal: the measured depths fix the gauge, so little is needed


@dataclass(frozen=True, slots=True)
class Edges:
    """Observations of patches in other images."""

    source: NDArray[np.int64]  # [E] index of the pose that owns the patch
    target: NDArray[np.int64]  # [E] index of the pose that observes it
    points: Float64  # [E, 3] m, source camera frame
    uv: Float64  # [E, 2] px, observed position
    information: Float64  # [E, 2, 2] 1/px^2

    def __len__(self) -> int:
        return len(self.source)

    @staticmethod
    def concatenate(parts: list[Edges]) -> Edges:
        """All edges of several sets, in order."""
        if not parts:
            none = np.zeros(0, dtype=np.int64)
            return Edges(none, none, np.zeros((0, 3)), np.zeros((0, 2)), np.zeros((0, 2, 2)))
        names = ("source", "target", "points", "uv", "information")
        return Edges(*(np.concatenate([getattr(p, name) for p in parts]) for name in names))


def project_jacobian(camera: Camera, points: Float64) -> Float64:
    """d(uv)/d(xi) for a left-multiplied update exp(xi) of the camera's pose T_cw, [E, 2, 6]."""
    X, Y, Z = points.T
    d = 1.0 / Z
    zero = np.zeros_like(d)
    u = camera.fx * np.stack([d, zero, -X * d * d, -X * Y * d * d, 1 + X * X * d * d, -Y * d], axis=-1)
    v = camera.fy * np.stack([zero, d, -Y * d * d, -1 - Y * Y * d * d, X * Y * d * d, X * d], axis=-1)
    return np.stack([u, v], axis=1)


def residuals(camera: Camera, T_cw: Float64, edges: Edges) -> tuple[Float64, Float64, Float64, NDArray[np.bool_]]:
    """Residual [E, 2] px, points in the target [E, 3] m, T_target_source [E, 4, 4] and validity [E]."""
    T_ts = T_cw[edges.target] @ se3.inverse(T_cw[edges.source])
    points = np.einsum("eij,ej->ei", T_ts[:, :3, :3], edges.points) + T_ts[:, :3, 3]
    valid = points[:, 2] > _MIN_DEPTH
    points = np.where(valid[:, None], points, (0.0, 0.0, 1.0))
    uv, _ = camera.project(points)
    return np.where(valid[:, None], edges.uv - uv, 0.0), points, T_ts, valid


def robust_weight(r: Float64, information: Float64, scale: float) -> tuple[Float64, Float64]:
    """Cauchy weight [E] and cost [E] of the Mahalanobis error, ``scale`` in standard deviations."""
    squared = np.einsum("ei,eij,ej->e", r, information, r) / scale**2
    return 1.0 / (1.0 + squared), scale**2 * np.log1p(squared)


def adjust(
    camera: Camera, T_cw: Float64, edges: Edges, free: NDArray[np.bool_], scale: float, iterations: int = 8
) -> Float64:
    """Optimise the free poses; Levenberg-Marquardt steps that never raise the cost.

    Args:
        T_cw: [N, 4, 4] world to camera.
        edges: observations; inverse depths stay as measured.
        free: [N] poses to optimise; the others hold the gauge.
        scale: where the robust kernel sets in, in standard deviations of an edge.

    Returns:
        The optimised poses [N, 4, 4].
    """
    slot = np.cumsum(free) - 1
    n = int(free.sum())
    if n == 0 or len(edges) < 3:
        return T_cw

    def cost_of(T: Float64) -> float:
        r, _, _, valid = residuals(camera, T, edges)
        return float(robust_weight(r, edges.information, scale)[1][valid].sum())

    damping, cost = _DAMPING, cost_of(T_cw)
    for _ in range(iterations):
        H, b = _normal_equations(camera, T_cw, edges, free, slot, n, scale)
        step = np.linalg.solve(H + np.diag(damping * np.diag(H) + 1e-9), b)
        trial = T_cw.copy()
        # Poses are products of products: without this their rotations drift from orthonormal frame by frame.
        trial[free] = se3.orthonormalise(se3.exp(step.reshape(n, 6)) @ T_cw[free])
        trial_cost = cost_of(trial)
        if trial_cost > cost:
            damping = max(damping, 1e-6) * 100
            continue
        converged = cost - trial_cost < 1e-6 * cost
        T_cw, cost, damping = trial, trial_cost, max(damping / 10, _DAMPING)
        if converged:
            break
    return T_cw


def _normal_equations(
    camera: Camera,
    T_cw: Float64,
    edges: Edges,
    free: NDArray[np.bool_],
    slot: NDArray[np.int64],
    n: int,
    scale: float,
) -> tuple[Float64, Float64]:
    """H [6n, 6n] and b [6n] of the robustly weighted problem."""
    r, points, T_ts, valid = residuals(camera, T_cw, edges)
    weight = np.where(valid, robust_weight(r, edges.information, scale)[0], 0.0)
    W = edges.information * weight[:, None, None]
    J_t = project_jacobian(camera, points)
    J_s = -J_t @ se3.adjoint(T_ts)
    H = np.zeros((n, n, 6, 6))
    b = np.zeros((n, 6))
    ends = ((edges.target, J_t), (edges.source, J_s))
    for index_a, J_a in ends:
        on_a = free[index_a]
        JW = np.einsum("eki,ekl->eil", J_a, W)
        np.add.at(b, slot[index_a[on_a]], np.einsum("eil,el->ei", JW, r)[on_a])
        for index_b, J_b in ends:
            both = on_a & free[index_b]
            block = (JW @ J_b)[both]
            np.add.at(H, (slot[index_a[both]], slot[index_b[both]]), block)
    return H.transpose(0, 2, 1, 3).reshape(6 * n, 6 * n), b.reshape(-1)
