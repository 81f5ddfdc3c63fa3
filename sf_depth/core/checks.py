"""Which correspondences can be trusted (paper Sec. Cross Check, Static Check, In-image Epipole Check).

All limits are in pixels of an image 640 wide and scale with the image. They use the intrinsics and poses of the
moment and are run again as these improve.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np

from sf_depth.core import pinhole
from sf_depth.core.dense_ba import Estimate, steadied
from sf_depth.core.matching import Correspondence, pixel_grid
from sf_depth.core.start import Size
from sf_interfaces.geometry import se3
from sf_interfaces.types import Float32, Float64

_CROSS = 1.0  # px; a match and its match back must meet within it
_STATIC = 3.84  # px^2; squared distance to the epipolar line, both ways
_PARALLAX = np.cos(np.radians(0.6))  # rays closer than this say nothing about depth
_EPIPOLE = np.radians(4.0)  # rays nearer to the epipole pass every epipolar check
_LEAST_CONFIDENCE = 0.1


def cross_check(found: Correspondence, size: Size) -> Float32:
    """Confidence [h, w] of the matches that come back to where they started, for images of ``size``."""
    height, width = found.confidence.shape
    off = found.back - pixel_grid((height, width)) * np.array([size.width / width, size.height / height], np.float32)
    squares = off[..., 0] ** 2 + off[..., 1] ** 2
    good = (squares < (_CROSS * size.unit) ** 2) & (found.confidence >= _LEAST_CONFIDENCE)
    good &= np.isfinite(found.target[..., 0])
    return np.where(good, found.confidence, np.float32(0))


def geometric_check(theta: Float64, T: Float64, x: np.ndarray, target: np.ndarray, width: int) -> np.ndarray:
    """Static, parallax and epipole checks of one source, [N].

    Args:
        T: T_source_reference.
        x: rays of the reference [2, N]; target: their pixels in the source [2, N].
    """
    t, R = T[:3, 3], T[:3, :3]
    if not t.any():
        return np.zeros(x.shape[1], bool)
    y = pinhole.rays(theta, target)
    e = t / np.linalg.norm(t)
    a, b = _affine(R, x), np.concatenate([y, np.ones_like(y[:1])])
    line, line_back = _affine(se3.hat(t) @ R, x), _affine((se3.hat(t) @ R).T, y)
    product = (b * line).sum(axis=0)
    gate = _STATIC * (width / 640) ** 2 / theta[0] ** 2
    static = product**2 < gate * np.minimum(line[0] ** 2 + line[1] ** 2, line_back[0] ** 2 + line_back[1] ** 2)
    lengths = np.sqrt((a * a).sum(axis=0)), np.sqrt((b * b).sum(axis=0))
    parallax = (a * b).sum(axis=0) < _PARALLAX * lengths[0] * lengths[1]
    limit = np.cos(_EPIPOLE)
    away = np.abs(e.astype(x.dtype) @ b) < limit * lengths[1]
    away &= np.abs(e.astype(x.dtype) @ a) < limit * lengths[0]
    return static & parallax & away


def _affine(M: Float64, x: np.ndarray) -> np.ndarray:
    """M (x, 1) [3, N] of points [2, N], in their precision."""
    M = M.astype(x.dtype)
    return np.asarray(M[:, :2] @ x + M[:, 2:])


def checked(weight: np.ndarray, uv: np.ndarray, target: np.ndarray, at: Estimate, width: int) -> np.ndarray:
    """Weights [S, N] of observations that pass the geometric checks of an estimate, the others 0.

    Args:
        uv: reference pixels [2, N]; target: source pixels [S, 2, N], anything finite where the weight is 0.
    """
    x, target = pinhole.rays(at.theta, uv), steadied(at, target)
    good = [geometric_check(at.theta, T, x, target[j], width) for j, T in enumerate(at.T)]
    return np.where(good, weight, np.zeros((), weight.dtype))
