"""Posed photo sets: COLMAP models, ETH3D, DTU/MVSNet, Strecha/OpenMVG cameras, robustmvd samples.

Photos have no time: they lie one second apart in the order of their names, and no order is meant by it. Lengths
keep the unit of the layout (DTU: millimetres, COLMAP: arbitrary).
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import ClassVar

import numpy as np

from sf_interfaces.errors import FormatError
from sf_interfaces.geometry import se3
from sf_interfaces.geometry.undistort import Distortion
from sf_interfaces.io.colmap import ColmapCamera, ColmapImage, is_model, read_model, read_points
from sf_interfaces.io.datasets.dataset import PHOTO_NS, START_NS, CameraFrames, Dataset, Reader, Sample
from sf_interfaces.io.datasets.files import (
    as_depth,
    first_existing,
    images_in,
    natural_key,
    number_of,
    read_numbers,
    read_pfm,
    read_rgb,
    rigid,
)
from sf_interfaces.types import Camera, DepthMap, Float64, PointCloud


def _camera(K: Float64, width: int, height: int, frame_id: str) -> Camera:
    """From a calibration matrix with pixel centres at integers."""
    return Camera(width, height, K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5, frame_id)


@dataclass(frozen=True)
class Colmap(Dataset):
    """A COLMAP model (text or binary) with its images; lens distortion travels along and is taken out on input."""

    name: ClassVar[str] = "COLMAP"
    evidence: ClassVar[str] = "cameras and images (.bin or .txt) there or in sparse/0, sparse; images/ there or above"
    goal: ClassVar[str] = "mvd"

    @staticmethod
    def _find(path: Path) -> Path | None:
        """The folder of the model."""
        return next((f for f in (path, path / "sparse" / "0", path / "sparse") if is_model(f)), None)

    @staticmethod
    def matches(path: Path) -> bool:
        return Colmap._find(path) is not None

    @property
    def model_folder(self) -> Path:
        return self._find(self.path) or self.path

    @cached_property
    def image_folder(self) -> Path:
        folders = [folder / "images" for folder in (self.path, *self.path.resolve().parents[:2])]
        return first_existing(folders) or folders[0]

    @cached_property
    def _model(self) -> tuple[dict[int, ColmapCamera], list[ColmapImage]]:
        cameras, images = read_model(self.model_folder)
        return cameras, sorted(images, key=lambda image: (image.name.count("/"), natural_key(Path(image.name))))

    def __len__(self) -> int:
        return len(self._model[1])

    def samples(self) -> Iterator[Reader]:
        cameras, images = self._model
        frames = CameraFrames()
        known = {number: camera.calibration(frames(number)) for number, camera in sorted(cameras.items())}
        for i, image in enumerate(images):
            yield partial(self._sample, START_NS + i * PHOTO_NS, image, *known[image.camera_id])

    def _sample(self, stamp: int, image: ColmapImage, camera: Camera, distortion: Distortion | None) -> Sample:
        file = self.image_folder / image.name
        pixels = read_rgb(file)
        reference = self.reference_depth(image, camera)
        return Sample(stamp, file, pixels, camera, distortion, pose=image.T_map_camera, reference_depth=reference)

    def reference_depth(self, image: ColmapImage, camera: Camera) -> DepthMap | None:
        """Depth to measure against; a plain model has none."""
        return None

    def points(self) -> Iterator[PointCloud]:
        return read_points(self.model_folder)

    def notes(self) -> Sequence[str]:
        return ("lengths are in the unit of the model, which is no metre unless it was scaled",)


@dataclass(frozen=True)
class Eth3d(Colmap):
    """An ETH3D scene: undistorted images with their calibration; metric, registered to a laser scan.

    Its ground-truth depth is of the original, distorted images: it serves only where it was carried over to
    the undistorted ones, which its size shows.
    """

    name: ClassVar[str] = "ETH3D"
    evidence: ClassVar[str] = "*_calibration_undistorted/cameras.txt, images/; ground_truth_depth/ of the same size"

    @staticmethod
    def _find(path: Path) -> Path | None:
        found = sorted(f for f in path.glob("*_calibration_undistorted") if is_model(f))
        return found[0] if found else None  # the DSLR comes before the rig

    @staticmethod
    def matches(path: Path) -> bool:
        return Eth3d._find(path) is not None

    def reference_depth(self, image: ColmapImage, camera: Camera) -> DepthMap | None:
        file = next(self.path.glob(f"ground_truth_depth/*/{Path(image.name).name}"), None)
        if file is None or file.stat().st_size != 4 * camera.width * camera.height:
            return None
        return as_depth(np.fromfile(file, "<f4").reshape(camera.height, camera.width))

    def notes(self) -> Sequence[str]:
        if (self.path / "ground_truth_depth").is_dir():
            return ("ground-truth depth is used where it has the size of the undistorted image, else left out",)
        return ()


@dataclass(frozen=True)
class MvsNet(Dataset):
    """DTU and others in the layout of MVSNet: one text file per camera, optional depth as PFM."""

    name: ClassVar[str] = "DTU/MVSNet"
    evidence: ClassVar[str] = "cams/*_cam.txt, images/ or blended_images/; depths/*.pfm or rendered_depth_maps/*.pfm"
    goal: ClassVar[str] = "mvd"

    @staticmethod
    def matches(path: Path) -> bool:
        return any((path / "cams").glob("*_cam.txt")) and MvsNet._images(path) is not None

    @staticmethod
    def _images(path: Path) -> Path | None:
        return first_existing([path / "images", path / "blended_images"])

    @cached_property
    def _files(self) -> list[Path]:
        return images_in(self._images(self.path) or self.path)

    def __len__(self) -> int:
        return len(self._files)

    def samples(self) -> Iterator[Reader]:
        cams = {number_of(p.with_name(p.name.replace("_cam", ""))): p for p in (self.path / "cams").glob("*_cam.txt")}
        depths = ("depths", "depth", "depth_gt", "rendered_depth_maps")
        folder = first_existing(self.path / name for name in depths)
        frames = CameraFrames()
        for i, file in enumerate(self._files):
            cam = cams.get(number_of(file), self.path / "cams" / f"{file.stem}_cam.txt")
            depth = None if folder is None else folder / f"{file.stem}.pfm"
            yield partial(self._sample, START_NS + i * PHOTO_NS, file, cam, depth, frames)

    def _sample(self, stamp: int, file: Path, cam: Path, depth: Path | None, frames: CameraFrames) -> Sample:
        T, K = read_mvsnet_camera(cam)
        image = read_rgb(file)
        frame = frames((*K.ravel().tolist(), *image.shape))
        camera = _camera(K, image.shape[1], image.shape[0], frame)
        reference = None if depth is None else as_depth(read_pfm(depth))
        if reference is not None and reference.z.shape != image.shape[:2]:
            raise FormatError(f"depth {depth} is not of the size of {file}; give depth maps of the full images")
        return Sample(stamp, file, image, camera, pose=T, reference_depth=reference)

    def notes(self) -> Sequence[str]:
        return ("lengths are in the unit of the camera files (DTU: millimetres)",)


def read_mvsnet_camera(path: Path) -> tuple[Float64, Float64]:
    """T_map_camera and K of a cam.txt: "extrinsic" with 16 numbers (world to camera), "intrinsic" with 9.

    Raises:
        FormatError: missing or malformed, or no rigid motion.
    """
    try:
        words = path.read_text().split()
        a, b = words.index("extrinsic") + 1, words.index("intrinsic") + 1
        T = np.array(words[a : a + 16], dtype=np.float64).reshape(4, 4)
        K = np.array(words[b : b + 9], dtype=np.float64).reshape(3, 3)
    except (OSError, ValueError) as error:
        raise FormatError(
            f"{path} must hold 'extrinsic' with 4x4 and 'intrinsic' with 3x3 numbers ({error}); copy it again"
        ) from error
    return se3.inverse(rigid(T, path)), K


@dataclass(frozen=True)
class Strecha(Dataset):
    """Photos with a ``NAME.camera`` each: K, a row of zeros, R (camera to world), centre, width and height."""

    name: ClassVar[str] = "Strecha/OpenMVG cameras"
    evidence: ClassVar[str] = "images/*, and NAME.camera there or in gt_dense_cameras/"
    goal: ClassVar[str] = "mvd"

    @staticmethod
    def _cameras(path: Path) -> Path | None:
        """The folder of the camera files."""
        folders = (path / "gt_dense_cameras", path / "images", path)
        return next((f for f in folders if any(f.glob("*.camera"))), None)

    @staticmethod
    def matches(path: Path) -> bool:
        return Strecha._cameras(path) is not None

    @cached_property
    def _files(self) -> list[Path]:
        return images_in(self.path / "images") or images_in(self.path)

    def __len__(self) -> int:
        return len(self._files)

    def samples(self) -> Iterator[Reader]:
        folder = self._cameras(self.path) or self.path
        frames = CameraFrames()
        for i, file in enumerate(self._files):
            yield partial(self._sample, START_NS + i * PHOTO_NS, file, folder / f"{file.name}.camera", frames)

    def _sample(self, stamp: int, file: Path, path: Path, frames: CameraFrames) -> Sample:
        values = read_numbers(path, (26,))
        K, size = values[:9].reshape(3, 3), (int(values[24]), int(values[25]))
        T = rigid(np.hstack([values[12:21].reshape(3, 3), values[21:24, None]]), path)
        frame = frames((*K.ravel().tolist(), *size))
        return Sample(stamp, file, read_rgb(file), _camera(K, *size, frame), pose=T)


@dataclass(frozen=True)
class RobustMvd(Dataset):
    """A robustmvd sample: a key view and its sources; the key camera is the map frame."""

    name: ClassVar[str] = "robustmvd sample"
    evidence: ClassVar[str] = "key/ and source/N/ with image.png, K.npy, to_ref_transform.npy"
    goal: ClassVar[str] = "mvd"

    @staticmethod
    def matches(path: Path) -> bool:
        return (path / "key" / "K.npy").is_file() and (path / "source").is_dir()

    @cached_property
    def _views(self) -> list[Path]:
        sources = sorted((p for p in (self.path / "source").iterdir() if p.is_dir()), key=natural_key)
        return [self.path / "key", *sources]

    def __len__(self) -> int:
        return len(self._views)

    def samples(self) -> Iterator[Reader]:
        frames = CameraFrames()
        for i, view in enumerate(self._views):
            yield partial(self._sample, START_NS + i * PHOTO_NS, view, frames)

    def _sample(self, stamp: int, view: Path, frames: CameraFrames) -> Sample:
        file = view / "image.png"
        K = _read_npy(view / "K.npy", (3, 3))
        T_view_key = rigid(_read_npy(view / "to_ref_transform.npy", (4, 4)), view / "to_ref_transform.npy")
        image = read_rgb(file)
        frame = frames((*K.ravel().tolist(), *image.shape))
        camera = _camera(K, image.shape[1], image.shape[0], frame)
        return Sample(stamp, file, image, camera, pose=se3.inverse(T_view_key))

    def notes(self) -> Sequence[str]:
        return ("the first frame is the key view, and its camera is the map frame",)


def _read_npy(path: Path, shape: tuple[int, int]) -> Float64:
    try:
        values = np.load(path, allow_pickle=False)
        return np.asarray(values, dtype=np.float64).reshape(shape)
    except Exception as error:  # numpy's header is a piece of Python, and its parser raises what that raises
        raise FormatError(f"{path} must hold {shape[0]}x{shape[1]} numbers ({error}); copy it again") from error
