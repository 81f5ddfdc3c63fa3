"""Open3D's RGB-D odometry, frame to frame."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from functools import partial

import numpy as np
import open3d as o3d

from peers import filled_depth
from sf_interfaces.types import Camera, Float64, Frame

_odometry = o3d.t.pipelines.odometry


class Open3dOdometry:
    """``method``: photometric and geometric (Hybrid), or geometric alone (PointToPlane)."""

    def __init__(self, camera: Camera, method: object) -> None:
        self._K = o3d.core.Tensor(camera.K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
        self._method, self._last, self._T = method, None, np.eye(4)

    def track(self, frame: Frame) -> Float64 | None:
        colour = o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(frame.image)))
        image = o3d.t.geometry.RGBDImage(colour, o3d.t.geometry.Image(o3d.core.Tensor(filled_depth(frame))))
        if self._last is not None:
            found = _odometry.rgbd_odometry_multi_scale(
                image, self._last, self._K, depth_scale=1.0, depth_max=10.0, method=self._method
            )
            self._T = self._T @ found.transformation.numpy()
        self._last = image
        return self._T


PEERS = {
    "Open3D odometry, hybrid": partial(Open3dOdometry, method=_odometry.Method.Hybrid),
    "Open3D odometry, point to plane": partial(Open3dOdometry, method=_odometry.Method.PointToPlane),
}
