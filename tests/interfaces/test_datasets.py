"""Data sets become bags: tiny generated samples of each layout, and the real ones where present."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from sf_interfaces.errors import CalibrationError, FormatError
from sf_interfaces.geometry import se3
from sf_interfaces.io.bag import BagReader
from sf_interfaces.io.datasets import KittiOdometry, SevenScenes, recognise, register_depth
from sf_interfaces.io.sequence_writer import SequenceWriter
from sf_interfaces.ros import messages as m
from sf_interfaces.types import Camera, DepthMap


def make_kitti(root: Path) -> Path:
    folder = root / "sequences" / "04"
    for name in ("image_2", "velodyne"):
        (folder / name).mkdir(parents=True)
    (root / "poses").mkdir()
    rng = np.random.default_rng(0)
    rows = []
    for i in range(3):
        cv2.imwrite(str(folder / "image_2" / f"{i:06d}.png"), rng.integers(0, 256, (20, 40, 3), np.uint8))
        rng.random((7, 4)).astype("<f4").tofile(folder / "velodyne" / f"{i:06d}.bin")
        T = np.eye(4)
        T[2, 3] = i
        rows.append(" ".join(map(str, T[:3].reshape(-1))))
    (root / "poses" / "04.txt").write_text("\n".join(rows))
    (folder / "times.txt").write_text("0\n0.1\n0.2\n")
    text = "P0: 50 0 19.5 0 0 50 9.5 0 0 0 1 0\nP2: 50 0 19.5 5 0 50 9.5 0 0 0 1 0\n"
    (folder / "calib.txt").write_text(text + "Tr: 0 -1 0 0.3 0 0 -1 0 1 0 0 0\n")
    return folder


def convert(path: Path, out: Path) -> BagReader:
    with SequenceWriter(out) as writer:
        recognise(path).write(writer)
    return BagReader(out)


def test_kitti_sample(tmp_path: Path) -> None:
    folder = make_kitti(tmp_path)
    with convert(folder, tmp_path / "k.mcap") as bag:
        camera, _ = m.decode_camera_info(bag.decode(next(bag.messages(["/camera/color/camera_info"]))))
        assert (camera.fx, camera.cx, camera.cy) == (50, 20.0, 10.0)
        ((parent, child, _, T),) = m.decode_tf(bag.decode(next(bag.messages(["/tf_static"]))))
        assert (parent, child) == ("camera_optical_frame", "lidar")
        np.testing.assert_allclose(T[:3, 3], [0.4, 0, 0])
        msg = bag.decode(next(bag.messages(["/lidar/points"])))
        assert m.decode_cloud(msg).time_offset_ns is None and len(m.decode_field(msg, "intensity")) == 7
        poses = [m.decode_pose(bag.decode(r))[2] for r in bag.messages(["/ground_truth/pose"])]
        np.testing.assert_allclose([T[2, 3] for T in poses], [0, 1, 2])
        assert bag.end_ns - bag.start_ns == 200_000_000
    (folder / "calib.txt").write_text("P2: 1 2 3\n")
    with pytest.raises(CalibrationError, match="P2"), SequenceWriter(tmp_path / "x.mcap") as writer:
        KittiOdometry(folder).write(writer)


def test_seven_scenes_sample(tmp_path: Path) -> None:
    raw = np.full((480, 640), 2000, np.uint16)
    raw[:50], raw[50:60] = 0, 65535
    folder = tmp_path / "seq"
    folder.mkdir()
    for i in range(2):
        cv2.imwrite(str(folder / f"frame-{i:06d}.color.png"), np.full((480, 640, 3), 9, np.uint8))
        cv2.imwrite(str(folder / f"frame-{i:06d}.depth.png"), raw)
        np.savetxt(folder / f"frame-{i:06d}.pose.txt", np.eye(4) * [1.0001, 1, 1, 1])
    with convert(folder, tmp_path / "s.mcap") as bag:
        depth = m.decode_depth(bag.decode(next(bag.messages(["/camera/depth/image_raw"]))))
        assert abs(depth.z[240, 320] - 2.0) < 0.01 and np.isnan(depth.z[40, 320])
        assert np.isfinite(depth.z[200:400, 100:500]).all()  # the splat leaves no holes
        T = m.decode_pose(bag.decode(next(bag.messages(["/ground_truth/pose"]))))[2]
        np.testing.assert_allclose(T, se3.inverse(SevenScenes.T_COLOR_DEPTH), atol=1e-9)


def test_registration_keeps_the_nearest_surface() -> None:
    camera = Camera(40, 30, 30.0, 30.0, 20.0, 15.0)
    z = np.full((30, 40), 4.0, np.float32)
    z[10:20, 10:20] = 1.0
    T = np.eye(4)
    same = register_depth(DepthMap(z), camera, camera, T, splat=1)
    np.testing.assert_allclose(same.z, z)
    T[0, 3] = 0.2  # the near square moves 6 px, the far wall 1.5 px
    moved = register_depth(DepthMap(z), camera, camera, T).z
    assert (moved[11:19, 17:25] == 1.0).all() and moved[15, 35] == 4.0


def test_unknown_layouts(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="no known data set"):
        recognise(tmp_path)
    with pytest.raises(FormatError, match="no folder"):
        recognise(tmp_path / "none")


def test_real_kitti(shared_data: Callable[[str], Path], tmp_path: Path) -> None:
    """Projected LiDAR points must fall into the image and cover its lower part."""
    with convert(shared_data("rgbl_kitti_odometry04_000_017"), tmp_path / "k.mcap") as bag:
        assert bag.topics["/camera/color/image_raw"].count == 18 == bag.topics["/lidar/points"].count
        camera, _ = m.decode_camera_info(bag.decode(next(bag.messages(["/camera/color/camera_info"]))))
        T = m.decode_tf(bag.decode(next(bag.messages(["/tf_static"]))))[0][3]
        points = m.decode_cloud(bag.decode(next(bag.messages(["/lidar/points"])))).points
        uv, z = camera.project(se3.transform(T, points))
        inside = (z > 0.5) & (uv >= 0).all(1) & (uv[:, 0] < camera.width) & (uv[:, 1] < camera.height)
        assert 10_000 < inside.sum() < 30_000 and np.median(uv[inside, 1]) > camera.height / 2


def test_real_seven_scenes(shared_data: Callable[[str], Path], tmp_path: Path) -> None:
    source, folder = shared_data("rgbd_7scenes_redkitchen_000_199"), tmp_path / "few"
    folder.mkdir()
    for file in source.glob("frame-00000[0-3].*"):
        (folder / file.name).symlink_to(file)
    with convert(folder, tmp_path / "s.mcap") as bag:
        depths = [m.decode_depth(bag.decode(r)) for r in bag.messages(["/camera/depth/image_raw"])]
        assert len(depths) == 4 and min(d.density for d in depths) > 0.6
