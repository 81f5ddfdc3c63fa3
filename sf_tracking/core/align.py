"""Sub-pixel alignment of patches with gain and bias: inverse compositional, warped as the geometry predicts.

A patch seen in another image is ``I(c + A x) = g T(x + s) + b`` with the affine warp A known from depth and
pose. Linearised in the shift s this is a regression of the warped pixels on ``J = (T_u, T_v, T, 1)``, whose
normal matrix belongs to the patch alone and is inverted once. Each iteration samples the image, solves for
(g s, g, b) and moves the centre by ``-A s``.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sf_interfaces.types import Float32, Float64

_STOP_PX = 0.01
_WORTHWHILE = 0.7
_RIDGE = 1e-3  # (grey level / px)^2 per pixel; keeps the normal matrix of a flat patch invertible
_GREY = 128.0  # subtracted from grey levels: sums of squares stay small in float32


@dataclass(frozen=True, slots=True)
class Templates:
    """What alignment keeps of M patches of P pixels."""

    J: Float32  # [M, 4, P] gradients, grey levels less 128, and ones
    inverse: Float64  # [M, 4, 4] inverse of J J^T

    def __len__(self) -> int:
        return len(self.J)

    def take(self, index: NDArray[np.int64]) -> Templates:
        """The templates at ``index``."""
        return Templates(self.J[index], self.inverse[index])


@dataclass(frozen=True, slots=True)
class Alignment:
    """Where the templates were found."""

    centre: Float64  # [E, 2] continuous px
    covariance: Float64  # [E, 2, 2] px^2, from the structure tensor and the residual
    gain: Float64  # [E] contrast relative to the template
    residual: Float64  # [E] root mean square, grey levels
    explained: Float64  # [E] share of the variance of the pixels that the template explains, 0 to 1


def offsets(side: int) -> Float64:
    """Pixel offsets of a square patch from its centre, [side^2, 2] as (u, v), rows first."""
    v, u = np.mgrid[0:side, 0:side] - (side - 1) / 2
    return np.stack([u.ravel(), v.ravel()], axis=-1).astype(np.float64)


def sample(image: Float32, pixels: Float64) -> Float32:
    """Bilinear samples [E, P] at continuous pixels [E, P, 2]; the border repeats outside."""
    at = pixels.astype(np.float32) - np.float32(0.5)
    u, v = np.ascontiguousarray(at[..., 0]), np.ascontiguousarray(at[..., 1])
    if not u.size:
        return np.zeros(u.shape, np.float32)
    return np.asarray(cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def describe(image: Float32, uv: Float64, side: int) -> Templates:
    """Templates of patches at ``uv`` [M, 2] continuous px of an image [H, W]."""
    wide = sample(image, uv[:, None] + offsets(side + 2)).reshape(-1, side + 2, side + 2) - np.float32(_GREY)
    J = np.ones((len(uv), 4, side, side), np.float32)
    J[:, 0] = (wide[:, 1:-1, 2:] - wide[:, 1:-1, :-2]) / 2
    J[:, 1] = (wide[:, 2:, 1:-1] - wide[:, :-2, 1:-1]) / 2
    J[:, 2] = wide[:, 1:-1, 1:-1]
    J = J.reshape(-1, 4, side * side)
    normal = (J @ J.transpose(0, 2, 1)).astype(np.float64)
    ridge = _RIDGE * side * side * np.eye(4)
    return Templates(J, np.linalg.inv(normal + ridge))


def align(image: Float32, templates: Templates, start: Float64, warp: Float64, iterations: int) -> Alignment:
    """Find templates in ``image`` [H, W] near ``start`` [E, 2] px, warped by ``warp`` [E, 2, 2]."""
    count, pixels = len(templates), templates.J.shape[2]
    spread = offsets(round(np.sqrt(pixels))).astype(np.float32) @ warp.transpose(0, 2, 1).astype(np.float32)
    centre = np.array(start)
    solution, residual, explained = np.zeros((count, 4)), np.zeros(count), np.zeros(count)
    active, J, inverse = np.arange(count), templates.J, templates.inverse
    for _ in range(iterations):
        values = sample(image, centre[active, None].astype(np.float32) + spread) - np.float32(_GREY)
        moment = (J @ values[..., None])[..., 0].astype(np.float64)
        x = (inverse @ moment[..., None])[..., 0]
        energy = (values[:, None] @ values[..., None])[:, 0, 0].astype(np.float64)
        left = np.maximum(energy - (moment * x).sum(axis=1), 0.0)
        variance = np.maximum(energy - moment[:, 3] ** 2 / pixels, 1e-9)
        solution[active], residual[active], explained[active] = x, left, 1.0 - left / variance
        gain = np.where(np.abs(x[:, 2]) > 0.05, x[:, 2], np.inf)
        shift = np.clip(x[:, :2] / gain[:, None], -2.0, 2.0)
        step = (warp[active] @ shift[..., None])[..., 0]
        centre[active] -= step
        moving = np.abs(step).max(axis=1) > _STOP_PX
        if not moving.any():
            break
        if moving.mean() < _WORTHWHILE:  # copying what still moves is cheaper than going on with all
            active, J, inverse, spread = active[moving], J[moving], inverse[moving], spread[moving]
    noise = residual / (pixels - 4)
    gain = solution[:, 2]
    spread_px = noise / np.maximum(gain**2, 1e-4)
    covariance = warp @ templates.inverse[:, :2, :2] @ warp.transpose(0, 2, 1) * spread_px[:, None, None]
    return Alignment(centre, covariance, gain, np.sqrt(noise), explained)
