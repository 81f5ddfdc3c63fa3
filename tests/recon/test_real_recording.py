"""A held-out view of a real RGB-D recording."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from sf_interfaces.io.datasets.indoor import SevenScenes
from sf_interfaces.types import Keyframe
from sf_recon.config import ReconConfig
from sf_recon.core.reconstruction import Reconstruction
from tests.recon.scene import psnr

CAMERA = SevenScenes.COLOR_CAMERA


def keyframe(folder: Path, index: int) -> Keyframe:
    """Frame with its depth registered to the colour camera."""
    sample = list(SevenScenes(folder).samples())[index]().undistorted()
    assert sample.depth is not None and sample.pose is not None
    return Keyframe(index, CAMERA, sample.image, sample.pose, sample.depth)


def test_held_out_view_between_two_keyframes(shared_data: Callable[[str], Path]) -> None:
    folder = shared_data("rgbd_7scenes_redkitchen_000_199")
    room = Reconstruction(ReconConfig())
    for index in (0, 10):
        room.add(keyframe(folder, index))
    truth = keyframe(folder, 5)
    drawn = room.render(CAMERA, truth.T_map_camera)
    hit = drawn.depth.valid
    assert room.resolution == 0.005
    assert drawn.hole_fraction < 0.25
    assert psnr(drawn.image[hit], truth.image[hit]) > 24
    assert psnr(drawn.image, truth.image) > 22  # holes included
    assert np.nanmedian(np.abs(drawn.depth.z - truth.depth.z)) < 0.02
