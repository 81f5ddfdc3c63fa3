"""Inverse depth of every pixel for known poses and intrinsics, and its variance.

One unknown a pixel: the linear triangulation equations, reweighted so that they measure pixels, with a robust
kernel over the sources. This is the ``depth only`` step of dense bundle adjustment at full resolution.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from sf_depth.core import pinhole
from sf_depth.core.dense_ba import Adjusted, Estimate, Observations
from sf_depth.core.matching import pixel_grid
from sf_interfaces.types import Float32, Float64

_ROUNDS = 4  # of reweighting
_KERNEL = 2.5  # deviations at which the Cauchy kernel sets in
_GATE = 3.0  # px at a width of 640; a depth must explain at least one source within it
_MIN_Z = 0.05
# Measured against exact and sensor depth, alike on simulated and real images: a correspondence is this much less
# sure along the epipolar line than its residual across it says, and a depth that few sources confirm less still.
_COMMON = 3.0
_UNCHECKED = 0.3  # px at a width of 640, for one source; falls with the square of their number
_CORRELATION = 7.0  # what neighbouring errors have in common, in deviations of poses and intrinsics


@dataclass(frozen=True, slots=True)
class InverseDepth:
    """Inverse depth [H, W] with variance, NaN = none, and how many sources agree with it [H, W]."""

    d: Float32
    variance: Float32
    support: Float32


def solve(at: Estimate, target: Float32, weight: Float32, sigma: float) -> InverseDepth:
    """The inverse depth that explains the correspondences of all sources.

    Args:
        target: [S, H, W, 2] px; weight: [S, H, W], 0 = not seen; sigma: px.
    """
    shape = weight.shape[1:]
    x = pinhole.rays(at.theta, pixel_grid(shape).reshape(-1, 2).T.astype(np.float64)).astype(np.float32)
    parts = [_equations(at.theta, T, x, target[j], weight[j]) for j, T in enumerate(at.T)]
    d = np.ones(x.shape[1], np.float32)
    focal, c2 = np.float32(at.theta[0]), np.float32((_KERNEL * sigma) ** 2)
    robust = [w for *_, w in parts]
    for _ in range(_ROUNDS):
        top, bottom = np.full_like(d, 1e-30), np.full_like(d, 1e-30)
        for (a, b, m2, t2, _), r in zip(parts, robust):
            scale = focal / np.maximum(m2 + t2 * d, _MIN_Z)
            information = r * scale**2
            top += information * (a * b).sum(axis=0)
            bottom += information * (a * a).sum(axis=0)
        d = np.maximum(top / bottom, np.float32(1e-6))
        robust = []
        for a, b, m2, t2, w in parts:
            scale = focal / np.maximum(m2 + t2 * d, _MIN_Z)
            r2 = ((a * d - b) ** 2).sum(axis=0) * scale**2
            robust.append(w / (1.0 + r2 / c2))
    return _result(d, parts, robust, focal, sigma, shape)


def _equations(theta: Float64, T: Float64, x: Float32, target: Float32, weight: Float32) -> tuple:
    """a [2, N], b [2, N] of ``a d = b``, depth terms m2 + t2 d of the source, and the weight [N]."""
    w = weight.reshape(-1)
    uv = np.where(w > 0, target.reshape(-1, 2).T, np.float32(0))
    y = pinhole.rays(theta, uv.astype(np.float64)).astype(np.float32)
    R, t = T[:3, :3].astype(np.float32), T[:3, 3].astype(np.float32)
    m = R[:, :2] @ x + R[:, 2:3]
    a = np.stack([t[0] - y[0] * t[2], t[1] - y[1] * t[2]])
    b = np.stack([y[0] * m[2] - m[0], y[1] * m[2] - m[1]])
    return a, b, m[2], t[2], w


def _result(
    d: Float32, parts: list, robust: list, focal: np.float32, sigma: float, shape: tuple[int, int]
) -> InverseDepth:
    """Keep what a source explains, with the variance of the best source.

    All sources share the reference pixel and what the flow makes of its surroundings, so their errors do not
    average out: only agreement of several sources, not their number, makes a depth sure.
    """
    unit = shape[1] / 640
    support, misfit, total, best = (np.zeros_like(d) for _ in range(4))
    for (a, b, m2, t2, w), r in zip(parts, robust):
        scale = focal / np.maximum(m2 + t2 * d, _MIN_Z)
        r2 = ((a * d - b) ** 2).sum(axis=0) * scale**2
        good = (w > 0) & (r2 < (_GATE * unit) ** 2)
        kept = np.where(good, r, 0)
        support += good
        misfit += kept * r2
        total += kept
        best = np.maximum(best, np.where(good, scale**2 * (a * a).sum(axis=0), 0))
    none = (support == 0) | (d <= 1e-5)
    own = np.maximum((misfit + sigma**2) / (total + 0.5), sigma**2)  # px^2, drawn to that of the whole image
    own += (_UNCHECKED * unit / np.maximum(support, 1) ** 2) ** 2
    variance = _COMMON**2 * own / np.maximum(best, 1e-30)
    d, variance = np.where(none, np.nan, d), np.where(none, np.nan, variance)
    return InverseDepth(d.reshape(shape), variance.reshape(shape), support.reshape(shape))


def common_variance(adjusted: Adjusted, seen: Observations, grid: tuple[int, int], shape: tuple[int, int]) -> Float32:
    """What poses and intrinsics contribute to the variance of inverse depth, spread over the image [H, W]."""
    used = (seen.weight > 0).any(axis=0)
    relative = np.where(used, adjusted.common_variance / adjusted.estimate.inverse_depth**2, np.nan)
    relative *= _CORRELATION**2
    filled = np.nan_to_num(relative, nan=float(np.nanmedian(relative)))
    own = (filled * adjusted.estimate.inverse_depth**2).reshape(grid).astype(np.float32)
    return np.asarray(cv2.resize(own, shape[::-1], interpolation=cv2.INTER_LINEAR))


def focal_deviation(adjusted: Adjusted) -> float:
    """Posterior deviation of a free focal length relative to it."""
    index = 6 * len(adjusted.estimate.T)
    return _CORRELATION * float(np.sqrt(adjusted.covariance[index, index]))
