"""The reconstruction block: keyframes in, a surface light field out, views of it drawn (Sec. IV).

:meth:`Reconstruction.add` is the loop of the block: observe, place points, train.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from sf_interfaces.errors import FormatError
from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera, DepthMap, Float32, Float64, Keyframe, PointCloud, Scale, UInt8
from sf_recon.config import ReconConfig
from sf_recon.core import map_file
from sf_recon.core.color_field import ColorField
from sf_recon.core.neural_points import NeuralPoints
from sf_recon.core.observation import Observation, auto_resolution, observe, to_map
from sf_recon.core.rasterizer import make_rasterizer, raster_options
from sf_recon.core.trainer import Trainer, TrainingView


@dataclass(frozen=True, slots=True)
class RenderedView:
    """A drawn view. Holes are NaN in depth and black in the image; nothing is painted over."""

    image: UInt8  # [H, W, 3]
    depth: DepthMap

    @property
    def hole_fraction(self) -> float:
        """Fraction of pixels that show no surface."""
        return 1.0 - self.depth.density


class Reconstruction:
    """A map of neural points that grows with every keyframe."""

    def __init__(self, config: ReconConfig) -> None:
        self.config = config
        self.resolution = config.resolution
        self.scale = Scale.METRIC
        self._draw = make_rasterizer(config)
        self._points: NeuralPoints | None = None
        self._field: ColorField
        self._trainer: Trainer
        self._rng = np.random.default_rng(config.seed)
        if config.resolution > 0:
            self._start(config.resolution)

    @property
    def losses(self) -> list[float]:
        """Mean squared error of every training iteration so far."""
        return [] if self._points is None else self._trainer.losses

    def add(self, keyframe: Keyframe) -> PointCloud:
        """Place points for a keyframe, train its share, and return the added finest points, coloured.

        Raises:
            FormatError: no depth, depth of another size, or the first depth image is empty.
        """
        seen = observe(keyframe, self.config)
        if self._points is None:
            assert keyframe.depth is not None
            self._start(auto_resolution(keyframe.depth, keyframe.camera, self.config.min_resolution))
        assert self._points is not None and keyframe.depth is not None
        self.scale = keyframe.depth.scale
        seen, new = self._merge(keyframe, seen)
        added = self._points.allocate(seen.points[new], seen.colors[new])
        self._field.grow(added)
        self._trainer.add(self._training_view(seen))
        self._trainer.run(self.config.iterations)
        cloud = self._colored(added[0].points)
        return PointCloud(cloud.points, cloud.colors, stamp_ns=keyframe.stamp_ns, frame_id="map")

    def finish(self) -> None:
        """Train on all keyframes once more, in least-trained-first order."""
        if self._points is not None:
            self._trainer.run(self.config.final_iterations)

    def surface(self) -> PointCloud:
        """The finest points with the colour of the field, map frame."""
        if self._points is None:
            return PointCloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), frame_id="map")
        return self._colored(self._points.levels[0].points)

    def render(self, camera: Camera, T_map_camera: Float64) -> RenderedView:
        """Draw the surface from a pose: the first layer of points, then the field's colour where rays hit."""
        image = np.zeros((camera.height * camera.width, 3), np.uint8)
        z = self._surface_depth(camera, T_map_camera)
        hit = np.flatnonzero(np.isfinite(z).reshape(-1))
        if len(hit):
            image[hit] = _to_uint8(self._field.color(to_map(camera, T_map_camera, z, hit)))
        return RenderedView(image.reshape(camera.height, camera.width, 3), DepthMap(z, scale=self.scale))

    def save(self, path: Path) -> None:
        """Write the map (.sfmap): points, features, network and configuration; no training pixels."""
        if self._points is None:
            raise FormatError("the map is empty: add a keyframe before saving it")
        map_file.write(path, self.config, self.resolution, self.scale, self._points, self._field)

    @staticmethod
    def load(path: Path) -> Reconstruction:
        """Read a map written by :meth:`save`; it can be drawn at once and grown by further keyframes.

        Raises:
            FormatError: not a map of this version.
        """
        saved = map_file.read(path)
        out = Reconstruction(saved.config)
        out._start(saved.resolution)
        out.scale = saved.scale
        map_file.restore(saved, out._points, out._field)  # type: ignore[arg-type]
        return out

    def _start(self, resolution: float) -> None:
        c = self.config
        self.resolution = resolution
        self._points = NeuralPoints(resolution, c.levels, c.multiplier)
        self._field = ColorField(
            self._points,
            features=c.features,
            hidden=c.hidden,
            neighbours=c.neighbours,
            sigma=c.sigma,
            colour_base=c.colour_base,
            threads=c.threads,
            generator=torch.Generator().manual_seed(c.seed),
        )
        self._trainer = Trainer(
            self._field,
            pixels=c.pixels,
            feature_rate=c.feature_rate,
            network_rate=c.network_rate,
            jump_iterations=c.jump_iterations,
            rng=self._rng,
        )

    def _surface_depth(self, camera: Camera, T_map_camera: Float64) -> Float32:
        if self._points is None:
            return np.full((camera.height, camera.width), np.nan, np.float32)
        options = raster_options(self.config, self.resolution)
        points = self._points.levels[0].points
        return self._draw(points, camera, se3.inverse(T_map_camera), options).depth

    def _merge(self, keyframe: Keyframe, seen: Observation) -> tuple[Observation, np.ndarray]:
        """Fuse with the surface drawn so far: (observation, mask [M] of the pixels that show new surface).

        A pixel whose depth agrees with the drawn surface adds no point, and its colour is learnt where the
        ray hits that surface: there the renderer will ask for it.
        """
        assert self._points is not None
        if self.config.merge_gap == 0 or len(self._points.levels[0]) == 0:
            return seen, np.ones(len(seen.points), bool)
        assert keyframe.depth is not None
        drawn = self._surface_depth(keyframe.camera, keyframe.T_map_camera)
        gap = np.abs(drawn - keyframe.depth.z).reshape(-1)[seen.pixels]
        known = gap < self.config.merge_gap * self.resolution
        points = seen.points.copy()
        points[known] = to_map(keyframe.camera, keyframe.T_map_camera, drawn, seen.pixels[known])
        return Observation(seen.pixels, points, seen.colors, seen.weights), ~known

    def _training_view(self, seen: Observation) -> TrainingView:
        count = min(self.config.keyframe_pixels, len(seen.points))
        kept = np.sort(self._rng.choice(len(seen.points), count, replace=False)) if count else np.zeros(0, int)
        return TrainingView(seen.points[kept], _to_uint8(seen.colors[kept]), seen.weights[kept].astype(np.float16))

    def _colored(self, points: Float32) -> PointCloud:
        return PointCloud(points, _to_uint8(self._field.color(points)), frame_id="map")


def _to_uint8(colors: Float32) -> UInt8:
    return np.rint(np.clip(colors, 0, 1) * 255).astype(np.uint8)
