"""What the compiled alignment of patches computes, in numpy; the tests hold one against the other."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sf_interfaces.types import Float32, Float64
from sf_tracking.core.align import Alignment, Limits, Templates

_STOP_PX = 0.01
_RIDGE = 1e-3  # (grey level / px)^2 per pixel; keeps the normal matrix of a flat patch invertible
_GREY = 128.0  # subtracted from grey levels: sums of squares stay small in float32
_MIN_GAIN, _MAX_SHIFT = 0.05, 2.0  # contrast below which a shift says nothing; px moved at most in one step


def offsets(side: int) -> Float64:
    """Pixel offsets of a square patch from its centre, [side^2, 2] as (u, v), rows first."""
    v, u = np.mgrid[0:side, 0:side] - (side - 1) / 2
    return np.stack([u.ravel(), v.ravel()], axis=-1).astype(np.float64)


def sample(image: Float32, pixels: Float64) -> Float32:
    """Bilinear samples [E, P] at continuous pixels [E, P, 2]; the border repeats outside."""
    height, width = image.shape
    at = np.clip(pixels.astype(np.float32) - np.float32(0.5), 0, np.float32([width - 1, height - 1]))
    col, row = at.astype(np.int64).transpose(2, 0, 1)
    u, v = (at - np.floor(at)).transpose(2, 0, 1)
    right, down = np.minimum(col + 1, width - 1), np.minimum(row + 1, height - 1)
    top = image[row, col] + u * (image[row, right] - image[row, col])
    bottom = image[down, col] + u * (image[down, right] - image[down, col])
    return np.asarray(top + v * (bottom - top))


def describe(image: Float32, uv: Float64, side: int) -> Templates:
    """See :func:`.align.describe`."""
    wide = sample(image, uv[:, None] + offsets(side + 2)).reshape(-1, side + 2, side + 2) - np.float32(_GREY)
    J = np.ones((len(uv), 4, side, side), np.float32)
    J[:, 0] = (wide[:, 1:-1, 2:] - wide[:, 1:-1, :-2]) / 2
    J[:, 1] = (wide[:, 2:, 1:-1] - wide[:, :-2, 1:-1]) / 2
    J[:, 2] = wide[:, 1:-1, 1:-1]
    J = J.reshape(-1, 4, side * side)
    normal = (J @ J.transpose(0, 2, 1)).astype(np.float64)
    return Templates(J, np.linalg.inv(normal + _RIDGE * side * side * np.eye(4)), np.arange(len(uv)))


def align(image: Float32, templates: Templates, start: Float64, warp: Float64, iterations: int) -> Alignment:
    """See :func:`.align.align`."""
    count, pixels = len(templates), templates.J.shape[2]
    spread = offsets(round(np.sqrt(pixels))).astype(np.float32) @ warp.transpose(0, 2, 1).astype(np.float32)
    centre, active = (
        np.full((count, 2), np.nan),
        np.flatnonzero(np.isfinite(start).all(1) & np.isfinite(warp).all((1, 2))),
    )
    centre[active] = start[active]
    solution, explained = np.zeros((count, 4)), np.zeros(count)
    residual = np.full(count, np.inf)
    normal_inverse = templates.inverse[templates.rows]
    for _ in range(iterations):
        J, inverse = templates.J[templates.rows[active]], normal_inverse[active]
        values = sample(image, centre[active, None].astype(np.float32) + spread[active]) - np.float32(_GREY)
        moment = (J @ values[..., None])[..., 0].astype(np.float64)
        x = (inverse @ moment[..., None])[..., 0]
        energy = (values**2).sum(axis=1, dtype=np.float64)
        left = np.maximum(energy - (moment * x).sum(axis=1), 0.0)
        variance = np.maximum(energy - moment[:, 3] ** 2 / pixels, 1e-9)
        solution[active], residual[active], explained[active] = x, left, 1.0 - left / variance
        gain = np.where(np.abs(x[:, 2]) > _MIN_GAIN, x[:, 2], np.inf)
        shift = np.clip(x[:, :2] / gain[:, None], -_MAX_SHIFT, _MAX_SHIFT)
        step = (warp[active] @ shift[..., None])[..., 0]
        centre[active] -= step
        active = active[np.abs(step).max(axis=1) > _STOP_PX]
        if len(active) == 0:
            break
    noise, gain = residual / (pixels - 4), solution[:, 2]
    known = np.isfinite(centre).all(axis=1)
    spread_px = np.where(known, noise / np.maximum(gain**2, 1e-4), np.nan)
    covariance = warp @ normal_inverse[:, :2, :2] @ warp.transpose(0, 2, 1) * spread_px[:, None, None]
    return Alignment(centre, covariance, gain, np.sqrt(noise), explained)


def judge(
    found: Alignment, start: Float64, shape: tuple[int, ...], limits: Limits
) -> tuple[Float64, NDArray[np.bool_]]:
    """See :func:`.align.judge`."""
    low, high = limits.border, np.array(shape[::-1]) - limits.border
    ok = (found.centre >= low).all(axis=1) & (found.centre <= high).all(axis=1)
    ok &= (found.explained > limits.explained) | (found.residual < limits.noise)
    ok &= (found.residual < limits.residual) & (found.gain > 1 / limits.gain) & (found.gain < limits.gain)
    ok &= np.linalg.norm(found.centre - start, axis=1) < limits.reach
    return np.linalg.inv(found.covariance + limits.own**2 * np.eye(2)), ok
