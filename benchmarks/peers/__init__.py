"""Other programs on the same frames: one small adapter each, all behind the three protocols below.

An adapter module defines ``PEERS: dict[str, Callable[[Camera], Peer]]``. Modules whose package is not installed,
and peers that lack something else, are skipped with a line that says why.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from sf_bringup.evaluation import Samples
from sf_interfaces.types import Camera, Float64, Frame, PointCloud, UInt8

ODOMETRY = ("open3d_odometry", "open3d_slam", "opencv_odometry", "small_gicp_map", "kiss_icp_map", "orbslam3")
SWEEPS = ("kiss_icp_sweeps",)
MAPPING = ("open3d_tsdf",)
PHOTO_SETS = ("colmap",)


class PeerMissing(Exception):
    """A peer cannot run here; the message says what it needs."""


class Odometry(Protocol):
    """Tracks a camera with depth."""

    def track(self, frame: Frame) -> Float64 | None:
        """T_first_camera [4, 4] of the frame, None when lost. Frames come in order of time."""


class SweepOdometry(Protocol):
    """Tracks a LiDAR."""

    def track(self, sweep: PointCloud) -> Float64:
        """T_first_lidar [4, 4] of the sweep. Sweeps come in order of time."""


class Mapper(Protocol):
    """Fuses posed frames into a coloured surface."""

    def add(self, frame: Frame) -> None:
        """Fuse one frame; its pose is given."""

    def surface(self) -> Samples:
        """The surface so far, map frame."""

    def render(self, camera: Camera, T_map_camera: Float64) -> tuple[UInt8, np.ndarray]:
        """Image [H, W, 3] and where it shows a surface [H, W]."""


class PhotoSet(Protocol):
    """Finds poses and intrinsics of unordered photos."""

    def solve(self, folder: Path) -> tuple[Mapping[str, Float64], float]:
        """File name -> T_world_camera [4, 4] of the registered photos, and the focal length, px."""


def load(modules: tuple[str, ...], camera: Camera | None = None) -> tuple[dict[str, Callable[[], Any]], dict[str, str]]:
    """Peers that can run, by name, and why the others cannot."""
    found: dict[str, Callable[[], Any]] = {}
    missing = {}
    for name in modules:
        try:
            module = importlib.import_module(f"peers.{name}")
        except ImportError as error:
            missing[name] = f"skipped: {error}; pip install '.[bench]'"
            continue
        for title, make in module.PEERS.items():
            found[title] = lambda make=make: make(camera)
    return found, missing


def points_of(frame: Frame) -> Float64:
    """The depth of a frame as points [N, 3] m, camera frame."""
    assert frame.depth is not None and frame.camera is not None
    valid = frame.depth.valid
    return frame.camera.unproject(frame.camera.pixel_grid()[valid], frame.depth.z[valid].astype(np.float64))


def filled_depth(frame: Frame) -> np.ndarray:
    """Depth [H, W] float32 m with 0 where there is none."""
    assert frame.depth is not None
    return np.ascontiguousarray(np.where(frame.depth.valid, frame.depth.z, 0), np.float32)
