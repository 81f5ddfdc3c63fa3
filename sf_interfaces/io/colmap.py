"""COLMAP models (text and binary): cameras, images with poses, points. Pixel centres are at + 0.5 there too."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import numpy as np

from sf_interfaces.errors import CalibrationError, FormatError
from sf_interfaces.geometry import se3
from sf_interfaces.geometry.undistort import Distortion
from sf_interfaces.types import Camera, Float64, PointCloud

# Name, number of parameters; the position in this list is the id in binary files.
_MODELS = (
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
)
_LENS = {
    "SIMPLE_RADIAL": "plumb_bob",
    "RADIAL": "plumb_bob",
    "OPENCV": "plumb_bob",
    "FULL_OPENCV": "rational_polynomial",
    "OPENCV_FISHEYE": "equidistant",
    "SIMPLE_RADIAL_FISHEYE": "equidistant",
    "RADIAL_FISHEYE": "equidistant",
}
_ONE_FOCAL = {"SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"}
# What damaged counts and lengths lead to: reading short, seeking out of range, asking for too much memory.
_DAMAGED = (OSError, ValueError, IndexError, KeyError, OverflowError, MemoryError, struct.error)
_POINTS_IN_A_PART = 100_000
_T = TypeVar("_T")


@dataclass(frozen=True, slots=True)
class ColmapCamera:
    """One camera: model name, image size, parameters in COLMAP's order."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    def calibration(self, frame_id: str) -> tuple[Camera, Distortion | None]:
        """As intrinsics and lens distortion.

        Raises:
            CalibrationError: a lens model that cannot be undistorted here.
        """
        if self.model not in _LENS and not self.model.endswith("PINHOLE"):
            raise CalibrationError(
                f"camera model {self.model} cannot be undistorted here; let COLMAP's image_undistorter do it"
            )
        fx, *rest = self.params
        fy = fx if self.model in _ONE_FOCAL else rest.pop(0)
        cx, cy, *lens = rest
        camera = Camera(self.width, self.height, fx, fy, cx, cy, frame_id)
        if not any(lens):
            return camera, None
        wanted = {"plumb_bob": 5, "equidistant": 4, "rational_polynomial": 8}[_LENS[self.model]]
        return camera, Distortion(_LENS[self.model], (*lens, *(0.0,) * (wanted - len(lens))))


@dataclass(frozen=True, slots=True)
class ColmapImage:
    """One registered image: its file name, camera and pose ``T_map_camera``."""

    name: str
    camera_id: int
    T_map_camera: Float64


def is_model(folder: Path) -> bool:
    """Whether a folder holds cameras and images of a model, as .bin or .txt."""
    return any(all((folder / f"{name}{s}").is_file() for name in ("cameras", "images")) for s in (".bin", ".txt"))


def read_model(folder: Path) -> tuple[dict[int, ColmapCamera], list[ColmapImage]]:
    """Cameras by id and registered images by name; a binary model wins over a text one.

    Raises:
        FormatError: a file is missing, truncated or malformed.
    """
    binary = (folder / "cameras.bin").is_file()
    cameras_file, images_file = (folder / f"{name}.{'bin' if binary else 'txt'}" for name in ("cameras", "images"))
    cameras = _parsed(cameras_file, _binary_cameras if binary else _text_cameras)
    images = _parsed(images_file, _binary_images if binary else _text_images)
    for image in images:
        if image.camera_id not in cameras:
            raise FormatError(f"{images_file}: {image.name} has camera {image.camera_id}, not in {cameras_file}")
    return cameras, sorted(images, key=lambda image: image.name)


def read_points(folder: Path) -> Iterator[PointCloud]:
    """The triangulated points with colour, in the model's frame, in parts; none where the file is absent.

    Raises:
        FormatError: truncated or malformed.
    """
    binary, text = folder / "points3D.bin", folder / "points3D.txt"
    file = binary if binary.is_file() else text
    if not file.is_file():
        return
    rows: list[tuple[float, ...]] = []
    try:
        with file.open("rb") as stream:
            for row in _binary_points(stream) if file == binary else _text_points(stream):
                rows.append(row)
                if len(rows) == _POINTS_IN_A_PART:
                    yield _cloud(rows)
                    rows = []
    except _DAMAGED as error:
        raise FormatError(f"{file} is truncated or malformed ({error}); export the model again") from error
    if rows:
        yield _cloud(rows)


