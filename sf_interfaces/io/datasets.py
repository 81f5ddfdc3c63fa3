"""Data sets on disk -> bags. One small class per layout, recognised by its files.

A new layout is a class with ``matches(path)`` and ``write(writer)``, added to :data:`DATASETS`.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from sf_interfaces.errors import CalibrationError, FormatError
from sf_interfaces.geometry import se3
from sf_interfaces.io.sequence_writer import SequenceWriter
from sf_interfaces.io.trajectory import read_kitti
from sf_interfaces.types import Camera, DepthMap, Float64, PointCloud, UInt8

_COLOR, _INFO = "/camera/color/image_raw", "/camera/color/camera_info"
_DEPTH, _POINTS, _TRUTH = "/camera/depth/image_raw", "/lidar/points", "/ground_truth/pose"
_OPTICAL, _LIDAR, _MAP = "camera_optical_frame", "lidar", "map"
_START_NS = 1_000_000_000  # data sets count from zero, and a header stamp of zero means "unknown" in ROS

Progress = Callable[[int, int], None]


class Dataset(Protocol):
    """One data-set layout."""

    name: str

    @staticmethod
    def matches(path: Path) -> bool:
        """Whether a folder has this layout."""

    def write(self, writer: SequenceWriter, progress: Progress | None = None) -> int:
        """Write the whole sequence and return the number of images.

        Raises:
            FormatError: a file is missing or malformed.
        """


def _read(path: Path, flags: int) -> np.ndarray:
    image = cv2.imread(str(path), flags)
    if image is None:
        raise FormatError(f"image {path} is missing or damaged; copy the data set again")
    return np.asarray(image)


def _read_rgb(path: Path) -> UInt8:
    return np.ascontiguousarray(_read(path, cv2.IMREAD_COLOR)[..., ::-1], dtype=np.uint8)


def _read_matrix(path: Path, shape: tuple[int, int]) -> Float64:
    try:
        return np.loadtxt(path, dtype=np.float64).reshape(shape)
    except (OSError, ValueError) as error:
        raise FormatError(f"{path} must hold {shape[0]}x{shape[1]} numbers ({error})") from error


def register_depth(
    depth: DepthMap, source: Camera, target: Camera, T_target_source: Float64, splat: int = 2
) -> DepthMap:
    """Depth of one camera as another sees it: each pixel is carried over, the nearest surface wins.

    Args:
        splat: side of the square each pixel covers in the target, px; at least the ratio of focal lengths.
    """
    valid = depth.valid
    z = depth.z[valid].astype(np.float64)
    points = se3.transform(T_target_source, source.unproject(source.pixel_grid()[valid], z))
    uv, z = target.project(points[points[:, 2] > 0])
    corner = np.floor(uv - (splat - 1) / 2).astype(np.int64)
    out = np.full(target.height * target.width, np.inf)
    for dv in range(splat):
        for du in range(splat):
            u, v = corner[:, 0] + du, corner[:, 1] + dv
            inside = (u >= 0) & (u < target.width) & (v >= 0) & (v < target.height)
            np.minimum.at(out, v[inside] * target.width + u[inside], z[inside])
    out[np.isinf(out)] = np.nan
    return DepthMap(out.reshape(target.height, target.width).astype(np.float32))


@dataclass(frozen=True)
class SevenScenes:
    """Microsoft 7-Scenes (Kinect v1): frame-NNNNNN.{color.png|jpg, depth.png, pose.txt}.

    Depth is the depth camera's (f 585); it is registered into the colour camera (f 525). The poses are the
    depth camera's and are carried over to the colour camera. There are no stamps: nominally 30 Hz.
    """

    path: Path
    register: bool = True
    name = "7-Scenes"

    DEPTH_CAMERA = Camera(640, 480, 585.0, 585.0, 320.5, 240.5, _OPTICAL)
    COLOR_CAMERA = Camera(640, 480, 525.0, 525.0, 320.5, 240.5, _OPTICAL)
    T_COLOR_DEPTH = se3.orthonormalise(
        np.array(
            [
                [0.99997, 0.00268, -0.00790, -0.02556],
                [-0.00274, 0.99996, -0.00815, 0.00010],
                [0.00788, 0.00817, 0.99994, 0.00203],
                [0.0, 0.0, 0.0, 1.0],
            ]
        )
    )

    @staticmethod
    def matches(path: Path) -> bool:
        return any(path.glob("frame-*.color.*")) and any(path.glob("frame-*.pose.txt"))

    def write(self, writer: SequenceWriter, progress: Progress | None = None) -> int:
        """Write colour, its camera, registered depth (16UC1) and the pose of the colour camera."""
        files = sorted(self.path.glob("frame-*.color.*"))
        camera = self.COLOR_CAMERA if self.register else self.DEPTH_CAMERA
        for i, file in enumerate(files):
            stem = file.name.split(".")[0]
            stamp = _START_NS + round(i * 1e9 / 30)
            raw = _read(file.with_name(f"{stem}.depth.png"), cv2.IMREAD_UNCHANGED)
            if raw.dtype != np.uint16 or raw.shape != (480, 640):
                raise FormatError(f"{stem}.depth.png in {self.path} must be 640x480 of 16 bit")
            missing = (raw == 0) | (raw == 65535)
            depth = DepthMap(np.where(missing, np.nan, raw * 1e-3))
            T = se3.orthonormalise(_read_matrix(file.with_name(f"{stem}.pose.txt"), (4, 4)))
            if self.register:
                depth = register_depth(depth, self.DEPTH_CAMERA, camera, self.T_COLOR_DEPTH)
                T = T @ se3.inverse(self.T_COLOR_DEPTH)
            writer.camera_info(_INFO, stamp, camera)
            writer.image(_COLOR, stamp, _read_rgb(file), _OPTICAL)
            writer.depth(_DEPTH, stamp, depth, _OPTICAL)
            writer.pose(_TRUTH, stamp, T, _MAP)
            if progress is not None:
                progress(i + 1, len(files))
        return len(files)


def read_kitti_calibration(path: Path, width: int, height: int) -> tuple[Camera, Float64, Float64]:
    """calib.txt -> (rectified left colour camera, T_camera_lidar, T_camera_cam0).

    Raises:
        CalibrationError: unreadable, or P2 or Tr is missing.
    """
    rows: dict[str, Float64] = {}
    try:
        for line in path.read_text().splitlines():
            key, _, text = line.partition(":")
            if text.strip():
                rows[key.strip()] = np.array(text.split(), dtype=np.float64).reshape(3, 4)
        P, Tr = rows["P2"], rows["Tr"]
    except (OSError, ValueError, KeyError) as error:
        raise CalibrationError(f"{path} must hold P2 and Tr of 12 numbers each (problem: {error})") from error
    K = P[:, :3]
    camera = Camera(width, height, K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5, _OPTICAL)
    T_camera_cam0, T_cam0_lidar = np.eye(4), np.eye(4)
    T_camera_cam0[:3, 3] = np.linalg.solve(K, P[:, 3])
    T_cam0_lidar[:3] = Tr
    return camera, T_camera_cam0 @ se3.orthonormalise(T_cam0_lidar), T_camera_cam0


@dataclass(frozen=True)
class KittiOdometry:
    """KITTI odometry: calib.txt, times.txt, image_2/, velodyne/, poses in ../../poses/NN.txt or beside.

    The camera is the rectified left colour camera. Scans are published as motion-compensated already, so
    the points carry no time. Ground truth is the pose of that camera, the first one at the origin.
    """

    path: Path
    name = "KITTI odometry"

    @staticmethod
    def _sequence(path: Path) -> Path | None:
        """The sequence folder: the path itself, or the only one below sequences/."""
        below = path / "sequences"
        candidates = [path, *(sorted(below.iterdir()) if below.is_dir() else [])]
        found = [p for p in candidates if (p / "calib.txt").is_file() and (p / "image_2").is_dir()]
        return found[0] if len(found) == 1 else None

    @staticmethod
    def matches(path: Path) -> bool:
        return KittiOdometry._sequence(path) is not None

    def _poses_file(self, sequence: Path) -> Path | None:
        places = (sequence.parent.parent / "poses" / f"{sequence.name}.txt", sequence / "poses.txt")
        return next((place for place in places if place.is_file()), None)

    def write(self, writer: SequenceWriter, progress: Progress | None = None) -> int:
        """Write images, camera, sweeps with intensity, the extrinsic on /tf_static and ground truth."""
        sequence = self._sequence(self.path)
        images = sorted((sequence / "image_2").glob("*.png")) if sequence else []
        if sequence is None or not images:
            raise FormatError(f"{self.path} holds no image_2/*.png; copy the data set again")
        seconds = _read_matrix(sequence / "times.txt", (-1, 1))[:, 0]
        if len(seconds) < len(images):
            raise FormatError(f"{sequence} has {len(images)} images but {len(seconds)} times; copy it again")
        height, width = _read_rgb(images[0]).shape[:2]
        camera, T_camera_lidar, T_camera_cam0 = read_kitti_calibration(sequence / "calib.txt", width, height)
        writer.tf_static(_OPTICAL, _LIDAR, T_camera_lidar, _START_NS)
        poses_file = self._poses_file(sequence)
        poses = None if poses_file is None else read_kitti(poses_file).poses
        for i, file in enumerate(images):
            stamp = _START_NS + round(float(seconds[i]) * 1e9)
            writer.camera_info(_INFO, stamp, camera)
            writer.image(_COLOR, stamp, _read_rgb(file), _OPTICAL)
            sweep = sequence / "velodyne" / f"{file.stem}.bin"
            if sweep.is_file():
                self._write_sweep(writer, sweep, stamp)
            if poses is not None and i < len(poses):
                T = T_camera_cam0 @ poses[i] @ se3.inverse(T_camera_cam0)
                writer.pose(_TRUTH, stamp, T, _MAP)
            if progress is not None:
                progress(i + 1, len(images))
        return len(images)

    @staticmethod
    def _write_sweep(writer: SequenceWriter, path: Path, stamp_ns: int) -> None:
        values = np.fromfile(path, dtype="<f4")
        if values.size % 4:
            raise FormatError(f"{path} does not hold four floats per point; copy the data set again")
        points = values.reshape(-1, 4)
        cloud = PointCloud(points[:, :3], stamp_ns=stamp_ns, frame_id=_LIDAR)
        writer.cloud(_POINTS, cloud, points[:, 3])


DATASETS: tuple[type[SevenScenes] | type[KittiOdometry], ...] = (SevenScenes, KittiOdometry)


def recognise(path: Path) -> Dataset:
    """The data set in a folder.

    Raises:
        FormatError: no such folder, or no known layout.
    """
    if not path.is_dir():
        raise FormatError(f"data set {path} is no folder; check the path")
    for kind in DATASETS:
        if kind.matches(path):
            return kind(path)
    known = ", ".join(kind.name for kind in DATASETS)
    raise FormatError(f"{path} has the layout of no known data set ({known}); give its sequence folder")
