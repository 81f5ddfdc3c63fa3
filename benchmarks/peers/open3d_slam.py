"""Open3D's dense SLAM: frame to TSDF model."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import open3d as o3d

from peers import filled_depth
from sf_interfaces.types import Camera, Float64, Frame

GRID = 8  # px: its ray casting never ends on images whose sides are no multiple of this, so they are cropped
VOXEL, TRUNCATION, DEPTH = 0.01, 8.0, (0.1, 10.0)  # m, voxels, m
_slam = o3d.t.pipelines.slam


class Open3dSlam:
    """Tracks against a ray-cast view of what was fused so far."""

    def __init__(self, camera: Camera) -> None:
        K = o3d.core.Tensor(camera.K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
        size = camera.height // GRID * GRID, camera.width // GRID * GRID
        device, self._kept = o3d.core.Device("CPU:0"), np.s_[: size[0], : size[1]]
        self._model = _slam.Model(VOXEL, 16, 10_000, o3d.core.Tensor(np.eye(4)), device)
        self._input, self._cast = (_slam.Frame(*size, K, device) for _ in range(2))
        self._T, self._count = o3d.core.Tensor(np.eye(4)), 0

    def track(self, frame: Frame) -> Float64 | None:
        assert frame.image is not None
        colour, depth = frame.image.astype(np.float32) / 255, filled_depth(frame)
        for name, image in (("depth", depth), ("color", colour)):
            cropped = o3d.core.Tensor(np.ascontiguousarray(image[self._kept]))
            self._input.set_data_from_image(name, o3d.t.geometry.Image(cropped))
        if self._count:
            step = self._model.track_frame_to_model(self._input, self._cast, 1.0, DEPTH[1], 0.07)
            self._T = self._T @ step.transformation
        self._model.update_frame_pose(self._count, self._T)
        self._model.integrate(self._input, 1.0, DEPTH[1], TRUNCATION)
        self._model.synthesize_model_frame(self._cast, 1.0, *DEPTH, TRUNCATION, False)
        self._count += 1
        return self._T.numpy()


PEERS = {"Open3D dense SLAM": Open3dSlam}
