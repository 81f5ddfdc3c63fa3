"""Pictures without calibration: a folder of photos, and a video file."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
from PIL import ExifTags, Image

from sf_interfaces.errors import FormatError
from sf_interfaces.io.datasets.dataset import PHOTO_NS, START_NS, CameraFrames, Dataset, Reader, Sample
from sf_interfaces.io.datasets.files import images_in, read_rgb
from sf_interfaces.types import Camera, UInt8

VIDEO_SUFFIXES = frozenset({".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg"})
_MILLIMETRES_IN_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # FocalPlaneResolutionUnit: inch, cm, mm, micrometre
_DIAGONAL_35MM = 43.2666  # of a 36x24 mm frame, which the 35 mm equivalent refers to


def exif_focal(path: Path) -> float | None:
    """Focal length in pixels as the photo's EXIF states it, None where it does not.

    From the focal length and the resolution of the sensor, else from the 35 mm equivalent (by the diagonal).
    """
    try:
        with Image.open(path) as photo:
            width, height = photo.size
            tags = photo.getexif().get_ifd(ExifTags.IFD.Exif)
    except (OSError, ValueError, SyntaxError):
        return None  # whether the picture itself can be read is decided where it is read

    def number(tag: ExifTags.Base) -> float:
        try:
            return float(tags.get(tag, 0))
        except (TypeError, ValueError, ZeroDivisionError):
            return 0.0

    unit = _MILLIMETRES_IN_UNIT.get(int(number(ExifTags.Base.FocalPlaneResolutionUnit)))
    per_unit, focal = number(ExifTags.Base.FocalPlaneXResolution), number(ExifTags.Base.FocalLength)
    # The resolution is that of the sensor as recorded: a photo made smaller later no longer fits it.
    original = number(ExifTags.Base.ExifImageWidth) == width
    if unit is not None and per_unit > 0 and focal > 0 and original:
        return focal * per_unit / unit
    equivalent = number(ExifTags.Base.FocalLengthIn35mmFilm)
    return equivalent / _DIAGONAL_35MM * float(np.hypot(width, height)) if equivalent > 0 else None


@dataclass(frozen=True)
class Photos(Dataset):
    """A folder of photos, one second apart in natural order of their names.

    A focal length in EXIF becomes the calibration (principal point in the centre, no distortion); without it
    there is none. The sensor's rows stay as they are: rotation in EXIF is not applied.
    """

    name: ClassVar[str] = "photos"
    evidence: ClassVar[str] = "image files, there or in images/"
    goal: ClassVar[str] = "mvd"

    @staticmethod
    def matches(path: Path) -> bool:
        return bool(images_in(path) or images_in(path / "images"))

    @cached_property
    def _files(self) -> list[Path]:
        return images_in(self.path) or images_in(self.path / "images")

    @cached_property
    def _all_have_focal(self) -> bool:
        return all(exif_focal(file) is not None for file in self._files)

    def __len__(self) -> int:
        return len(self._files)

    def samples(self) -> Iterator[Reader]:
        frames = CameraFrames()
        for i, file in enumerate(self._files):
            yield partial(self._sample, START_NS + i * PHOTO_NS, file, frames)

    def _sample(self, stamp: int, file: Path, frames: CameraFrames) -> Sample:
        image = read_rgb(file)
        focal = exif_focal(file) if self._all_have_focal else None
        if focal is None:
            return Sample(stamp, file, image)
        height, width = image.shape[:2]
        frame = frames((width, height, focal))
        return Sample(stamp, file, image, Camera(width, height, focal, focal, width / 2, height / 2, frame))

    def notes(self) -> Sequence[str]:
        order = "photos have no time: they lie 1 s apart in the order of their names"
        if not self._all_have_focal:
            return (f"{order}; not every photo states a focal length in EXIF, so there is no calibration",)
        focal = exif_focal(self._files[0])
        return (
            f"{order}; EXIF of {self._files[0].name} says a focal length of {focal:.0f} px: taken as calibration with "
            "the principal point in the centre and no distortion (--calibration is better)",
        )


@dataclass(frozen=True)
class Video(Dataset):
    """A video file; frame times are the container's."""

    name: ClassVar[str] = "video"
    evidence: ClassVar[str] = "a file .mp4, .avi, .mov, .mkv, .webm, .m4v or .mpg"

    @staticmethod
    def matches(path: Path) -> bool:
        return path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES

    def _open(self) -> cv2.VideoCapture:
        capture = cv2.VideoCapture(str(self.path))
        if not capture.isOpened():
            raise FormatError(f"video {self.path} cannot be opened; convert it, for example to .mp4 with H.264")
        return capture

    @cached_property
    def _count(self) -> int:
        capture = self._open()
        count = max(0, int(capture.get(cv2.CAP_PROP_FRAME_COUNT)))  # a damaged header may say anything
        capture.release()
        return count

    def __len__(self) -> int:
        return self._count

    def samples(self) -> Iterator[Reader]:
        capture = self._open()
        done = 0
        last_ns = START_NS - 1
        try:
            while True:
                whole, frame = capture.read()
                if not whole:
                    break
                stamp = START_NS + round(capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
                yield self._reader(np.asarray(frame, dtype=np.uint8), stamp, last_ns)
                last_ns, done = max(last_ns, stamp), done + 1
        finally:
            capture.release()
        if done < self._count - max(2, self._count // 50):  # some containers only estimate the count
            yield partial(self._truncated, done)

    def _reader(self, frame: UInt8, stamp: int, last_ns: int) -> Callable[[], Sample]:
        def read() -> Sample:
            if stamp <= last_ns:
                raise FormatError(f"video {self.path}: times of its container do not increase at {stamp * 1e-9:.3f} s")
            image = frame if frame.ndim == 2 else np.ascontiguousarray(frame[..., ::-1])
            return Sample(stamp, self.path, image)

        return read

    def _truncated(self, done: int) -> Sample:
        raise FormatError(f"video {self.path} ends after {done} of {self._count} frames; copy it again")
