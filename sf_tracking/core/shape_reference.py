"""What the compiled parts of surface alignment compute, in numpy; the tests hold one against the other."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera, Float32, Float64
from sf_tracking.core.bundle_reference import robust


def thin(z: Float32, step: int) -> tuple[NDArray[np.int64], Float64, Float64]:
    """Planes through the inverse depths of each block of ``step``.

    How many pixels are known, depth in the middle, and the deviation from the plane relative to it; 0 without any.

    Args:
        z: [H, W] m; NaN, infinite or not positive: unknown.
    """
    h, w = z.shape[0] // step, z.shape[1] // step
    block = z[: h * step, : w * step].reshape(h, step, w, step).transpose(0, 2, 1, 3).reshape(h, w, step * step)
    known = (block > 0) & np.isfinite(block)
    W = np.where(known, 1.0 / np.where(known, block, 1.0).astype(np.float64), 0.0)
    v, u = ((g - (step - 1) / 2).ravel() for g in np.mgrid[0:step, 0:step])
    A = np.stack([np.ones(step * step), u, v], axis=-1) * known[..., None]  # [h, w, step^2, 3]
    At = A.swapaxes(-1, -2)
    plane = np.linalg.solve(At @ A + 1e-9 * np.eye(3), At @ W[..., None])
    left = np.where(known, W - (A @ plane)[..., 0], 0.0)
    count, middle = known.sum(axis=-1), plane[..., 0, 0]
    good = (count > 0) & (middle > 0)
    middle = np.where(good, middle, 1.0)
    deviation = np.sqrt((left**2).sum(axis=-1) / np.maximum(count, 1)) / middle
    return count, np.where(good, 1.0 / middle, 0.0), np.where(good, deviation, 0.0)


def partners(camera: Camera, T: Float64, source: Float64, grid: NDArray[np.int64]) -> NDArray[np.int64]:
    """Index of the target's point on whose cell each source point [K, 3], moved by T, falls, -1: none."""
    h, w = grid.shape
    uv, z = camera.project(se3.transform(T, source))
    with np.errstate(invalid="ignore"):
        cell = np.floor(np.nan_to_num(uv) * (w / camera.width, h / camera.height)).astype(np.int64)
        inside = (cell >= 0).all(axis=1) & (cell < (w, h)).all(axis=1) & (z > 0)
    return np.where(inside, grid[np.clip(cell[:, 1], 0, h - 1), np.clip(cell[:, 0], 0, w - 1)], -1)


def plane_system(
    T: Float64, source: Float64, sigma: Float64, partner: NDArray[np.int64], points: Float64, normals: Float64,
    reach: float, scale: float, least: float, trust: float,
) -> tuple[Float64, Float64, int, int]:  # fmt: skip
    """H [6, 6], g [6] of the robust distances of source points [K, 3], moved by T, to the planes of partners.

    And how many points count, and how many have a partner, however far.

    Args:
        sigma: [K] m, deviation of the points at most; how much smaller it is the distances themselves tell.
        reach: relative to depth, how far apart partners may lie.
        least: share of ``sigma`` that is believed at least.
    """
    n, p, moved = normals[partner], points[partner], se3.transform(T, source)
    r = ((p - moved) * n).sum(axis=1)
    with np.errstate(invalid="ignore"):
        met = (partner >= 0) & np.isfinite(r) & (sigma > 0)
        good = met & (np.linalg.norm(p - moved, axis=1) < reach * moved[:, 2])
    if not good.any():
        return np.zeros((6, 6)), np.zeros(6), 0, int(met.sum())
    n, r, moved = n[good], r[good], moved[good]
    deviation = sigma[good] * max(least, 1.4826 * np.median(np.abs(r) / sigma[good]))
    weight = robust((r / deviation) ** 2, scale)[0] / deviation**2 * trust
    J = np.concatenate([n, np.cross(moved, n)], axis=1)
    return (J * weight[:, None]).T @ J, (J * weight[:, None]).T @ r, int(good.sum()), int(met.sum())
