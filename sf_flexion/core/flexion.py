"""The flexion image (Loesch et al., IROS 2023): how much the surface bends at a pixel, as a grey value.

Bright is flat, dark is an edge, a crease or no data. It replaces the colour image where only depth is given.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from sf_flexion.config import FlexionConfig
from sf_flexion.core.median import median
from sf_flexion.core.noise import choose_step
from sf_interfaces.errors import CalibrationError
from sf_interfaces.types import Camera, DepthMap, Float32

_STRIP_PIXELS = 1 << 14  # computed at once: all intermediate images stay in the cache

Vector = tuple[Float32, Float32, Float32]
"""x, y and z of a vector per pixel, apart: three plain images are faster than one with three channels."""


class Flexion:
    """Depth maps of one camera to flexion images; remembers the step that suits its noise (``step: 0``)."""

    def __init__(self, config: FlexionConfig) -> None:
        self._config = config
        self.step: int | None = config.step or None

    def __call__(self, depth: DepthMap, camera: Camera) -> NDArray[np.uint8] | NDArray[np.uint16]:
        """The flexion image [H, W], uint8 or (``bits: 16``) uint16: full on a plane, 0 where unknown.

        Raises:
            CalibrationError: the depth map does not have the camera's size.
        """
        full, kind = (65535, np.uint16) if self._config.bits == 16 else (255, np.uint8)
        image = np.zeros(depth.z.shape, kind)
        for inner, value in self._strips(depth, camera):
            value[np.isnan(value)] = 0.0
            image[inner] = np.rint(np.multiply(value, np.float32(full), out=value), out=value)
        return image

    def value(self, depth: DepthMap, camera: Camera) -> Float32:
        """The flexion [H, W] itself, in 0..1; NaN where one of the eight neighbours has no depth.

        Raises:
            CalibrationError: the depth map does not have the camera's size.
        """
        out = np.full(depth.z.shape, np.nan, dtype=np.float32)
        for inner, value in self._strips(depth, camera):
            out[inner] = value
        return out

    def _strips(self, depth: DepthMap, camera: Camera) -> Iterator[tuple[tuple[slice, slice], Float32]]:
        """Where in the image, and its flexion, strip by strip; the border of ``step`` px has none."""
        height, width = depth.z.shape
        if (height, width) != (camera.height, camera.width):
            raise CalibrationError(
                f"depth is {width}x{height} but its camera {camera.width}x{camera.height}; "
                "give the calibration of the depth image"
            )
        z = median(np.where(depth.valid, depth.z, np.float32(np.nan)), self._config.median)
        n = self.step = self._config.step or choose_step(z, camera, self.step)
        if height <= 2 * n or width <= 2 * n:
            return
        x = ((np.arange(width) + 0.5 - camera.cx) / camera.fx).astype(np.float32)
        y = ((np.arange(height) + 0.5 - camera.cy) / camera.fy).astype(np.float32)[:, None]
        count = max(8, _STRIP_PIXELS // width)
        for top in range(n, height - n, count):
            end = min(top + count, height - n)
            rows = slice(top - n, end + n)
            points = (z[rows] * x, z[rows] * y[rows], z[rows])  # range times unit ray: the surface points, m
            yield np.s_[top:end, n:-n], _agreement(points, n, self._config.variant)


def flexion_image(depth: DepthMap, camera: Camera, config: FlexionConfig) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """One depth map to its flexion image; see :class:`Flexion`."""
    return Flexion(config)(depth, camera)


def _agreement(points: Vector, n: int, variant: str) -> Float32:
    """n0 . n1 of the four central differences of a strip, by variant; the border of ``n`` px is left out."""
    height, width = points[0].shape

    def difference(du: int, dv: int) -> Vector:
        ahead = np.s_[n + dv : height - n + dv, n + du : width - n + du]
        behind = np.s_[n - dv : height - n - dv, n - du : width - n - du]
        x, y, z = (p[ahead] - p[behind] for p in points)
        return x, y, z

    a, b, c, e = difference(0, n), difference(n, 0), difference(-n, n), difference(n, n)
    n0, n1 = _cross(a, b), _cross(c, e)
    lengths = (n0, n1) if variant != "standard" else (a, b, c, e)
    value = _dot(n0, n1)
    # A direction without length, or a normal without area, gives 0 / 0: unknown, as it should be.
    with np.errstate(divide="ignore", invalid="ignore"):
        for vector in lengths:
            value /= np.sqrt(_dot(vector, vector))
    if variant == "angle":
        return 1.0 - np.arccos(np.clip(value, -1.0, 1.0)) / np.float32(np.pi)
    return np.minimum(np.abs(value, out=value), np.float32(1.0), out=value)


def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _dot(a: Vector, b: Vector) -> Float32:
    out = a[0] * b[0]
    out += a[1] * b[1]
    out += a[2] * b[2]
    return out
