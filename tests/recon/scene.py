"""A textured box room seen by a pinhole camera, ray-cast exactly."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera, DepthMap, Keyframe

HALF = np.array([1.5, 1.0, 2.0])  # m, half size of the room, which is centred on the map origin
CAMERA = Camera(160, 120, 120.0, 130.0, 79.3, 61.2)


def texture(points: np.ndarray) -> np.ndarray:
    """Smooth colour [N, 3] in 0..1 of wall points [N, 3] m; the period is 0.4 to 1 m."""
    x, y, z = points.T
    waves = [np.sin(7 * x + 3 * y), np.sin(9 * y + 5 * z), np.sin(6 * z - 8 * x)]
    return 0.5 + 0.4 * np.stack(waves, axis=1)


def view(index: int, camera: Camera = CAMERA) -> Keyframe:
    """The keyframe of a camera that turns by 0.12 rad and moves by a few centimetres per index."""
    angle = 0.12 * index
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0.05 * np.sin(index), angle, 0]).as_matrix()
    T[:3, 3] = [0.3 * np.sin(angle), 0.05 * np.cos(index), 0.3 * np.cos(angle) - 0.3]
    T = se3.orthonormalise(T)
    local = camera.unproject(camera.pixel_grid().reshape(-1, 2), np.ones(camera.width * camera.height))
    rays = local @ T[:3, :3].T
    with np.errstate(divide="ignore"):
        z = np.min((np.sign(rays) * HALF - T[:3, 3]) / rays, axis=1)
    image = np.rint(255 * texture(T[:3, 3] + z[:, None] * rays)).astype(np.uint8)
    shape = (camera.height, camera.width)
    return Keyframe(index, camera, image.reshape(*shape, 3), T, DepthMap(z.reshape(shape)))


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """Of two uint8 colour arrays, dB."""
    return float(-10 * np.log10(np.mean((a.astype(float) - b.astype(float)) ** 2) / 255**2))
