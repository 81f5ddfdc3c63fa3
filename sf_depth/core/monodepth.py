"""Depth of a single image, up to scale (paper Sec. Monocular Depth and Depth Completion).

It is the base whose scale ScaleCov regresses where nothing was triangulated. Learned models are optional: their
weights are taken from a path or from the user's cache, and never downloaded. Without one, :class:`StructurePrior`
needs no training: it only knows that depth is piecewise planar and that its breaks are breaks of the image.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np

from sf_interfaces.errors import ConfigError
from sf_interfaces.types import Camera, DepthMap, Float32, Float64, Scale, UInt8

MONODEPTH_GROUP = "scenefactory.monodepth"
_METRIC3D = "yvanyin_metric3d_main"  # folder of the repository in the torch hub cache
_SEGMENT = 24  # px; pitch of the seeds that grow into segments
_COLOR = 0.06  # grey level (0..1) that separates like one pitch of distance
_ROUNDS = 4


class MonoDepth(Protocol):
    """Anything that guesses depth from one image, learned or not."""

    name: str

    def __call__(self, image: UInt8, camera: Camera, observed: DepthMap | None = None) -> DepthMap:
        """Depth of every pixel of an RGB or mono image, up to scale.

        Args:
            observed: triangulated depth; learned models ignore it.
        """
        ...


def load_monodepth(name: str, path: str = "") -> MonoDepth:
    """The model of a name: ``structure``, ``metric3d``, ``depth_anything``, or one of an installed package.

    Args:
        path: folder or file of the weights; empty takes the user's cache.

    Raises:
        ConfigError: unknown name, or the package or the weights of a learned model are not there.
    """
    if name == StructurePrior.name:
        return StructurePrior()
    if name == Metric3D.name:
        return Metric3D.load(path)
    if name == DepthAnything.name:
        return DepthAnything.load(path)
    points = {point.name: point for point in entry_points(group=MONODEPTH_GROUP)}
    if name not in points:
        known = ", ".join([StructurePrior.name, Metric3D.name, DepthAnything.name, *sorted(points)])
        raise ConfigError(f"no monocular depth '{name}' is installed; choose one of {known}")
    made: MonoDepth = points[name].load()(path)
    return made


@dataclass(frozen=True, slots=True)
class StructurePrior:
    """Training-free prior, not a depth estimator: one plane in inverse depth a segment, fitted to what was observed.

    Segments without observations take the plane of all of them.
    """

    name = "structure"

    def __call__(self, image: UInt8, camera: Camera, observed: DepthMap | None = None) -> DepthMap:
        """Piecewise planar depth; a fronto-parallel plane where nothing at all was observed."""
        if observed is None or not observed.valid.any():
            return DepthMap(np.ones(image.shape[:2], np.float32), None, Scale.ARBITRARY)
        label = _segments(image)
        row, col = np.nonzero(observed.valid)
        d = 1.0 / observed.z[row, col].astype(np.float64)
        planes = _planes(label[row, col], _plane_rows(row, col, image.shape), d, int(label.max()) + 1)
        v, u = np.indices(image.shape[:2])
        fitted = (_plane_rows(v.ravel(), u.ravel(), image.shape) * planes[label.ravel()]).sum(axis=1)
        low, high = np.quantile(d, [0.01, 0.99])
        z = (1.0 / np.clip(fitted, low / 2, high * 2)).reshape(image.shape[:2])
        return DepthMap(z.astype(np.float32), None, observed.scale)


def _plane_rows(row: np.ndarray, col: np.ndarray, shape: tuple[int, ...]) -> Float64:
    """Rows [N, 3] of the linear equations of planes in inverse depth, centred and of order one."""
    scale = max(shape[:2])
    return np.stack([(col - shape[1] / 2) / scale, (row - shape[0] / 2) / scale, np.ones(len(row))], axis=1)


def _planes(label: np.ndarray, rows: Float64, d: Float64, count: int) -> Float64:
    """Plane [count, 3] of each segment, drawn to the plane of all by as much as a few pixels weigh."""
    whole, *_ = np.linalg.lstsq(rows, d, rcond=None)
    normal = np.zeros((count, 3, 3))
    right = np.zeros((count, 3))
    np.add.at(normal, label, rows[:, :, None] * rows[:, None])
    np.add.at(right, label, rows * (d - rows @ whole)[:, None])
    return whole + np.linalg.solve(normal + np.diag([0.5, 0.5, 0.05]), right[..., None])[..., 0]


def _segments(image: UInt8) -> np.ndarray:
    """Compact segments of like colour [H, W]: k-means over place and colour from a regular grid of seeds."""
    height, width = image.shape[:2]
    smooth = cv2.GaussianBlur(image.astype(np.float32) / 255.0, (0, 0), 1.5).reshape(height, width, -1)
    rows, cols = max(2, height // _SEGMENT), max(2, width // _SEGMENT)
    v, u = np.indices((height, width), dtype=np.float32)
    feature = np.concatenate([np.stack([v, u], -1) / _SEGMENT, smooth / _COLOR], axis=2)
    grid_v, grid_u = np.minimum(v * rows // height, rows - 1), np.minimum(u * cols // width, cols - 1)
    home = (grid_v * cols + grid_u).astype(np.int64)
    label = home
    for _ in range(_ROUNDS):
        label = _nearest_center(feature, _centers(feature, label, rows * cols), home, rows, cols)
    return label


def _centers(feature: Float32, label: np.ndarray, count: int) -> Float32:
    """Mean feature of each segment, [count, C]."""
    size = np.bincount(label.ravel(), minlength=count).clip(1)
    flat = feature.reshape(-1, feature.shape[2])
    sums = [np.bincount(label.ravel(), flat[:, k], count) for k in range(flat.shape[1])]
    return (np.stack(sums, axis=1) / size[:, None]).astype(np.float32)


def _nearest_center(feature: Float32, center: Float32, home: np.ndarray, rows: int, cols: int) -> np.ndarray:
    """Segment of the nearest centre among the nine around each pixel's own cell."""
    best = np.full(home.shape, np.inf, np.float32)
    label = home.copy()
    r, c = home // cols, home % cols
    for dr in (-1, 0, 1):
        for dc in (-1, 0, 1):
            other = np.clip(r + dr, 0, rows - 1) * cols + np.clip(c + dc, 0, cols - 1)
            distance = ((feature - center[other]) ** 2).sum(axis=2)
            nearer = distance < best
            best[nearer], label[nearer] = distance[nearer], other[nearer]
    return label


