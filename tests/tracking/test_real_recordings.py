"""Real recordings, where they lie beside the checkout: never lost, and as near the reference as it is good."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from sf_bringup.evaluation import trajectory_error
from sf_interfaces.geometry.lidar import project_sweep
from sf_interfaces.io.datasets import SevenScenes
from sf_interfaces.io.datasets.kitti import KittiOdometry
from sf_interfaces.types import Float64, Frame, Trajectory
from sf_tracking.config import TrackingConfig
from sf_tracking.core.tracker import Tracker

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"


def folder(name: str) -> Path:
    if not (SHARED / name).is_dir():
        pytest.skip(f"no recording {SHARED / name}")
    return SHARED / name


def kitchen(root: Path, stride: int) -> Iterator[tuple[Frame, Float64]]:
    """Registered RGB-D frames and reference poses of the colour camera."""
    for read in islice(SevenScenes(root).samples(), None, None, stride):
        sample = read().undistorted()
        assert sample.pose is not None
        yield Frame(sample.stamp_ns, sample.camera, sample.image, sample.depth), sample.pose


def street(root: Path) -> Iterator[tuple[Frame, Float64]]:
    """RGB-L frames and reference poses of the left colour camera."""
    recording = KittiOdometry(root)
    ((_, _, T_camera_lidar),) = recording.extrinsics()
    for read in recording.samples():
        sample = read()
        assert sample.camera is not None and sample.sweep is not None and sample.pose is not None
        sparse = project_sweep(sample.sweep[:, :3], sample.camera, T_camera_lidar)
        yield Frame(sample.stamp_ns, sample.camera, sample.image, sparse_depth=sparse), sample.pose


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
    assert error_of(street(folder("rgbl_kitti_odometry04_000_017"))) < 0.03  # m, on 22.7 m
