"""What the compiled bundle adjustment computes, in numpy; the tests hold one against the other."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np

from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera, Float64
from sf_tracking.core.bundle import MIN_Z, Linear, Problem, motion_error, motions, project


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


def whiten(r: Float64, root: Float64) -> Float64:
    """Residuals [..., M, 2] px in standard deviations, [..., 2, M]."""
    u = root[..., 0] * r[..., 0] + root[..., 1] * r[..., 1]
    return np.stack([u, root[..., 2] * r[..., 1]], axis=-2)


def robust(squared: Float64, scale: float) -> tuple[Float64, Float64]:
    """Cauchy weight and cost of squared Mahalanobis errors; ``scale`` in standard deviations."""
    relative = squared / scale**2
    return 1.0 / (1.0 + relative), scale**2 * np.log1p(relative)


def _residuals(camera: Camera, p: Problem) -> tuple[Float64, Float64, Float64]:
    """Whitened r [N, N, 2, M], the roots [N, N, M, 3] (both 0 where nothing is seen), scaled points [N, N, M, 3]."""
    uv, X = project(camera, motions(p), p.rays[:, None], p.w[:, None])
    seen = ((X[..., 2] > MIN_Z) & np.isfinite(p.uv).all(axis=-1))[..., None]
    root = np.where(seen, p.root, 0.0)
    return whiten(np.where(seen, p.uv - uv, 0.0), root), root, np.where(seen, X, (0.0, 0.0, 1.0))


def cost(camera: Camera, p: Problem, scale: float) -> float:
    """See :func:`.bundle.cost`."""
    squared = (_residuals(camera, p)[0] ** 2).sum(axis=2)
    depth = p.prior_weight * (p.prior - p.w) ** 2
    e, pull = motion_error(p, motions(p))
    return float(robust(squared, scale)[1].sum() + robust(depth, scale)[1].sum() + (e * pull).sum())


def linearise(camera: Camera, p: Problem, scale: float) -> Linear:
    """See :func:`.bundle.linearise`."""
    n, m = p.w.shape
    T_ts = motions(p)
    r, root, X = _residuals(camera, p)
    weight = np.sqrt(robust((r**2).sum(axis=2), scale)[0])  # [N, N, M]
    w = np.broadcast_to(p.w[:, None], weight.shape)
    J, J_w = jacobians(camera, X, w, T_ts[..., :3, 3], root * weight[..., None])
    r = r * weight[:, :, None]
    couple = (J * J_w[:, :, None]).sum(axis=3)  # [N, N, 6, M]
    J = J.reshape(n, n, 6, 2 * m)
    own = J @ J.transpose(0, 1, 3, 2)  # [N, N, 6, 6] of the target's pose, for each pair
    g = (J @ r.reshape(n, n, 2 * m, 1))[..., 0]  # [N, N, 6]
    own += p.motion_information
    g -= motion_error(p, T_ts)[1]
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
    return Linear(
        H.transpose(0, 2, 1, 3).reshape(6 * n, 6 * n), b.reshape(-1), C, c, E.transpose(1, 2, 0, 3).reshape(6 * n, -1)
    )


def eliminate(E: Float64, C: Float64, c: Float64, H: Float64, b: Float64) -> tuple[Float64, Float64]:
    """The Schur complement of the inverse depths: ``H - E C^-1 E^T`` and ``b - E C^-1 c``."""
    over = E / C
    return H - over @ E.T, b - over @ c