def _module(name: str, package: str) -> Any:
    try:
        return import_module(name)
    except ImportError as error:
        raise ConfigError(f"this monocular depth needs {package}: pip install {package}") from error


@dataclass(frozen=True)
class Metric3D:
    """Metric3D v2 (ViT small) from a local copy of its repository with its weights."""

    model: Any
    name = "metric3d"
    SIZE = (616, 1064)  # rows, columns the network takes
    CANONICAL = 1000.0  # focal length, px, its depth belongs to

    @staticmethod
    def load(path: str) -> Metric3D:
        """From a folder with hubconf.py, or from the torch hub cache.

        Raises:
            ConfigError: there is no such folder; says where it was looked for.
        """
        torch = _module("torch", "torch")
        folder = Path(path) if path else Path(torch.hub.get_dir()) / _METRIC3D
        if not (folder / "hubconf.py").is_file():
            raise ConfigError(f"no Metric3D repository in {folder}; give its folder, nothing is downloaded")
        weights = sorted(folder.glob("*.pth"))
        if not weights:
            raise ConfigError(f"no weights (*.pth) of Metric3D in {folder}; put metric_depth_vit_small.pth there")
        model = torch.hub.load(str(folder), "metric3d_vit_small", source="local", pretrain=False)
        state = torch.load(weights[0], map_location="cpu", weights_only=True)
        model.load_state_dict(state.get("model_state_dict", state), strict=False)
        return Metric3D(model.eval())

    def __call__(self, image: UInt8, camera: Camera, observed: DepthMap | None = None) -> DepthMap:
        """Metric depth: the canonical camera is taken out by the focal length."""
        torch = _module("torch", "torch")
        rgb = image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)
        scale = min(self.SIZE[0] / rgb.shape[0], self.SIZE[1] / rgb.shape[1])
        small = cv2.resize(rgb, None, fx=scale, fy=scale, interpolation=cv2.INTER_LINEAR).astype(np.float32)
        padded = np.full((*self.SIZE, 3), (123.675, 116.28, 103.53), np.float32)
        padded[: small.shape[0], : small.shape[1]] = small
        x = (padded - (123.675, 116.28, 103.53)) / (58.395, 57.12, 57.375)
        with torch.inference_mode():
            out, *_ = self.model.inference({"input": torch.from_numpy(x.transpose(2, 0, 1)[None]).float()})
        z = out.squeeze().numpy()[: small.shape[0], : small.shape[1]] * camera.fx * scale / self.CANONICAL
        z = cv2.resize(z, rgb.shape[1::-1], interpolation=cv2.INTER_LINEAR)
        return DepthMap(np.where(z > 0, z, np.nan))


@dataclass(frozen=True)
class DepthAnything:
    """Depth Anything V2 through the transformers package, from a local folder or its cache."""

    model: Any
    processor: Any
    name = "depth_anything"
    MODEL = "depth-anything/Depth-Anything-V2-Small-hf"

    @staticmethod
    def load(path: str) -> DepthAnything:
        """From a folder written by ``save_pretrained``, or from the Hugging Face cache.

        Raises:
            ConfigError: the package or the weights are not there.
        """
        transformers = _module("transformers", "transformers")
        source = path or DepthAnything.MODEL
        try:
            model = transformers.AutoModelForDepthEstimation.from_pretrained(source, local_files_only=True)
            processor = transformers.AutoImageProcessor.from_pretrained(source, local_files_only=True)
        except OSError as error:
            raise ConfigError(f"no weights of Depth Anything V2 in {source}; nothing is downloaded unasked") from error
        return DepthAnything(model.eval(), processor)

    def __call__(self, image: UInt8, camera: Camera, observed: DepthMap | None = None) -> DepthMap:
        """Depth up to scale: the network gives inverse depth up to scale (and shift, which is left out)."""
        torch = _module("torch", "torch")
        rgb = image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)
        with torch.inference_mode():
            out = self.model(**self.processor(images=rgb, return_tensors="pt")).predicted_depth
        inverse = cv2.resize(out.squeeze().numpy(), rgb.shape[1::-1], interpolation=cv2.INTER_LINEAR)
        return DepthMap(1.0 / np.maximum(inverse, 1e-3 * float(inverse.max())), None, Scale.ARBITRARY)
