"""TUM RGB-D and the TUM-compatible ICL-NUIM: lists of stamped files and a trajectory."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from functools import cached_property, partial
from pathlib import Path
from typing import ClassVar

import numpy as np

from sf_interfaces.errors import FormatError
from sf_interfaces.geometry import se3
from sf_interfaces.geometry.undistort import Distortion
from sf_interfaces.io.datasets.dataset import OPTICAL, Dataset, Reader, Sample
from sf_interfaces.io.datasets.files import first_existing, natural_key, number_of, read_depth, read_rgb
from sf_interfaces.io.datasets.indoor import stamp_30hz
from sf_interfaces.io.trajectory import read_tum
from sf_interfaces.types import Camera, Float64, Trajectory

_ASSOCIATION_NS = 20_000_000  # colour and depth of one instant, as the data set's own tools match them
_POSE_GAP_NS = 100_000_000  # the motion capture runs at 100 Hz; over a longer gap no reference is made up
_Stamped = tuple[int, Path]


def _stamp(word: str) -> int:
    """Seconds as text -> ns, exactly (decimal, not float)."""
    return int((Decimal(word) * 10**9).to_integral_value())


def _rows(path: Path, columns: int, form: str) -> list[list[str]]:
    try:
        lines = [line.split() for line in path.read_text().splitlines()]
    except (OSError, UnicodeDecodeError) as error:
        raise FormatError(f"cannot read {path} ({error}); copy the data set again") from error
    rows = [words for words in lines if words and not words[0].startswith("#")]
    for words in rows:
        if len(words) != columns:
            raise FormatError(f"{path} must hold '{form}' in each line, not '{' '.join(words)}'; mend that line")
    if not rows:
        raise FormatError(f"{path} lists no file; copy the data set again")
    return rows


def read_file_list(path: Path) -> list[_Stamped]:
    """rgb.txt or depth.txt: (stamp ns, file) in the order of time.

    Raises:
        FormatError: unreadable, no line, or a line that is not "stamp file".
    """
    try:
        return sorted({_stamp(stamp): path.parent / name for stamp, name in _rows(path, 2, "stamp file")}.items())
    except InvalidOperation as error:
        raise FormatError(f"{path} holds a stamp that is no number; mend that line") from error


def read_associations(path: Path) -> list[tuple[_Stamped, _Stamped]]:
    """associations.txt: pairs of colour and depth, in either order of columns, in the order of time.

    Raises:
        FormatError: unreadable, no line, or a line that is not "stamp file stamp file".
    """
    pairs = {}
    try:
        for words in _rows(path, 4, "stamp file stamp file"):
            first, second = ((_stamp(words[k]), path.parent / words[k + 1]) for k in (0, 2))
            color, depth = (second, first) if "depth" in words[1] else (first, second)
            pairs[color[0]] = (color, depth)
    except InvalidOperation as error:
        raise FormatError(f"{path} holds a stamp that is no number; mend that line") from error
    return [pairs[stamp] for stamp in sorted(pairs)]


def associate(colors: list[_Stamped], depths: list[_Stamped]) -> list[tuple[_Stamped, _Stamped | None]]:
    """Each image with the depth nearest in time, within 20 ms; a depth image goes to one image only."""
    stamps = np.array([stamp for stamp, _ in depths])
    pairs: list[tuple[_Stamped, _Stamped | None]] = []
    taken = -1
    for color in colors:
        match = _nearest(color[0], stamps, _ASSOCIATION_NS)
        free = match is not None and match > taken
        pairs.append((color, depths[match] if match is not None and free else None))
        taken = taken if match is None else max(taken, match)
    return pairs


def _nearest(stamp: int, stamps: np.ndarray, within_ns: int) -> int | None:
    """Index of the nearest of sorted stamps, None beyond the limit."""
    k = int(np.searchsorted(stamps, stamp))
    near = [j for j in (k - 1, k) if 0 <= j < len(stamps)]
    best = min(near, key=lambda j: abs(int(stamps[j]) - stamp), default=None)
    return best if best is not None and abs(int(stamps[best]) - stamp) <= within_ns else None


def pose_at(trajectory: Trajectory, stamp: int, gap_ns: int) -> Float64 | None:
    """The pose at a time on the screw between its neighbours; None outside or where they are over ``gap_ns`` apart."""
    k = int(np.searchsorted(trajectory.stamps_ns, stamp))
    if k < len(trajectory) and trajectory.stamps_ns[k] == stamp:
        known: Float64 = trajectory.poses[k]
        return known
    if k in (0, len(trajectory)):
        return None
    t0, t1 = (int(t) for t in trajectory.stamps_ns[k - 1 : k + 1])
    if t1 - t0 > gap_ns:
        return None
    return se3.interpolate(trajectory.poses[k - 1], trajectory.poses[k], (stamp - t0) / (t1 - t0))


@dataclass(frozen=True)
class TumRgbd(Dataset):
    """TUM RGB-D benchmark. Its folders hold no calibration: the published one is taken by freiburg1..3 in the path.

    Each image gets the depth of associations.txt, else the nearest in time (20 ms); it keeps its own stamp. Depth
    is registered to the distorted colour image. Poses of groundtruth.txt are interpolated at the image's time.
    """

    name: ClassVar[str] = "TUM RGB-D"
    evidence: ClassVar[str] = "rgb.txt and depth.txt, or associations.txt; groundtruth.txt where there is one"
    depth_units: ClassVar[float | None] = 5000.0
    depth_encoding: ClassVar[str] = "32FC1"

    # Published by the authors, pixel centres at integers: fx, fy, cx, cy and plumb_bob k1 k2 p1 p2 k3.
    CALIBRATION: ClassVar[dict[str, tuple[float, ...]]] = {
        "1": (517.306408, 516.469215, 318.643040, 255.313989, 0.262383, -0.953104, -0.005358, 0.002628, 1.163314),
        "2": (520.908620, 521.007327, 325.141442, 249.701764, 0.231222, -0.784899, -0.003257, -0.000105, 0.917205),
        "3": (535.4, 539.2, 320.1, 247.6, 0.0, 0.0, 0.0, 0.0, 0.0),
    }

    @staticmethod
    def _associations(path: Path) -> Path | None:
        return first_existing(path / f"{name}.txt" for name in ("associations", "associated", "associate"))

    @staticmethod
    def matches(path: Path) -> bool:
        lists = (path / "rgb.txt").is_file() and (path / "depth.txt").is_file()
        return lists or TumRgbd._associations(path) is not None

    @cached_property
    def _pairs(self) -> Sequence[tuple[_Stamped, _Stamped | None]]:
        given = self._associations(self.path)
        if given is not None:
            return read_associations(given)
        return associate(*(read_file_list(self.path / name) for name in ("rgb.txt", "depth.txt")))

    def __len__(self) -> int:
        return len(self._pairs)

    def _calibration(self) -> tuple[Camera | None, Distortion | None]:
        found = re.search(r"freiburg([123])", str(self.path.resolve()))
        if found is None:
            return None, None
        fx, fy, cx, cy, *lens = self.CALIBRATION[found[1]]
        return Camera(640, 480, fx, fy, cx + 0.5, cy + 0.5, OPTICAL), Distortion("plumb_bob", tuple(lens))

    def samples(self) -> Iterator[Reader]:
        truth = self.path / "groundtruth.txt"
        trajectory = read_tum(truth) if truth.is_file() else None
        calibration = self._calibration()
        for (stamp, file), depth in self._pairs:
            pose = None if trajectory is None else pose_at(trajectory, stamp, _POSE_GAP_NS)
            yield partial(self._sample, stamp, file, depth, pose, *calibration)

    def _sample(
        self,
        stamp: int,
        file: Path,
        depth: _Stamped | None,
        pose: Float64 | None,
        camera: Camera | None,
        distortion: Distortion | None,
    ) -> Sample:
        depth_ns, depth_map = (None, None) if depth is None else (depth[0], read_depth(depth[1], self.per_metre))
        return Sample(stamp, file, read_rgb(file), camera, distortion, depth_map, depth_ns, pose=pose)

    def notes(self) -> Sequence[str]:
        if self._calibration()[0] is None:
            return ("no freiburg1..3 in its path, so the camera is not known; give --calibration",)
        return ("published calibration of the sensor named in the path",)


@dataclass(frozen=True)
class IclNuim(Dataset):
    """ICL-NUIM in its TUM-compatible form: rgb/N.png, depth/N.png and a trajectory ending in .freiburg.

    The renderer's world has y up and is left-handed (the negative fy of its documentation), while these PNGs are
    stored top row first. So fy is taken as +480 and each pose is mirrored into a right-handed world with y
    down: T' = F T F with F = diag(1, -1, 1). Frames are numbered and nominally 30 Hz; poses are exact.
    """

    name: ClassVar[str] = "ICL-NUIM"
    evidence: ClassVar[str] = "rgb/*.png, depth/*.png, one *.freiburg trajectory"
    depth_units: ClassVar[float | None] = 5000.0
    depth_encoding: ClassVar[str] = "32FC1"
    CAMERA: ClassVar[Camera] = Camera(640, 480, 481.20, 480.0, 320.0, 240.0, OPTICAL)

    @staticmethod
    def matches(path: Path) -> bool:
        return len(list(path.glob("*.freiburg"))) == 1 and (path / "rgb").is_dir() and (path / "depth").is_dir()

    @cached_property
    def _names(self) -> list[Path]:
        files = (p.name for folder in ("rgb", "depth") for p in (self.path / folder).glob("*.png"))
        return sorted({Path(name) for name in files}, key=natural_key)

    def __len__(self) -> int:
        return len(self._names)

    def samples(self) -> Iterator[Reader]:
        trajectory = read_tum(next(self.path.glob("*.freiburg")))
        mirror = np.diag([1.0, -1.0, 1.0, 1.0])
        poses = dict(zip((trajectory.stamps_ns // 10**9).tolist(), mirror @ trajectory.poses @ mirror, strict=True))
        for name in self._names:
            yield partial(self._sample, name.name, poses.get(number_of(name)))

    def _sample(self, name: str, pose: Float64 | None) -> Sample:
        file = self.path / "rgb" / name
        depth = read_depth(self.path / "depth" / name, self.per_metre)
        return Sample(stamp_30hz(number_of(file)), file, read_rgb(file), self.CAMERA, depth=depth, pose=pose)

    def notes(self) -> Sequence[str]:
        return ("poses are mirrored into a right-handed world (fy is +480); times are nominal, 30 Hz",)
