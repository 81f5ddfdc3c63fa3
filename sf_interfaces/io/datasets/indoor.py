"""Indoor RGB-D recordings with one pose per frame: 7-Scenes, Replica (NICE-SLAM layout), ScanNet frames.

None of them has stamps: frames are numbered and nominally 30 Hz, so time follows the number.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np

from sf_interfaces.errors import CalibrationError, FormatError
from sf_interfaces.geometry import se3
from sf_interfaces.geometry.registration import register_depth
from sf_interfaces.geometry.undistort import Distortion
from sf_interfaces.io.datasets.dataset import OPTICAL, START_NS, Dataset, Reader, Sample
from sf_interfaces.io.datasets.files import (
    first_existing,
    natural_key,
    number_of,
    read_depth,
    read_numbers,
    read_pose,
    read_rgb,
    rigid,
)
from sf_interfaces.types import Camera, Float64, UInt8


def stamp_30hz(number: int) -> int:
    """Time of a numbered frame, ns."""
    return START_NS + round(number * 1e9 / 30)


@dataclass(frozen=True)
class SevenScenes(Dataset):
    """Microsoft 7-Scenes (Kinect v1).

    Depth is the depth camera's (f 585); it is registered into the colour camera (f 525). The poses are the
    depth camera's and are carried over to the colour camera. The files bring no calibration between the two: the
    rotation of ``T_COLOR_DEPTH`` is what lays depth edges onto those of colour in frames 0-99 of RedKitchen
    (:mod:`sf_interfaces.geometry.depth_alignment`), the translation is that of the sensor's make.
    """

    register: bool = True

    name: ClassVar[str] = "7-Scenes"
    evidence: ClassVar[str] = "frame-*.color.png|jpg, frame-*.depth.png, frame-*.pose.txt"
    depth_units: ClassVar[float | None] = 1000.0

    DEPTH_CAMERA: ClassVar[Camera] = Camera(640, 480, 585.0, 585.0, 320.5, 240.5, OPTICAL)
    COLOR_CAMERA: ClassVar[Camera] = Camera(640, 480, 525.0, 525.0, 320.5, 240.5, OPTICAL)
    readout_s: ClassVar[float] = 0.024

    # Of both cameras alike, so that depth is registered by pinholes and shares the lens of the image.
    LENS: ClassVar[Distortion] = Distortion("plumb_bob", (-0.035, 0.0, 0.0, 0.0))
    T_COLOR_DEPTH: ClassVar[Float64] = se3.orthonormalise(
        np.array(
            [
                [0.99997, -0.00779, 0.00079, -0.02554],
                [0.00780, 0.99996, -0.00398, -0.00016],
                [-0.00076, 0.00399, 0.99999, 0.00225],
                [0.0, 0.0, 0.0, 1.0],
            ]
        )
    )

    @staticmethod
    def matches(path: Path) -> bool:
        return any(path.glob("frame-*.color.*")) and any(path.glob("frame-*.pose.txt"))

    @cached_property
    def _stems(self) -> list[str]:
        """Every frame of which any file is there, so that a missing one is noticed."""
        return sorted({p.name.split(".")[0] for p in self.path.glob("frame-*.*")})

    def __len__(self) -> int:
        return len(self._stems)

    def samples(self) -> Iterator[Reader]:
        for stem in self._stems:
            yield partial(self._sample, stem)

    def _sample(self, stem: str) -> Sample:
        jpg = self.path / f"{stem}.color.jpg"
        file = first_existing([self.path / f"{stem}.color.png", jpg]) or jpg
        camera = self.COLOR_CAMERA if self.register else self.DEPTH_CAMERA
        depth_file = self.path / f"{stem}.depth.png"
        depth = read_depth(depth_file, self.per_metre)
        if depth.z.shape != (480, 640):
            raise FormatError(f"{depth_file} must be 640x480; copy the data set again")
        T = read_pose(self.path / f"{stem}.pose.txt")
        if self.register:
            depth = register_depth(depth, self.DEPTH_CAMERA, camera, self.T_COLOR_DEPTH)
            T = T @ se3.inverse(self.T_COLOR_DEPTH)
        lens = self.LENS if self.register else None
        return Sample(stamp_30hz(number_of(file)), file, read_rgb(file), camera, lens, depth=depth, pose=T)

    def notes(self) -> Sequence[str]:
        return (
            "depth is registered to the colour camera (f 525) with a rotation measured on RedKitchen, another sensor "
            "may differ: sf doctor tells; times are nominal, 30 Hz",
            f"the shutter of the colour camera rolls: its rows are read within {1e3 * self.readout_s:.0f} ms, which "
            "tracking undoes",
        )


@dataclass(frozen=True)
class Replica(Dataset):
    """Renderings of Replica rooms as NICE-SLAM published them: results/, traj.txt and cam_params.json."""

    name: ClassVar[str] = "Replica"
    evidence: ClassVar[str] = "results/frame*.jpg, results/depth*.png, traj.txt, cam_params.json there or above"
    depth_units: ClassVar[float | None] = 6553.5
    depth_encoding: ClassVar[str] = "32FC1"

    @staticmethod
    def matches(path: Path) -> bool:
        return (path / "traj.txt").is_file() and any((path / "results").glob("frame*"))

    @cached_property
    def _numbers(self) -> list[str]:
        files = (self.path / "results").iterdir()
        return sorted({p.stem.removeprefix("frame").removeprefix("depth") for p in files if p.suffix != ".txt"})

    def __len__(self) -> int:
        return len(self._numbers)

    def samples(self) -> Iterator[Reader]:
        camera, units = self._calibration()
        poses = read_numbers(self.path / "traj.txt", (-1, 4, 4))
        if len(poses) < len(self._numbers):
            raise FormatError(
                f"{self.path / 'traj.txt'} has {len(poses)} poses for {len(self._numbers)} frames; copy it again"
            )
        for pose, number in zip(poses, self._numbers, strict=False):
            yield partial(self._sample, number, camera, units, pose)

    def _calibration(self) -> tuple[Camera, float]:
        """cam_params.json, in the folder or above it: the camera and depth units in one metre."""
        places = [folder / "cam_params.json" for folder in (self.path, self.path.parent)]
        file = first_existing(places) or places[0]
        try:
            values = json.loads(file.read_text())["camera"]
            size = int(values["w"]), int(values["h"])
            focal = float(values["fx"]), float(values["fy"])
            centre = float(values["cx"]) + 0.5, float(values["cy"]) + 0.5
            return Camera(*size, *focal, *centre, OPTICAL), self.depth_scale or float(values["scale"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise CalibrationError(
                f"{file} must hold w, h, fx, fy, cx, cy and scale of 'camera' ({error!r}); copy it from the data set"
            ) from error

    def _sample(self, number: str, camera: Camera, units: float, pose: Float64) -> Sample:
        folder = self.path / "results"
        file = first_existing([folder / f"frame{number}.jpg", folder / f"frame{number}.png"])
        file = file or folder / f"frame{number}.jpg"
        depth = read_depth(folder / f"depth{number}.png", units)
        T = rigid(pose, self.path / "traj.txt")
        return Sample(stamp_30hz(int(number)), file, read_rgb(file), camera, depth=depth, pose=T)

    def notes(self) -> Sequence[str]:
        return ("times are nominal, 30 Hz",)


@dataclass(frozen=True)
class ScanNet(Dataset):
    """Frames exported from a ScanNet .sens file: color/, depth/, pose/ and intrinsic/.

    Colour and depth have one centre (its authors apply no extrinsic), but each its own intrinsics: the colour
    image is reduced to about the width of the depth image, and depth is carried over into it.
    """

    name: ClassVar[str] = "ScanNet"
    evidence: ClassVar[str] = "color/*.jpg, depth/*.png, pose/*.txt, intrinsic/intrinsic_color.txt, _depth.txt"
    depth_units: ClassVar[float | None] = 1000.0

    @staticmethod
    def matches(path: Path) -> bool:
        return all((path / name).is_dir() for name in ("color", "depth", "pose", "intrinsic"))

    @cached_property
    def _stems(self) -> list[str]:
        names = (p for folder in ("color", "depth", "pose") for p in (self.path / folder).iterdir())
        return [p.name for p in sorted({Path(p.stem) for p in names}, key=natural_key)]

    def __len__(self) -> int:
        return len(self._stems)

    def samples(self) -> Iterator[Reader]:
        K_color, K_depth = (
            read_numbers(self.path / "intrinsic" / f"intrinsic_{kind}.txt", (4, 4)) for kind in ("color", "depth")
        )
        for stem in self._stems:
            yield partial(self._sample, stem, K_color, K_depth)

    def _sample(self, stem: str, K_color: Float64, K_depth: Float64) -> Sample:
        jpg = self.path / "color" / f"{stem}.jpg"
        file = first_existing([jpg, jpg.with_suffix(".png")]) or jpg
        depth = read_depth(self.path / "depth" / f"{stem}.png", self.per_metre)
        image = read_rgb(file)
        source = _camera(K_depth, depth.z)
        full = _camera(K_color, image)
        camera = full.scaled(min(1.0, source.width / full.width))
        if camera.width < full.width:
            shrunk = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
            image = np.asarray(shrunk, dtype=np.uint8)
        registered = register_depth(depth, source, camera, np.eye(4))
        T = read_pose(self.path / "pose" / f"{stem}.txt")
        return Sample(stamp_30hz(number_of(Path(stem))), file, image, camera, depth=registered, pose=T)

    def notes(self) -> Sequence[str]:
        return ("colour is reduced to the size of depth, depth registered to it; times are nominal, 30 Hz",)


def _camera(K: Float64, pixels: UInt8 | np.ndarray) -> Camera:
    height, width = pixels.shape[:2]
    return Camera(width, height, K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5, OPTICAL)
