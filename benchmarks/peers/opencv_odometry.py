"""OpenCV's RGB-D odometry, frame to frame (OpenCV 5)."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from functools import partial

import cv2
import numpy as np

from sf_interfaces.types import Camera, Float64, Frame

if not hasattr(cv2, "Odometry"):
    raise ImportError(f"OpenCV {cv2.__version__} has no Odometry, version 5 has")


class OpenCvOdometry:
    """``kind``: colour and depth together, or depth alone."""

    def __init__(self, camera: Camera, kind: int) -> None:
        settings = cv2.OdometrySettings()
        settings.setCameraMatrix((camera.K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]).astype(np.float32))
        self._odometry = cv2.Odometry(kind, settings, cv2.OdometryAlgoType_FAST)
        self._coloured = kind != cv2.OdometryType_DEPTH
        self._last: tuple[np.ndarray, ...] | None = None
        self._T = np.eye(4)

    def track(self, frame: Frame) -> Float64 | None:
        assert frame.depth is not None and frame.image is not None
        images: tuple[np.ndarray, ...] = (np.array(frame.depth.z),)
        if self._coloured:
            images = (*images, cv2.cvtColor(frame.image, cv2.COLOR_RGB2BGR))
        if self._last is not None:
            found, T_last_now = self._odometry.compute(*images, *self._last)
            if not found:
                return None
            self._T = self._T @ T_last_now
        self._last = images
        return self._T


PEERS = {
    "OpenCV odometry, colour and depth": partial(OpenCvOdometry, kind=cv2.OdometryType_RGB_DEPTH),
    "OpenCV odometry, depth": partial(OpenCvOdometry, kind=cv2.OdometryType_DEPTH),
}
