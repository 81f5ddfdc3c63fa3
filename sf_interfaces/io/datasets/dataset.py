"""What a data set is to the rest: frames that are read one at a time, and what holds for all of them.

A layout is a subclass of :class:`Dataset`; it recognises its files and yields one reader per frame, so nothing
but the frame at hand is ever in memory and a frame that cannot be read leaves the others alone.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

from sf_interfaces.geometry.undistort import Distortion, undistort_depth, undistort_image
from sf_interfaces.types import Camera, DepthMap, Float32, Float64, PointCloud, UInt8

OPTICAL, LIDAR, MAP = "camera_optical_frame", "lidar", "map"
START_NS = 1_000_000_000  # data sets count from zero, and a header stamp of zero means "unknown" in ROS
PHOTO_NS = 1_000_000_000  # photos have no time: they lie one second apart, in the order of their names


@dataclass(frozen=True, slots=True)
class Sample:
    """One frame of a data set.

    Args:
        stamp_ns: time of the image.
        file: the image, for messages.
        image: as the camera gave it (distorted), RGB [H, W, 3].
        camera: its intrinsics where the layout has them; ``frame_id`` tells several cameras apart.
        distortion: of the image and the depth.
        depth: sensor depth in the image's camera.
        depth_ns: time of the depth where it has one of its own.
        sweep: LiDAR points with reflectance [N, 4].
        sweep_ns: time of the sweep where it has one of its own.
        pose: T_map_camera at the image's time: a reference, or an input where the user asks for it.
        reference_depth: depth to measure against; never an input.
    """

    stamp_ns: int
    file: Path
    image: UInt8
    camera: Camera | None = None
    distortion: Distortion | None = None
    depth: DepthMap | None = None
    depth_ns: int | None = None
    sweep: Float32 | None = None
    sweep_ns: int | None = None
    pose: Float64 | None = None
    reference_depth: DepthMap | None = None

    def undistorted(self) -> Sample:
        """The same as a pinhole sees it: image and depth without the lens."""
        if self.camera is None or self.distortion is None:
            return self
        camera, lens = self.camera, self.distortion
        depth, truth = (
            None if z is None else undistort_depth(z, camera, lens) for z in (self.depth, self.reference_depth)
        )
        image = undistort_image(self.image, camera, lens)
        return replace(self, image=image, distortion=None, depth=depth, reference_depth=truth)


Reader = Callable[[], Sample]


class CameraFrames:
    """Names optical frames: one for each calibration of a set, the first as if it were the only one."""

    def __init__(self) -> None:
        self._names: dict[Hashable, str] = {}

    def __call__(self, calibration: Hashable) -> str:
        """The frame of the camera with this calibration."""
        count = len(self._names)
        return self._names.setdefault(calibration, f"camera_{count}_optical_frame" if count else OPTICAL)


@dataclass(frozen=True)
class Dataset(ABC):
    """A recording in one layout.

    Attributes:
        name: of the layout.
        evidence: the files it is recognised by, for messages and documentation.
        depth_units: stored units in one metre of its depth images; None where it has no such images.
        depth_encoding: 16UC1 where millimetres lose nothing, else 32FC1.
        goal: what frames without an order in time are for; ``auto`` for a sequence.
        readout_s: s from the first to the last row of an image, where its shutter is known to roll.

    Args:
        path: the folder (or file) the user gave.
        depth_scale: the user's own number in place of ``depth_units``.
    """

    path: Path
    depth_scale: float | None = None

    name: ClassVar[str]
    evidence: ClassVar[str]
    depth_units: ClassVar[float | None] = None
    depth_encoding: ClassVar[str] = "16UC1"
    goal: ClassVar[str] = "auto"
    readout_s: ClassVar[float] = 0.0

    @staticmethod
    @abstractmethod
    def matches(path: Path) -> bool:
        """Whether a path has this layout, judged by its file names."""

    @abstractmethod
    def __len__(self) -> int:
        """How many frames there should be."""

    @abstractmethod
    def samples(self) -> Iterator[Reader]:
        """One reader per frame, in the order of time.

        Raises:
            SceneFactoryError: what holds for all frames (calibration, times, trajectory) is missing or broken;
                a reader raises it for its own frame.
        """

    def extrinsics(self) -> Sequence[tuple[str, str, Float64]]:
        """Fixed transforms (parent frame, child frame, T_parent_child)."""
        return ()

    def points(self) -> Iterator[PointCloud]:
        """Reference points in the map frame, in parts."""
        return iter(())

    def notes(self) -> Sequence[str]:
        """What the user should know about how these files were read, one sentence each."""
        return ()

    @property
    def per_metre(self) -> float:
        """Stored units in one metre of the depth images."""
        return self.depth_scale or self.depth_units or 1000.0
