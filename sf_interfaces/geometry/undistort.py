"""Lens distortion is taken out once, on input: everything behind it works with a plain pinhole camera.

The undistorted image keeps the camera's K and size, so the same :class:`Camera` describes both.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np

from sf_interfaces.errors import CalibrationError
from sf_interfaces.types import Camera, DepthMap, Float32, UInt8

_COUNTS = {"plumb_bob": (4, 5), "rational_polynomial": (8, 12, 14), "equidistant": (4,)}


@dataclass(frozen=True, slots=True)
class Distortion:
    """A lens model as sensor_msgs/CameraInfo names it, with its coefficients in that order.

    Raises:
        CalibrationError: unknown model, wrong number of coefficients, or not finite.
    """

    model: str
    coefficients: tuple[float, ...]

    def __post_init__(self) -> None:
        counts = _COUNTS.get(self.model)
        if counts is None:
            raise CalibrationError(
                f"distortion model '{self.model}' is not known; use one of {', '.join(_COUNTS)} "
                "or give undistorted images with all coefficients zero"
            )
        if len(self.coefficients) not in counts or not np.isfinite(self.coefficients).all():
            raise CalibrationError(
                f"distortion model '{self.model}' needs {' or '.join(map(str, counts))} finite coefficients, "
                f"got {self.coefficients}; calibrate the camera again"
            )


@lru_cache(maxsize=8)
def _maps(camera: Camera, distortion: Distortion) -> tuple[Float32, Float32]:
    """For each pixel of the undistorted image, where to read in the distorted one, [H, W] each."""
    K = camera.K
    K[:2, 2] -= 0.5  # OpenCV has pixel centres at integers
    size = (camera.width, camera.height)
    coefficients = np.array(distortion.coefficients)
    fisheye = distortion.model == "equidistant"
    init: Any = cv2.fisheye.initUndistortRectifyMap if fisheye else cv2.initUndistortRectifyMap
    x, y = init(K, coefficients, np.eye(3), K, size, cv2.CV_32FC1)
    return x, y


def _check_size(shape: tuple[int, ...], camera: Camera, what: str) -> None:
    if shape[:2] != (camera.height, camera.width):
        raise CalibrationError(
            f"{what} is {shape[1]}x{shape[0]} but its calibration says {camera.width}x{camera.height}; "
            "give the calibration that belongs to this stream"
        )


def undistort_image(image: UInt8, camera: Camera, distortion: Distortion | None) -> UInt8:
    """Undistort an image [H, W] or [H, W, 3] bilinearly; pixels the lens did not see are 0.

    Raises:
        CalibrationError: image and camera differ in size.
    """
    if distortion is None or not any(distortion.coefficients):
        return image
    _check_size(image.shape, camera, "image")
    return np.asarray(cv2.remap(image, *_maps(camera, distortion), cv2.INTER_LINEAR), dtype=np.uint8)


def undistort_depth(depth: DepthMap, camera: Camera, distortion: Distortion | None) -> DepthMap:
    """Undistort a depth map; the nearest sample is taken, so no depth is invented across an edge.

    Raises:
        CalibrationError: depth and camera differ in size.
    """
    if distortion is None or not any(distortion.coefficients):
        return depth
    _check_size(depth.z.shape, camera, "depth")
    x, y = _maps(camera, distortion)

    def sample(values: Float32) -> Float32:
        out = cv2.remap(values, x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=np.nan)
        return np.asarray(out, dtype=np.float32)

    return DepthMap(sample(depth.z), None if depth.variance is None else sample(depth.variance), depth.scale)
