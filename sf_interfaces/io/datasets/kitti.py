"""KITTI: calibration, odometry sequences, and the single frames of stereo 2015 with their disparity.

The camera is always the rectified left colour camera (2). Sweeps carry no time per point.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np

from sf_interfaces.errors import CalibrationError, FormatError
from sf_interfaces.geometry import se3
from sf_interfaces.io.datasets.dataset import LIDAR, OPTICAL, PHOTO_NS, START_NS, Dataset, Reader, Sample
from sf_interfaces.io.datasets.files import as_depth, images_in, read_image, read_numbers, read_rgb, read_sweep, rigid
from sf_interfaces.types import Camera, DepthMap, Float64, UInt8


def read_rows(path: Path, **shapes: tuple[int, int]) -> dict[str, Float64]:
    """Rows "key: numbers" of a calibration file.

    Args:
        shapes: the rows that must be there, with their shapes.

    Raises:
        CalibrationError: unreadable, or a row is missing or malformed.
    """
    rows = {}
    try:
        for line in path.read_text().splitlines():
            key, _, text = line.partition(":")
            if key.strip() in shapes and text.strip():
                rows[key.strip()] = np.array(text.split(), dtype=np.float64).reshape(shapes[key.strip()])
        return {key: rows[key] for key in shapes}
    except (OSError, ValueError, KeyError) as error:
        wanted = " and ".join(f"{key} of {a * b} numbers" for key, (a, b) in shapes.items())
        raise CalibrationError(f"{path} must hold {wanted} (problem: {error}); copy it from the data set") from error


@dataclass(frozen=True)
class Rig:
    """Projection P [3, 4] of camera 2 and ``T_camera_lidar``, ``T_camera_cam0`` [4, 4]."""

    P: Float64
    T_camera_lidar: Float64
    T_camera_cam0: Float64

    def camera(self, image: UInt8) -> Camera:
        """Camera 2 for an image of its own size."""
        height, width = image.shape[:2]
        K = self.P[:, :3]
        return Camera(width, height, K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5, OPTICAL)


def _rig(P: Float64, T_cam0_lidar: Float64) -> Rig:
    T_camera_cam0 = np.eye(4)
    T_camera_cam0[:3, 3] = np.linalg.solve(P[:, :3], P[:, 3])
    return Rig(P, T_camera_cam0 @ se3.orthonormalise(T_cam0_lidar), T_camera_cam0)


def motion(R: Float64, T: Float64) -> Float64:
    """[4, 4] from a rotation and a translation."""
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = R, T.ravel()
    return out


def odometry_rig(path: Path) -> Rig:
    """calib.txt of an odometry sequence.

    Raises:
        CalibrationError: unreadable, or P2 or Tr is missing.
    """
    rows = read_rows(path, P2=(3, 4), Tr=(3, 4))
    return _rig(rows["P2"], np.vstack([rows["Tr"], [0, 0, 0, 1]]))


def raw_rig(folder: Path) -> Rig:
    """calib_cam_to_cam.txt and calib_velo_to_cam.txt of a recording day.

    Raises:
        CalibrationError: unreadable, or a row is missing.
    """
    cameras = read_rows(folder / "calib_cam_to_cam.txt", P_rect_02=(3, 4), R_rect_00=(3, 3))
    lidar = read_rows(folder / "calib_velo_to_cam.txt", R=(3, 3), T=(3, 1))
    T_rectified = motion(cameras["R_rect_00"], np.zeros(3))
    return _rig(cameras["P_rect_02"], T_rectified @ motion(lidar["R"], lidar["T"]))


def calibration_folder(path: Path) -> Path | None:
    """Where the calibration of a recording day lies: in the folder or above it."""
    return next((f for f in (path, *path.parents[:2]) if (f / "calib_cam_to_cam.txt").is_file()), None)


@dataclass(frozen=True)
class KittiOdometry(Dataset):
    """A KITTI odometry sequence; ground truth is the pose of the camera, the first one at the origin."""

    name: ClassVar[str] = "KITTI odometry"
    evidence: ClassVar[str] = "calib.txt, image_2/*.png, times.txt; velodyne/*.bin, poses.txt or ../../poses/NN.txt"

    @staticmethod
    def _find(path: Path) -> Path | None:
        """The sequence folder: the path itself, or the only one below sequences/."""
        below = path / "sequences"
        candidates = [path, *(sorted(below.iterdir()) if below.is_dir() else [])]
        found = [p for p in candidates if (p / "calib.txt").is_file() and (p / "image_2").is_dir()]
        return found[0] if len(found) == 1 else None

    @staticmethod
    def matches(path: Path) -> bool:
        return KittiOdometry._find(path) is not None

    @property
    def _sequence(self) -> Path:
        return self._find(self.path) or self.path

    @cached_property
    def _images(self) -> list[Path]:
        return images_in(self._sequence / "image_2")

    @cached_property
    def _rig(self) -> Rig:
        return odometry_rig(self._sequence / "calib.txt")

    def __len__(self) -> int:
        return len(self._images)

    def extrinsics(self) -> Sequence[tuple[str, str, Float64]]:
        return ((OPTICAL, LIDAR, self._rig.T_camera_lidar),)

    def samples(self) -> Iterator[Reader]:
        sequence = self._sequence
        seconds = read_numbers(sequence / "times.txt", (-1,))
        if len(seconds) < len(self._images):
            raise FormatError(f"{sequence} has {len(self._images)} images but {len(seconds)} times; copy it again")
        places = (sequence.parent.parent / "poses" / f"{sequence.name}.txt", sequence / "poses.txt")
        file = next((place for place in places if place.is_file()), None)
        rows = np.zeros((0, 3, 4)) if file is None else read_numbers(file, (-1, 3, 4))
        for i, (image, second) in enumerate(zip(self._images, seconds.tolist(), strict=False)):
            pose = (rows[i], file) if file is not None and i < len(rows) else None
            yield partial(self._sample, image, START_NS + round(second * 1e9), pose)

    def _sample(self, file: Path, stamp: int, row: tuple[Float64, Path] | None) -> Sample:
        image = read_rgb(file)
        T = self._rig.T_camera_cam0
        pose = None if row is None else T @ rigid(*row) @ se3.inverse(T)
        folder = self._sequence / "velodyne"
        sweep = read_sweep(folder / f"{file.stem}.bin") if folder.is_dir() else None
        return Sample(stamp, file, image, self._rig.camera(image), sweep=sweep, pose=pose)


@dataclass(frozen=True)
class KittiDay(Dataset):
    """What belongs to a recording day: its calibration, images of camera 2 and sweeps."""

    images: ClassVar[str]  # where the images lie below the folder

    @cached_property
    def _calibration(self) -> Path:
        return calibration_folder(self.path.resolve()) or self.path

    @cached_property
    def _rig(self) -> Rig:
        return raw_rig(self._calibration)

    @cached_property
    def _images(self) -> list[Path]:
        return images_in(self.path / self.images)

    def __len__(self) -> int:
        return len(self._images)

    def extrinsics(self) -> Sequence[tuple[str, str, Float64]]:
        return ((OPTICAL, LIDAR, self._rig.T_camera_lidar),)


@dataclass(frozen=True)
class KittiStereo(KittiDay):
    """Single frames of KITTI stereo 2015 with a sweep each: LiDAR completion, without times and poses.

    Disparity of image 02 against 03 becomes reference depth (256 units a pixel, 0 none).
    """

    name: ClassVar[str] = "KITTI completion frames"
    evidence: ClassVar[str] = "image_02/*.png, velodyne_points/*.bin, calib_*.txt there or above; gt/disp_occ_0/*.png"
    goal: ClassVar[str] = "completion"
    images: ClassVar[str] = "image_02"

    @staticmethod
    def matches(path: Path) -> bool:
        has_images = any((path / "image_02").glob("*.png"))
        return has_images and (path / "velodyne_points").is_dir() and calibration_folder(path.resolve()) is not None

    def samples(self) -> Iterator[Reader]:
        for i, file in enumerate(self._images):
            yield partial(self._sample, START_NS + i * PHOTO_NS, file)

    def _sample(self, stamp: int, file: Path) -> Sample:
        image = read_rgb(file)
        camera = self._rig.camera(image)
        sweep = read_sweep(self.path / "velodyne_points" / f"{file.stem}.bin")
        folder = self.path / "gt" / "disp_occ_0"
        reference = self._depth(folder / file.name, camera) if folder.is_dir() else None
        return Sample(stamp, file, image, camera, sweep=sweep, reference_depth=reference)

    def _depth(self, path: Path, camera: Camera) -> DepthMap:
        """fx * baseline / disparity; the baseline is that of the rectified cameras 2 and 3."""
        right = read_rows(self._calibration / "calib_cam_to_cam.txt", P_rect_03=(3, 4))["P_rect_03"]
        raw = read_image(path, cv2.IMREAD_UNCHANGED)
        if raw.dtype != np.uint16 or raw.shape != (camera.height, camera.width):
            raise FormatError(f"disparity {path} must be of 16 bit and the size of its image; copy the data set again")
        with np.errstate(divide="ignore"):
            return as_depth((self._rig.P[0, 3] - right[0, 3]) / (raw / 256.0))

    def notes(self) -> Sequence[str]:
        return ("single frames without times, poses or order, 1 s apart",)
