"""KITTI raw drives: stamped images and sweeps, and the GPS/IMU as reference."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import lru_cache, partial
from pathlib import Path
from typing import ClassVar

import numpy as np

from sf_interfaces.errors import FormatError, SceneFactoryError
from sf_interfaces.geometry import se3
from sf_interfaces.io.datasets.dataset import Reader, Sample
from sf_interfaces.io.datasets.files import number_of, read_numbers, read_rgb, read_sweep
from sf_interfaces.io.datasets.kitti import KittiDay, Rig, motion, read_rows
from sf_interfaces.types import Float64

_EARTH_RADIUS_M = 6378137.0
_LONGEST_OXTS_GAP_NS = 500_000_000  # positions come at 10 Hz; over a longer gap no reference is made up


@lru_cache(maxsize=8)
def _read_times(path: Path) -> list[int]:
    """timestamps.txt of a raw drive, ns since 1970 in UTC."""
    stamps = []
    try:
        for line in path.read_text().splitlines():
            if line.strip():
                whole, _, fraction = line.strip().partition(".")
                second = datetime.strptime(whole, "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC)
                stamps.append(int(second.timestamp()) * 10**9 + int(f"{fraction:0<9}"[:9]))
    except (OSError, ValueError) as error:
        raise FormatError(f"{path} must hold one date and time per line ({error}); copy the drive again") from error
    return stamps


@dataclass(frozen=True)
class KittiRaw(KittiDay):
    """A synchronised KITTI raw drive.

    Ground truth comes from the GPS/IMU (oxts): Mercator position, roll, pitch, yaw, carried over to the camera,
    interpolated at the image's time, with the first IMU pose at the origin (x east, y north, z up).
    """

    name: ClassVar[str] = "KITTI raw"
    evidence: ClassVar[str] = "image_02/data/*.png, image_02/timestamps.txt; velodyne_points/, oxts/; calib_*.txt above"
    images: ClassVar[str] = "image_02/data"

    @staticmethod
    def matches(path: Path) -> bool:
        return (path / "image_02" / "timestamps.txt").is_file() and (path / "image_02" / "data").is_dir()

    def samples(self) -> Iterator[Reader]:
        oxts = _Oxts(self.path / "oxts", self._calibration, self._rig) if (self.path / "oxts").is_dir() else None
        for file in self._images:
            yield partial(self._sample, file, oxts)

    def _time(self, sensor: str, number: int) -> int:
        path = self.path / sensor / "timestamps.txt"
        stamps = _read_times(path)
        if number >= len(stamps):
            raise FormatError(f"{path} has {len(stamps)} times, none for frame {number}; copy the drive again")
        return stamps[number]

    def _sample(self, file: Path, oxts: _Oxts | None) -> Sample:
        number = number_of(file)
        stamp, image = self._time("image_02", number), read_rgb(file)
        sweep = sweep_ns = None
        if (self.path / "velodyne_points").is_dir():
            sweep = read_sweep(self.path / "velodyne_points" / "data" / f"{file.stem}.bin")
            sweep_ns = self._time("velodyne_points", number)
        pose = None if oxts is None else oxts.camera_pose(number, stamp)
        return Sample(stamp, file, image, self._rig.camera(image), sweep=sweep, sweep_ns=sweep_ns, pose=pose)

    def notes(self) -> Sequence[str]:
        return ("sweeps are not motion compensated and carry no time per point",)


class _Oxts:
    """Poses of the GPS/IMU of a drive, one small file each, read when they are needed."""

    def __init__(self, folder: Path, calibration: Path, rig: Rig) -> None:
        imu = read_rows(calibration / "calib_imu_to_velo.txt", R=(3, 3), T=(3, 1))
        self._T_imu_camera = se3.inverse(rig.T_camera_lidar @ se3.orthonormalise(motion(imu["R"], imu["T"])))
        self._files = sorted((folder / "data").glob("*.txt"))
        self._stamps = _read_times(folder / "timestamps.txt")
        self._origin: Float64 | None = None
        self._scale = 0.0

    def camera_pose(self, number: int, stamp: int) -> Float64 | None:
        """T_map_camera at a time near the packet of this number."""
        count = min(len(self._files), len(self._stamps))
        if number < count and stamp == self._stamps[number]:
            return self._pose(number) @ self._T_imu_camera
        a = number if number < count and stamp > self._stamps[number] else number - 1
        b = a + 1
        if a < 0 or b >= count:
            return None
        t0, t1 = self._stamps[a], self._stamps[b]
        if not t0 <= stamp <= t1 or t1 - t0 > _LONGEST_OXTS_GAP_NS:
            return None
        return se3.interpolate(self._pose(a), self._pose(b), (stamp - t0) / (t1 - t0)) @ self._T_imu_camera

    def _pose(self, number: int) -> Float64:
        """Pose of the IMU relative to the first one that can be read."""
        if self._origin is None:
            self._origin = self._first()
        return se3.inverse(self._origin) @ self._absolute(self._files[number])

    def _first(self) -> Float64:
        for file in self._files:
            try:
                latitude = read_numbers(file, (-1,))[0]
                self._scale = float(np.cos(np.radians(latitude)))
                return self._absolute(file)
            except (SceneFactoryError, IndexError):
                continue
        raise FormatError(f"no packet of {self._files[0].parent} can be read; copy the drive again")

    def _absolute(self, file: Path) -> Float64:
        values = read_numbers(file, (-1,))
        if len(values) < 6 or not np.isfinite(values[:6]).all():
            raise FormatError(f"{file} must begin with lat, lon, alt, roll, pitch, yaw; copy the drive again")
        lat, lon, altitude, roll, pitch, yaw = values[:6]
        x = self._scale * _EARTH_RADIUS_M * np.radians(lon)
        y = self._scale * _EARTH_RADIUS_M * np.log(np.tan(np.pi * (90 + lat) / 360))
        R = _turn(2, yaw) @ _turn(1, pitch) @ _turn(0, roll)
        return motion(R, np.array([x, y, altitude]))


def _turn(axis: int, angle: float) -> Float64:
    """Rotation [3, 3] about a coordinate axis."""
    return se3.exp(np.eye(6)[3 + axis] * angle)[:3, :3]
