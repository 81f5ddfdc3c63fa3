"""Open3D's voxel-block TSDF for surface and colour."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import open3d as o3d

from peers import filled_depth
from sf_bringup.evaluation import Samples
from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera, Float64, Frame, UInt8

VOXEL, TRUNCATION, DEPTH_MAX = 0.01, 4.0, 10.0  # m, voxels, m


class Open3dTsdf:
    """Blocks of 8^3 voxels."""

    def __init__(self, camera: Camera) -> None:
        kinds, channels = (o3d.core.float32,) * 3, ((1,), (1,), (3,))
        self._grid = o3d.t.geometry.VoxelBlockGrid(("tsdf", "weight", "color"), kinds, channels, VOXEL, 8, 50_000)

    def add(self, frame: Frame) -> None:
        assert frame.camera is not None and frame.T_map_camera is not None and frame.image is not None
        K, E = _intrinsic(frame.camera), o3d.core.Tensor(se3.inverse(frame.T_map_camera))
        depth = o3d.t.geometry.Image(o3d.core.Tensor(filled_depth(frame)))
        colour = o3d.t.geometry.Image(o3d.core.Tensor(frame.image.astype(np.float32) / 255))
        blocks = self._grid.compute_unique_block_coordinates(depth, K, E, 1.0, DEPTH_MAX, TRUNCATION)
        self._grid.integrate(blocks, depth, colour, K, K, E, 1.0, DEPTH_MAX, TRUNCATION)

    def surface(self) -> Samples:
        mesh = self._grid.extract_triangle_mesh(0.5).to_legacy()
        return Samples(np.asarray(mesh.vertices), np.asarray(mesh.triangles, np.int64))

    def render(self, camera: Camera, T_map_camera: Float64) -> tuple[UInt8, np.ndarray]:
        active = self._grid.hashmap().active_buf_indices()
        blocks = self._grid.hashmap().key_tensor()[active.to(o3d.core.int64)]
        seen = self._grid.ray_cast(
            blocks, _intrinsic(camera), o3d.core.Tensor(se3.inverse(T_map_camera)), camera.width, camera.height,
            ["depth", "color"], 1.0, 0.1, DEPTH_MAX, 0.5, TRUNCATION,
        )  # fmt: skip
        colour = np.clip(255 * seen["color"].numpy() + 0.5, 0, 255).astype(np.uint8)
        return colour, seen["depth"].numpy()[..., 0] > 0


def _intrinsic(camera: Camera) -> o3d.core.Tensor:
    return o3d.core.Tensor(camera.K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])


PEERS = {"Open3D TSDF": Open3dTsdf}
