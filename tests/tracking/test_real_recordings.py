"""Real recordings, where they lie beside the checkout: never lost, and as near the reference as it is good."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from sf_bringup.evaluation import trajectory_error
from sf_interfaces.geometry import se3
from sf_interfaces.geometry.lidar import project_sweep
from sf_interfaces.io.datasets import SevenScenes, read_kitti_calibration, register_depth
from sf_interfaces.io.trajectory import read_kitti
from sf_interfaces.types import DepthMap, Float64, Frame, Trajectory
from sf_tracking.config import TrackingConfig
from sf_tracking.core.tracker import Tracker

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"


def folder(name: str) -> Path:
    if not (SHARED / name).is_dir():
        pytest.skip(f"no recording {SHARED / name}")
    return SHARED / name


def kitchen(root: Path, stride: int) -> Iterator[tuple[Frame, Float64]]:
    """Registered RGB-D frames and reference poses of the colour camera."""
    camera, move = SevenScenes.COLOR_CAMERA, SevenScenes.T_COLOR_DEPTH
    for i in range(0, 200, stride):
        stem = root / f"frame-{i:06d}"
        raw = cv2.imread(f"{stem}.depth.png", cv2.IMREAD_UNCHANGED)
        depth = DepthMap(np.where((raw == 0) | (raw == 65535), np.nan, raw * 1e-3))
        depth = register_depth(depth, SevenScenes.DEPTH_CAMERA, camera, move)
        T = se3.orthonormalise(np.loadtxt(f"{stem}.pose.txt")) @ se3.inverse(move)
        image = np.ascontiguousarray(cv2.imread(f"{stem}.color.jpg")[..., ::-1])
        yield Frame(10**12 + round(i * 1e9 / 30), camera, image, depth), T


def street(root: Path) -> Iterator[tuple[Frame, Float64]]:
    """RGB-L frames and reference poses of the left colour camera."""
    sequence, poses = root / "sequences" / "04", read_kitti(root / "poses" / "04.txt").poses
    seconds = np.loadtxt(sequence / "times.txt")
    for i, file in enumerate(sorted((sequence / "image_2").glob("*.png"))):
        image = np.ascontiguousarray(cv2.imread(str(file))[..., ::-1])
        camera, T_cl, T_cc0 = read_kitti_calibration(sequence / "calib.txt", image.shape[1], image.shape[0])
        points = np.fromfile(sequence / "velodyne" / f"{file.stem}.bin", "<f4").reshape(-1, 4)[:, :3]
        stamp = 10**12 + round(float(seconds[i]) * 1e9)
        T = T_cc0 @ poses[i] @ se3.inverse(T_cc0)
        yield Frame(stamp, camera, image, sparse_depth=project_sweep(points, camera, T_cl)), T


def error_of(frames: Iterator[tuple[Frame, Float64]]) -> float:
    """ATE in m; every frame must be tracked."""
    tracker, stamps, poses = Tracker(TrackingConfig()), [], []
    for frame, T in frames:
        assert tracker.track(frame).T_map_camera is not None
        stamps.append(frame.stamp_ns)
        poses.append(T)
    tracker.finish()
    return trajectory_error(tracker.trajectory(), Trajectory(np.array(stamps), np.array(poses))).rmse


def test_a_handheld_kinect_at_six_frames_a_second() -> None:
    assert error_of(kitchen(folder("rgbd_7scenes_redkitchen_000_199"), 5)) < 0.032  # m, the reference is good to 2-3 cm


def test_a_car_with_a_spinning_lidar() -> None:
    assert error_of(street(folder("rgbl_kitti_odometry04_000_017"))) < 0.06  # m, on 22.7 m
