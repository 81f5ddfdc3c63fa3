"""Goal mvd from a bag to its files, posed depth and calibration in the line."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

sys.path.append(str(Path(__file__).parents[1] / "depth"))
from views import Views, room

from sf_bringup.calibration import CALIBRATE, calibrated
from sf_bringup.pipeline import ProductionLine
from sf_bringup.planner import plan
from sf_bringup.preflight import inspect
from sf_bringup.result_writer import ResultWriter
from sf_bringup.run_folder import RunFolder
from sf_bringup.runner import RunRequest, run
from sf_depth.core.products import cloud
from sf_interfaces.blocks import Quantity, load_blocks
from sf_interfaces.config import ConfigFile
from sf_interfaces.errors import FormatError
from sf_interfaces.io.sequence_writer import SequenceWriter
from sf_interfaces.io.trajectory import read_tum
from sf_interfaces.types import Camera, DepthMap, Frame, Keyframe


def photos(path: Path, views: Views) -> Path:
    """A photo set: images a second apart, nothing else."""
    with SequenceWriter(path) as writer:
        for k, image in enumerate(views.images):
            writer.image("/camera/color/image_raw", 10**9 * (k + 1), image, "camera_optical_frame")
    return path


def test_photos_become_depth_poses_camera_cloud_and_contact_sheet(tmp_path: Path) -> None:
    views = room(3)
    run(RunRequest((photos(tmp_path / "photos.mcap", views),), "mvd", out=tmp_path / "out"))
    folder = RunFolder.open(tmp_path / "out")
    assert abs(folder.camera().fx / views.camera.fx - 1) < 0.03  # three small views; more in tests/depth
    assert len(read_tum(folder.path / "trajectory.tum")) == 3
    maps = [depth for _, depth in folder.depth_maps()]
    assert len(maps) == 3 and all(depth.density == 1.0 and depth.variance is not None for depth in maps)
    assert cv2.imread(str(folder.path / "contact_sheet.png")).shape == (3 * 240, 4 * 320, 3)
    assert (folder.path / "surface.ply").stat().st_size > 10_000


@pytest.mark.parametrize(("shared", "kept"), [(0.0, 50), (0.2, 50)])
def test_a_deviation_that_all_pixels_share_does_not_empty_the_cloud(shared: float, kept: int) -> None:
    camera = Camera(10, 10, 10.0, 10.0, 5.0, 5.0)
    z = np.full((10, 10), 2.0, np.float32)
    relative = np.where(np.arange(10)[:, None] < 5, 0.01, 0.4) * np.ones((10, 10))
    depth = DepthMap(z, ((shared**2 + relative**2) * z**2).astype(np.float32))
    keyframe = Keyframe(0, camera, np.zeros((10, 10, 3), np.uint8), np.eye(4), depth)
    assert len(cloud([keyframe])) == kept


def test_one_photo_is_no_set(tmp_path: Path) -> None:
    bag = photos(tmp_path / "one.mcap", Views(room(3).camera, room(3).images[:1], [], []))
    with pytest.raises(FormatError, match="at least 2 images"):
        run(RunRequest((bag,), "mvd", out=tmp_path / "out"))


def test_calibration_replaces_the_missing_intrinsics_of_a_line(tmp_path: Path) -> None:
    views = room(3)
    given = inspect(photos(tmp_path / "video.mcap", views), {})
    made = plan(given.mapping.available, "tracking", load_blocks())
    assert made.ids[0] == CALIBRATE
    with_camera, rest = calibrated(given, made, ConfigFile({}), tmp_path)
    assert rest.ids == made.ids[1:] and Quantity.INTRINSICS in rest.available
    assert "camera_info" in with_camera.mapping.roles
    assert all(source != CALIBRATE for step in rest.steps for source in step.sources.values())


def test_posed_frames_get_dense_depth_in_the_line(tmp_path: Path) -> None:
    views = room(3)
    config = ConfigFile({"depth": {"min_baseline": 0.01, "keyframe_baseline": 0.0}})
    with ResultWriter(SequenceWriter(tmp_path / "result.mcap")) as writer:
        line = ProductionLine(["depth:posed"], config, writer, posed=True)
        for k, (image, T) in enumerate(zip(views.images, views.poses, strict=True)):
            line.step(Frame(10**9 * (k + 1), views.camera, image, T_map_camera=T))
        line.finish()
        assert writer.counts["keyframes"] == 3, line.reasons


@pytest.mark.slow
def test_real_photos_are_registered_and_calibrated(shared_data: Callable[[str], Path], tmp_path: Path) -> None:
    """Fountain-P11: five views, nothing known; reference cameras by laser scan."""
    folder = shared_data("mvs_strecha_fountain_P11")
    images, rotations = [], []
    for index in range(3, 8):
        image = cv2.imread(str(folder / "images" / f"{index:04d}.jpg"))
        images.append(cv2.resize(image, (768, 512), interpolation=cv2.INTER_AREA)[..., ::-1].copy())
        numbers = np.array((folder / "gt_dense_cameras" / f"{index:04d}.jpg.camera").read_text().split(), dtype=float)
        rotations.append(numbers[12:21].reshape(3, 3))
    from sf_depth.config import DepthConfig
    from sf_depth.core.mvd import MultiViewDepth

    found = MultiViewDepth(DepthConfig()).recover(images[2], [*images[:2], *images[3:]])
    assert found.registered.all() and found.depth.density > 0.6
    assert abs(found.camera.fx / (1379.74 / 2) - 1) < 0.02
    sources = [rotations[k] for k in (0, 1, 3, 4)]
    for T, R in zip(found.T_source_reference, sources, strict=True):
        error = T[:3, :3] @ (R.T @ rotations[2]).T
        assert np.degrees(np.arccos(np.clip((np.trace(error) - 1) / 2, -1, 1))) < 0.5
