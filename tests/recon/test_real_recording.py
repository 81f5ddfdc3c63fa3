"""A held-out view of a real RGB-D recording."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera, DepthMap, Keyframe, SparseDepth
from sf_recon.config import ReconConfig
from sf_recon.core.reconstruction import Reconstruction
from tests.recon.scene import psnr

COLOR = Camera(640, 480, 525, 525, 320, 240)
DEPTH = Camera(640, 480, 585, 585, 320, 240)
T_COLOR_DEPTH = se3.orthonormalise(
    np.array(
        [
            [0.99997, 0.00268, -0.00790, -0.02556],
            [-0.00274, 0.99996, -0.00815, 0.00010],
            [0.00788, 0.00817, 0.99994, 0.00203],
            [0, 0, 0, 1],
        ]
    )
)


def keyframe(folder: Path, index: int) -> Keyframe:
    """Frame with its depth registered to the colour camera."""
    stem = str(folder / f"frame-{index:06d}")
    image = cv2.cvtColor(cv2.imread(stem + ".color.jpg"), cv2.COLOR_BGR2RGB)
    z = cv2.imread(stem + ".depth.png", cv2.IMREAD_UNCHANGED) / 1000
    valid = (z > 0.1) & (z < 10)
    points = DEPTH.unproject(DEPTH.pixel_grid()[valid], z[valid])
    uv, depth = COLOR.project(points @ T_COLOR_DEPTH[:3, :3].T + T_COLOR_DEPTH[:3, 3])
    registered: DepthMap = SparseDepth(uv, depth).to_map(COLOR.height, COLOR.width)
    pose = se3.orthonormalise(np.loadtxt(stem + ".pose.txt")) @ se3.inverse(T_COLOR_DEPTH)
    return Keyframe(index, COLOR, image, pose, registered)


def test_held_out_view_between_two_keyframes(shared_data: Callable[[str], Path]) -> None:
    folder = shared_data("rgbd_7scenes_redkitchen_000_199")
    room = Reconstruction(ReconConfig())
    for index in (0, 10):
        room.add(keyframe(folder, index))
    truth = keyframe(folder, 5)
    drawn = room.render(COLOR, truth.T_map_camera)
    hit = drawn.depth.valid
    assert room.resolution == 0.005
    assert drawn.hole_fraction < 0.25
    assert psnr(drawn.image[hit], truth.image[hit]) > 24
    assert psnr(drawn.image, truth.image) > 22  # holes included
    assert np.nanmedian(np.abs(drawn.depth.z - truth.depth.z)) < 0.02
