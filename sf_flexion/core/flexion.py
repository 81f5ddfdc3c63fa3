"""The flexion image (Loesch et al., IROS 2023): how much the surface bends at a pixel, as a grey value.

Bright is flat, dark is an edge, a crease or no data. It replaces the colour image where only depth is given.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from sf_flexion.config import FlexionConfig
from sf_interfaces.errors import CalibrationError
from sf_interfaces.types import Camera, DepthMap, Float32, UInt8

_STRIP_ROWS = 64  # rows filtered at once where the median must skip missing pixels: bounds memory


def flexion_image(depth: DepthMap, camera: Camera, config: FlexionConfig) -> UInt8:
    """Flexion of a depth map, uint8 [H, W]: 255 on a fronto-parallel plane, 0 where a neighbour is missing.

    Raises:
        CalibrationError: the depth map does not have the camera's size.
    """
    if depth.z.shape != (camera.height, camera.width):
        raise CalibrationError(
            f"depth is {depth.z.shape[1]}x{depth.z.shape[0]} but its camera {camera.width}x{camera.height}; "
            "give the calibration of the depth image"
        )
    z = np.where(depth.valid, depth.z, np.nan).astype(np.float32)
    points = _range_points(_median(z, config.median), camera)
    value = _flexion(points, config.step, config.variant)
    return np.rint(np.nan_to_num(value) * 255.0).astype(np.uint8)


def _median(z: Float32, size: int) -> Float32:
    """Median of the valid pixels of each ``size`` x ``size`` window; a missing centre stays missing."""
    if size == 1:
        return z
    missing = ~np.isfinite(z)
    holes = cv2.dilate(missing.astype(np.uint8), np.ones((size, size), np.uint8)).astype(bool)
    out = _median_dense(np.where(missing, np.float32(0), z), size)
    rows, cols = np.nonzero(holes & ~missing)  # windows with a hole: rank the valid pixels only
    r = size // 2
    padded = np.pad(z, r, constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (size, size))
    block = _STRIP_ROWS * z.shape[1]
    for start in range(0, len(rows), block):
        part = slice(start, start + block)
        ranked = np.sort(windows[rows[part], cols[part]].reshape(-1, size * size), axis=1)  # NaN sorts last
        count = np.isfinite(ranked).sum(axis=1)
        low = np.take_along_axis(ranked, ((count - 1) // 2)[:, None], axis=1)[:, 0]
        high = np.take_along_axis(ranked, (count // 2)[:, None], axis=1)[:, 0]
        out[rows[part], cols[part]] = 0.5 * (low + high)
    out[missing] = np.nan
    return out


def _median_dense(z: Float32, size: int) -> Float32:
    """Plain median filter, edges replicated. float32 is filtered natively up to 5 x 5."""
    if size <= 5:
        return cv2.medianBlur(z, size)
    r = size // 2
    out = np.empty_like(z)
    padded = np.pad(z, r, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (size, size))
    for top in range(0, z.shape[0], _STRIP_ROWS):
        strip = windows[top : top + _STRIP_ROWS]
        out[top : top + _STRIP_ROWS] = np.median(strip.reshape(*strip.shape[:2], -1), axis=2)
    return out


def _range_points(z: Float32, camera: Camera) -> Float32:
    """Range times unit ray: the surface points themselves, [H, W, 3] m."""
    return camera.unproject(camera.pixel_grid(), z.astype(np.float64)).astype(np.float32)


def _unit(v: Float32) -> Float32:
    """Unit vectors; a vector of no length has no direction and becomes NaN."""
    length = np.sqrt(np.einsum("...i,...i->...", v, v))[..., None]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(length > 0, v / length, np.float32(np.nan))


def _flexion(points: Float32, n: int, variant: str) -> NDArray[np.float32]:
    """Agreement of the normals of the straight and of the diagonal cross, [H, W] in 0..1, NaN = unknown."""
    height, width = points.shape[:2]
    value = np.full((height, width), np.nan, dtype=np.float32)
    if height <= 2 * n or width <= 2 * n:
        return value

    def at(du: int, dv: int) -> Float32:
        return points[n + dv : height - n + dv, n + du : width - n + du]

    a = _unit(at(0, n) - at(0, -n))
    b = _unit(at(n, 0) - at(-n, 0))
    c = _unit(at(-n, n) - at(n, -n))
    e = _unit(at(n, n) - at(-n, -n))
    n0, n1 = np.cross(a, b), np.cross(c, e)
    if variant != "standard":
        n0, n1 = _unit(n0), _unit(n1)
    dot = np.einsum("...i,...i->...", n0, n1)
    if variant == "angle":
        value[n:-n, n:-n] = 1.0 - np.arccos(np.clip(dot, -1.0, 1.0)) / np.pi
    else:
        value[n:-n, n:-n] = np.clip(np.abs(dot), 0.0, 1.0)
    return value
