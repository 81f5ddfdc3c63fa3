"""Files of data sets: each reader checks what it reads and names the file in one sentence where it is bad."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sf_interfaces.errors import FormatError
from sf_interfaces.geometry import se3
from sf_interfaces.types import DepthMap, Float32, Float64, UInt8

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".ppm"})
_PLAUSIBLE_DEPTH_M = (0.05, 100.0)  # median of a depth image; a unit that is wrong by 1000 lies outside
_RIGID = 0.02  # |R R^T - I| of poses that were rounded or averaged; beyond it is no rotation
_SATURATED = 65535  # what Kinect drivers write where they saw nothing


def natural_key(path: Path) -> tuple[list[tuple[int, int | str]], str]:
    """Sorting key that puts 2.jpg before 10.jpg."""
    parts = re.split(r"(\d+)", path.name)
    return [(0, int(part)) if part.isdigit() else (1, part) for part in parts if part], path.name


def images_in(folder: Path) -> list[Path]:
    """The image files of a folder in natural order (none if there is no such folder)."""
    if not folder.is_dir():
        return []
    found = [p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith(".")]
    return sorted(found, key=natural_key)


def number_of(path: Path) -> int:
    """The last number in a file name: 12 of ``frame-000012.color.png``.

    Raises:
        FormatError: there is none.
    """
    digits = re.findall(r"\d+", path.name.split(".")[0])
    if not digits:
        raise FormatError(f"{path} has no frame number in its name; restore the names of the data set")
    return int(digits[-1])


def first_existing(candidates: Iterable[Path]) -> Path | None:
    """The first path that is there."""
    return next((path for path in candidates if path.exists()), None)


def _jpeg_is_whole(data: bytes) -> bool:
    """Whether the picture ends: a decoder fills what a truncated file lacks with grey and says nothing."""
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF:
        if data[at + 1] == 0xDA:  # start of scan; behind it, FF D9 cannot occur but as the end
            return data.find(b"\xff\xd9", at) >= 0
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return False


def _is_whole(data: bytes) -> bool:
    if data[:2] == b"\xff\xd8":
        return _jpeg_is_whole(data)
    return data[:8] != b"\x89PNG\r\n\x1a\n" or b"IEND" in data[-64:]


def read_image(path: Path, flags: int) -> NDArray[Any]:
    """Any picture as OpenCV decodes it, rotation in EXIF left alone: calibrations are of the sensor's rows.

    Raises:
        FormatError: missing, truncated or damaged.
    """
    try:
        data = path.read_bytes()
    except (OSError, ValueError) as error:  # a damaged list may name what is no path
        raise FormatError(f"image {str(path)!r} is missing ({error}); copy the data set again") from error
    if not _is_whole(data):
        raise FormatError(f"image {path} is truncated ({len(data)} bytes); copy the data set again")
    if flags != cv2.IMREAD_UNCHANGED:
        flags |= cv2.IMREAD_IGNORE_ORIENTATION
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    except cv2.error:
        image = None
    if image is None:
        raise FormatError(f"image {path} is damaged or no picture; copy the data set again")
    return np.asarray(image)


def read_rgb(path: Path) -> UInt8:
    """A picture as RGB [H, W, 3] uint8.

    Raises:
        FormatError: missing, truncated or damaged.
    """
    return np.ascontiguousarray(read_image(path, cv2.IMREAD_COLOR)[..., ::-1], dtype=np.uint8)


def read_depth(path: Path, per_metre: float) -> DepthMap:
    """A 16-bit depth image; 0 and 65535 are no data.

    Args:
        per_metre: stored units in one metre.

    Raises:
        FormatError: missing, truncated, not of 16 bit and one channel, or its median is no depth in metres.
    """
    raw = read_image(path, cv2.IMREAD_UNCHANGED)
    if raw.dtype != np.uint16 or raw.ndim != 2:
        channels = 1 if raw.ndim == 2 else raw.shape[2]
        raise FormatError(
            f"depth image {path} has {raw.dtype.itemsize * 8} bit and {channels} channel(s), depth needs 16 bit "
            "and one; export the raw depth, not a picture of it"
        )
    valid = (raw != 0) & (raw != _SATURATED)
    depth = DepthMap(np.where(valid, raw / per_metre, np.nan))
    if valid.any():
        median = float(np.median(raw[valid])) / per_metre
        if not _PLAUSIBLE_DEPTH_M[0] <= median <= _PLAUSIBLE_DEPTH_M[1]:
            raise FormatError(
                f"depth image {path} has a median of {median:g} m when {per_metre:g} units are one metre, so its "
                "unit looks wrong; give the right number with --depth-scale"
            )
    return depth


def read_pfm(path: Path) -> Float32:
    """A grey PFM image [H, W], top row first.

    Raises:
        FormatError: missing, no grey PFM, or truncated.
    """
    try:
        with path.open("rb") as file:
            kind, size, scale = (file.readline().split() for _ in range(3))
            width, height = int(size[0]), int(size[1])
            dtype = "<f4" if float(scale[0]) < 0 else ">f4"
            values = np.frombuffer(file.read(), dtype, count=width * height)
    except (OSError, ValueError, IndexError) as error:
        raise FormatError(f"{path} is missing or no whole PFM image ({error}); copy the data set again") from error
    if kind != [b"Pf"]:
        raise FormatError(f"{path} is no grey PFM image (it begins with {kind}); copy the data set again")
    return np.ascontiguousarray(values.reshape(height, width)[::-1], dtype=np.float32)


def as_depth(z: NDArray[Any]) -> DepthMap:
    """Depth values of any kind; what is not finite and positive becomes NaN."""
    z = np.asarray(z, dtype=np.float32)
    return DepthMap(np.where(np.isfinite(z) & (z > 0), z, np.float32(np.nan)))


def read_numbers(path: Path, shape: tuple[int, ...]) -> Float64:
    """Numbers of a text file in a shape; -1 leaves one length open.

    Raises:
        FormatError: missing, something that is no number, or another count.
    """
    try:
        return np.array(path.read_text().split(), dtype=np.float64).reshape(shape)
    except (OSError, ValueError) as error:
        wanted = "x".join("N" if n < 0 else str(n) for n in shape)
        raise FormatError(f"{path} must hold {wanted} numbers ({error}); copy the data set again") from error


def rigid(T: Float64, source: Path) -> Float64:
    """The rigid motion nearest to a pose matrix [4, 4] or [3, 4] that was rounded or averaged.

    Raises:
        FormatError: not finite, or no rotation (scaled, sheared or mirrored); names ``source``.
    """
    out = np.eye(4)
    out[:3] = T[:3, :4]
    if not np.isfinite(out).all():
        raise FormatError(f"pose in {source} is not finite: the reference was lost there; leave the frame out")
    R = out[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > _RIGID or np.linalg.det(R) < 0:
        raise FormatError(f"pose in {source} is no rigid motion: its 3x3 part is no rotation; mend or remove it")
    return se3.orthonormalise(out)


def read_pose(path: Path) -> Float64:
    """A pose file of 4x4 numbers.

    Raises:
        FormatError: missing, malformed, not finite, or no rigid motion.
    """
    return rigid(read_numbers(path, (4, 4)), path)


def read_sweep(path: Path) -> Float32:
    """A LiDAR sweep [N, 4]: x y z (m) and reflectance, float32.

    Raises:
        FormatError: missing, empty, or no whole number of points.
    """
    try:
        values = np.fromfile(path, dtype="<f4")
    except OSError as error:
        raise FormatError(f"sweep {path} is missing ({error.strerror}); copy the data set again") from error
    if not values.size or path.stat().st_size % 16:
        raise FormatError(f"{path} does not hold four floats per point; copy the data set again")
    return values.reshape(-1, 4)
