"""Which correspondences can be trusted (paper Sec. Cross Check, Static Check, In-image Epipole Check).

All limits are in pixels of an image 640 wide and scale with the image. They use the intrinsics and poses of the
moment and are run again as these improve.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np

from sf_depth.core import pinhole
from sf_depth.core.dense_ba import Estimate
from sf_depth.core.matching import Correspondence, pixel_grid
from sf_interfaces.geometry import se3
from sf_interfaces.types import Float32, Float64

_CROSS = 1.0  # px; a match and its match back must meet within it
_STATIC = 3.84  # px^2; squared distance to the epipolar line, both ways
_PARALLAX = np.cos(np.radians(0.6))  # rays closer than this say nothing about depth
_EPIPOLE = np.radians(4.0)  # rays nearer to the epipole pass every epipolar check
_LEAST_CONFIDENCE = 0.1


def cross_check(found: Correspondence) -> Float32:
    """Confidence [H, W] of the matches that come back to where they started."""
    shape = found.confidence.shape
    off = np.linalg.norm(found.back - pixel_grid(shape), axis=2)
    with np.errstate(invalid="ignore"):
        good = (off < _CROSS * shape[1] / 640) & np.isfinite(found.target[..., 0])
    good &= found.confidence >= _LEAST_CONFIDENCE
    return np.where(good, found.confidence, 0.0).astype(np.float32)


def geometric_check(theta: Float64, T: Float64, uv: Float64, target: Float64, width: int) -> np.ndarray:
    """Static, parallax and epipole checks of one source, [N].

    Args:
        T: T_source_reference.
        uv, target: corresponding pixels [2, N].
    """
    x, y = pinhole.rays(theta, uv), pinhole.rays(theta, target)
    X, Y = np.vstack([x, np.ones_like(x[:1])]), np.vstack([y, np.ones_like(y[:1])])
    t = T[:3, 3]
    if not t.any():
        return np.zeros(uv.shape[1], bool)
    E = se3.hat(t) @ T[:3, :3]
    line, line_back = E @ X, E.T @ Y
    product = (Y * line).sum(axis=0)
    gate = _STATIC * (width / 640) ** 2 / theta[0] ** 2
    static = product**2 < gate * np.minimum((line[:2] ** 2).sum(axis=0), (line_back[:2] ** 2).sum(axis=0))
    a = T[:3, :3] @ X
    a /= np.linalg.norm(a, axis=0)
    b = Y / np.linalg.norm(Y, axis=0)
    e = t / np.linalg.norm(t)
    parallax = (a * b).sum(axis=0) < _PARALLAX
    away = np.abs(e @ b) < np.cos(_EPIPOLE)
    away &= np.abs(e @ a) < np.cos(_EPIPOLE)
    return static & parallax & away


def checked(weight: Float64, uv: Float64, target: Float64, at: Estimate, width: int) -> Float64:
    """Weights [S, N] of observations that pass the geometric checks of an estimate, the others 0."""
    out = np.zeros_like(weight)
    for j, T in enumerate(at.T):
        use = weight[j] > 0
        good = geometric_check(at.theta, T, uv[:, use], target[j][:, use], width)
        out[j, use] = np.where(good, weight[j, use], 0.0)
    return out