def _cloud(rows: list[tuple[float, ...]]) -> PointCloud:
    values = np.array(rows)
    return PointCloud(values[:, :3].astype(np.float32), values[:, 3:].astype(np.uint8))


def _parsed(path: Path, parse: Callable[[BinaryIO], _T]) -> _T:
    try:
        with path.open("rb") as stream:
            return parse(stream)
    except _DAMAGED as error:
        raise FormatError(f"{path} is missing, truncated or malformed ({error}); export the model again") from error


def _unpack(stream: BinaryIO, form: str) -> tuple[Any, ...]:
    size = struct.calcsize("<" + form)
    return struct.unpack("<" + form, stream.read(size))


def _binary_cameras(stream: BinaryIO) -> dict[int, ColmapCamera]:
    cameras = {}
    for _ in range(_unpack(stream, "Q")[0]):
        number, model, width, height = _unpack(stream, "iiQQ")
        name, count = _MODELS[model]
        cameras[number] = ColmapCamera(name, width, height, _unpack(stream, f"{count}d"))
    return cameras


def _binary_images(stream: BinaryIO) -> list[ColmapImage]:
    images = []
    for _ in range(_unpack(stream, "Q")[0]):
        _, *pose, camera_id = _unpack(stream, "I7dI")
        name = bytearray()
        while (byte := _unpack(stream, "c")[0]) != b"\0":
            name += byte
        images.append(ColmapImage(name.decode(), camera_id, _pose(pose)))
        observations = _unpack(stream, "Q")[0]
        if len(stream.read(24 * observations)) != 24 * observations:
            raise ValueError("it ends within the observations of an image")
    return images


def _binary_points(stream: BinaryIO) -> Iterator[tuple[float, ...]]:
    for _ in range(_unpack(stream, "Q")[0]):
        _, x, y, z, r, g, b, _, track = _unpack(stream, "Q3d3BdQ")
        stream.seek(8 * track, 1)
        yield x, y, z, r, g, b


def _lines(stream: BinaryIO) -> Iterator[str]:
    """Lines of text without comments; an empty one means something in images.txt."""
    for line in stream:
        if not line.startswith(b"#"):
            yield line.decode().strip()


def _text_cameras(stream: BinaryIO) -> dict[int, ColmapCamera]:
    cameras = {}
    counts = dict(_MODELS)
    for line in filter(None, _lines(stream)):
        number, model, width, height, *params = line.split()
        if len(params) != counts[model]:
            raise ValueError(f"camera {number} has {len(params)} parameters, {model} needs {counts[model]}")
        cameras[int(number)] = ColmapCamera(model, int(width), int(height), tuple(map(float, params)))
    return cameras


def _text_images(stream: BinaryIO) -> list[ColmapImage]:
    images = []
    lines = _lines(stream)
    for line in lines:
        if line:
            _, *pose, camera_id, name = line.split(maxsplit=9)
            images.append(ColmapImage(name, int(camera_id), _pose([float(v) for v in pose])))
            next(lines, "")  # the observations of this image, which may be an empty line
    return images


def _text_points(stream: BinaryIO) -> Iterator[tuple[float, ...]]:
    for line in filter(None, _lines(stream)):
        _, x, y, z, r, g, b, *_ = line.split()
        yield float(x), float(y), float(z), float(r), float(g), float(b)


def _pose(values: list[float]) -> Float64:
    """T_map_camera from COLMAP's world-to-camera quaternion w x y z and translation."""
    w, x, y, z, *t = values
    if not np.isfinite(values).all() or abs(np.linalg.norm([w, x, y, z]) - 1) > 1e-2:
        raise ValueError(f"a pose is not finite or its quaternion not of unit length: {values}")
    return se3.inverse(se3.from_quaternion(np.array(t), np.array([x, y, z, w])))
