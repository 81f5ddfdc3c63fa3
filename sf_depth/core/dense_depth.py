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
from sf_depth.core.dense_ba import Estimate, Observations
from sf_depth.core.posterior import Adjusted
from sf_interfaces.types import Float32, Float64

_ROUNDS = 4  # of reweighting
_KERNEL = 2.5  # deviations at which the Cauchy kernel sets in
_GATE = 3.0  # px at a width of 640; a depth must explain at least one source within it
_MIN_Z = 0.05
_LEAST_EVIDENCE = 0.35  # weight of the sources that agree, times their number: one alone has to look alike
# Measured against exact and sensor depth, alike on simulated and real images: a correspondence is this much less
# sure along the epipolar line than its residual across it says, and a depth that few sources confirm less still.
_COMMON = 2.5
_UNCHECKED = 0.3  # px at a width of 640, for one source; falls with the square of their number


@dataclass(frozen=True, slots=True)
class InverseDepth:
    """Inverse depth with variance, NaN = none, and how many sources agree with it; arrays of one shape."""

    d: Float32
    variance: Float32
    support: Float32


@dataclass(frozen=True, slots=True)
class _Equation:
    """``a d = p`` along the epipolar line of one source, [N] each: a residual is ``(a d - p) f / z``.

    Args:
        square: squared distance of the match to the line, in the same unit.
        m, t: depth of the point in the source, in units of the reference depth, is ``m + t d``.
        weight: confidence, 0 = not seen.
    """

    a: Float32
    p: Float32
    square: Float32
    m: Float32
    t: np.float32
    weight: Float32

    def scale(self, focal: np.float32, d: Float32) -> Float32:
        """px^2 of a unit squared residual, [N]."""
        return np.asarray((focal / np.maximum(self.m + self.t * d, np.float32(_MIN_Z))) ** 2)

    def misfit(self, d: Float32) -> Float32:
        """Squared residual [N], before it is brought to px^2 by ``scale``."""
        return np.asarray((self.a * d - self.p) ** 2 + self.square)


def solve(at: Estimate, uv: Float32, target: Float32, weight: Float32, sigma: float, width: int) -> InverseDepth:
    """The inverse depth [N] that explains the correspondences of all sources.

    Args:
        uv: reference pixels [2, N]; target: [S, 2, N] px, anything finite where the weight [S, N] is 0.
        sigma: deviation of a correspondence, px; width: of the image, px.
    """
    x = pinhole.rays(at.theta, uv)
    parts = [_equation(at.theta, T, x, target[j], weight[j]) for j, T in enumerate(at.T)]
    focal, c2 = np.float32(at.theta[0]), np.float32((_KERNEL * sigma) ** 2)
    d = np.ones(x.shape[1], np.float32)
    robust = [part.weight for part in parts]
    for _ in range(_ROUNDS):
        top, bottom = np.full_like(d, 1e-30), np.full_like(d, 1e-30)
        for part, r in zip(parts, robust, strict=True):
            information = r * part.scale(focal, d) * part.a
            top += information * part.p
            bottom += information * part.a
        d = np.maximum(top / bottom, np.float32(1e-6))
        robust = [part.weight / (1 + part.misfit(d) * part.scale(focal, d) / c2) for part in parts]
    return _result(d, parts, robust, focal, sigma, width / 640)


def _equation(theta: Float64, T: Float64, x: Float32, target: Float32, weight: Float32) -> _Equation:
    """One source's equation, turned into the epipolar line and across it."""
    y = pinhole.rays(theta, target)
    R, t = T[:3, :3].astype(np.float32), T[:3, 3].astype(np.float32)
    m = R[:, :2] @ x + R[:, 2:3]
    a = (t[0] - y[0] * t[2], t[1] - y[1] * t[2])
    b = (y[0] * m[2] - m[0], y[1] * m[2] - m[1])
    length = np.maximum(np.sqrt(a[0] ** 2 + a[1] ** 2), np.float32(1e-12))
    along, across = (a[0] * b[0] + a[1] * b[1]) / length, (a[0] * b[1] - a[1] * b[0]) / length
    return _Equation(length, along, across**2, m[2], t[2], weight)


def _result(
    d: Float32, parts: list[_Equation], robust: list[Float32], focal: np.float32, sigma: float, unit: float
) -> InverseDepth:
    """Keep what a source explains, with the variance of the best source.

    All sources share the reference pixel and what the flow makes of its surroundings, so their errors do not
    average out: only agreement of several sources, not their number, makes a depth sure.
    """
    support, misfit, total, best = (np.zeros_like(d) for _ in range(4))
    for part, r in zip(parts, robust, strict=True):
        scale = part.scale(focal, d)
        r2 = part.misfit(d) * scale
        good = (part.weight > 0) & (r2 < (_GATE * unit) ** 2)
        kept = np.where(good, r, np.float32(0))
        support += good
        misfit += kept * r2
        total += kept
        best = np.maximum(best, np.where(good, scale * part.a**2, np.float32(0)))
    none = (total * support < _LEAST_EVIDENCE) | (d <= 1e-5)
    own = np.maximum((misfit + sigma**2) / (total + 0.5), sigma**2)  # px^2, drawn to that of the whole image
    own += (_UNCHECKED * unit / np.maximum(support, 1) ** 2) ** 2
    variance = _COMMON**2 * own / np.maximum(best, 1e-30)
    gap = np.float32(np.nan)
    return InverseDepth(np.where(none, gap, d), np.where(none, gap, variance).astype(np.float32), support)


def common_variance(adjusted: Adjusted, seen: Observations, grid: tuple[int, int], shape: tuple[int, int]) -> Float32:
    """What poses and intrinsics contribute to the variance of inverse depth, spread over the image [H, W]."""
    used = (seen.weight > 0).any(axis=0)
    relative = np.where(used, adjusted.common_variance / adjusted.estimate.inverse_depth**2, np.nan)
    filled = np.nan_to_num(relative, nan=float(np.nanmedian(relative)))
    own = (filled * adjusted.estimate.inverse_depth**2).reshape(grid).astype(np.float32)
    return np.asarray(cv2.resize(own, shape[::-1], interpolation=cv2.INTER_LINEAR))


def focal_deviation(adjusted: Adjusted) -> float:
    """Posterior deviation of a free focal length relative to it."""
    index = 6 * len(adjusted.estimate.T)
    return float(np.sqrt(adjusted.covariance[index, index]))
