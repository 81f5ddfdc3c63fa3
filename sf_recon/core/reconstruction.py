"""The reconstruction block: keyframes in, a surface light field out, views of it drawn (Sec. IV).

:meth:`Reconstruction.add` is the loop of the block: observe, place points, train.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sf_interfaces.corrections import Correction
from sf_interfaces.errors import ConfigError, FormatError
from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera, DepthMap, Float32, Float64, Keyframe, PointCloud, Scale
from sf_recon.config import MESHES, ReconConfig
from sf_recon.core import map_file, memory, products
from sf_recon.core.color_field import ColorField
from sf_recon.core.keyframe_view import KeyframeView
from sf_recon.core.neural_points import NeuralPoints
from sf_recon.core.observation import Observation, auto_resolution, observe, rgb
from sf_recon.core.rasterizer import make_rasterizer
from sf_recon.core.renderer import RenderedView, Renderer
from sf_recon.core.trainer import Trainer


class Reconstruction:
    """A map of neural points that grows with every keyframe.

    Attributes:
        resolution: spacing of the finest points, m.
        scale: whether that is metric.
        poses: T_map_camera of every keyframe so far, by stamp in ns.
        units: of the map per unit in which a keyframe came, by stamp, where corrections told one.
    """

    def __init__(self, config: ReconConfig) -> None:
        make_rasterizer(config)  # a wrong name or device is an error now, not at the first keyframe
        if config.mesh not in MESHES:
            raise ConfigError(f"recon.mesh must be one of {', '.join(MESHES)}, got '{config.mesh}'")
        self.config = config
        self.resolution = config.resolution
        self.scale = Scale.METRIC
        self.poses: dict[int, Float64] = {}
        self.units: dict[int, float] = {}
        self._points: NeuralPoints | None = None
        self._field: ColorField
        self._trainer: Trainer
        self._renderer: Renderer
        self._rng = np.random.default_rng(config.seed)
        if config.resolution > 0:
            self._start(config.resolution)

    @property
    def losses(self) -> list[float]:
        """Mean squared error of every training iteration so far."""
        return [] if self._points is None else self._trainer.losses

    @property
    def views(self) -> list[KeyframeView]:
        """The keyframes that are kept for training and drawing, oldest first."""
        return [] if self._points is None else self._trainer.views

    @property
    def points(self) -> NeuralPoints | None:
        """The neural points; None before the first keyframe."""
        return self._points

    @property
    def nbytes(self) -> int:
        """Memory of points, features, moments, search grids and keyframe images."""
        if self._points is None:
            return 0
        return memory.points_bytes(self._points, self._field, self._trainer) + sum(v.nbytes for v in self.views)

    def add(self, keyframe: Keyframe) -> PointCloud:
        """Place points for a keyframe, train its share, and return the added finest points, coloured.

        Raises:
            FormatError: no depth, depth of another size, or the first depth image is empty.
        """
        added = self.place(keyframe)
        self._trainer.run(self.config.iterations)
        return self.colored(added, keyframe.stamp_ns)

    def place(self, keyframe: Keyframe) -> Float32:
        """Place points for a keyframe and take it into training; the added finest points [M, 3] m, map frame.

        Raises:
            FormatError: no depth, depth of another size, or the first depth image is empty.
        """
        seen = observe(keyframe, self.config)
        assert keyframe.depth is not None
        if self._points is None:
            self._start(auto_resolution(keyframe.depth, keyframe.camera, self.config.min_resolution))
        assert self._points is not None
        self.scale = keyframe.depth.scale
        self.poses[keyframe.stamp_ns] = np.array(keyframe.T_map_camera)
        z, new = self._merge(keyframe, seen)
        # A uniform error of the depth spreads a surface over some spacings: then a coarser level is fine enough.
        scales = np.maximum(seen.footprints, seen.sigmas / self.config.merge_gap if self.config.merge_gap else 0)
        added = self._points.allocate(
            seen.points[new], seen.colors[new], scales[new], seen.sigmas[new], keyframe.stamp_ns
        )
        self._field.grow(added)
        self._trainer.add(self._view(keyframe, seen, z))
        if self.config.memory_mb and self.nbytes > 1e6 * self.config.memory_mb:
            memory.evict(self._points, self._field, self._trainer, self.poses, 1e6 * self.config.memory_mb)
        return added[0].points

    def learn(self) -> tuple[KeyframeView, float] | None:
        """One training iteration: the keyframe it trained on and its mean squared error; None without keyframes."""
        return self._trainer.iterate() if self.views else None

    def finish(self) -> None:
        """Train on all keyframes once more, in least-trained-first order."""
        if self._points is not None:
            self._trainer.run(self.config.final_iterations)

    def correct(self, correction: Correction) -> None:
        """Move points and training views with the keyframes that placed them, as after a loop closure.

        Where the unit of a keyframe has changed, what it placed grows about its camera: depths, deviations and all.
        Keyframes the map does not know are left out.
        """
        if self._points is None:
            return
        motions, growth, keyframes = {}, {}, correction.keyframes
        for stamp, T, unit in zip(keyframes.stamps_ns.tolist(), keyframes.poses, correction.scales, strict=True):
            if stamp in self.poses:
                growth[stamp] = float(unit) / self.units.get(stamp, 1.0)
                motions[stamp] = T @ np.diag([*[growth[stamp]] * 3, 1.0]) @ se3.inverse(self.poses[stamp])
                self.poses[stamp], self.units[stamp] = np.array(T), float(unit)
        for view in self.views:
            if view.stamp_ns in motions:
                view.T_map_camera = self.poses[view.stamp_ns]
                view.step *= growth[view.stamp_ns]
        self._points.move(motions)

    def surface(self) -> PointCloud:
        """The finest points with the colour of the field, map frame; coarse ones where there are no finer."""
        if self._points is None:
            return PointCloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), frame_id="map")
        clouds = [self.colored(self._points.tops(i), level=i) for i in range(len(self._points.levels))]
        points, colors = (np.concatenate(part) for part in zip(*((c.points, c.colors) for c in clouds), strict=True))
        return PointCloud(points, colors, frame_id="map")

    def colored(self, points: Float32, stamp_ns: int = 0, level: int = 0) -> PointCloud:
        """Points [N, 3] m (map frame) of a level with the field's colour from no side."""
        colors = np.rint(255 * self._field.color(points, level=level)).astype(np.uint8)
        return PointCloud(points, colors, stamp_ns=stamp_ns, frame_id="map")

    def depth(self, camera: Camera, T_map_camera: Float64) -> Float32:
        """Depth [H, W] m of the surface seen from a pose, NaN = hole."""
        if self._points is None:
            return np.full((camera.height, camera.width), np.nan, np.float32)
        return self._renderer.depth(camera, T_map_camera, self.views)[0]

    def render(self, camera: Camera, T_map_camera: Float64, *, full: bool = False) -> RenderedView:
        """Draw the surface from a pose; ``full`` adds normals and the variance of the depth."""
        if self._points is None:
            z = np.full((camera.height, camera.width), np.nan, np.float32)
            return RenderedView(np.zeros((*z.shape, 3), np.uint8), DepthMap(z))
        return self._renderer.render(camera, T_map_camera, self.views, self.scale, full=full)

    def serve(self, host: str, port: int, lock: AbstractContextManager[Any] | None = None) -> Any:
        """A page that shows the map, see :class:`sf_recon.core.viewer.Viewer`; it reads the map under ``lock``.

        Raises:
            ConfigError: viser is not installed.
        """
        from sf_recon.core.viewer import Viewer

        return Viewer(self, host, port, lock)

    def save(self, path: Path) -> None:
        """Write the map (.sfmap): points, features, network, keyframe images and configuration."""
        if self._points is None:
            raise FormatError("the map is empty: add a keyframe before saving it")
        units = [self.units.get(stamp, 1.0) for stamp in self.poses]
        map_file.write(path, self.config, self.resolution, self.scale, self.poses, units, self._points, self._trainer)

    def save_products(self, folder: Path) -> list[Path]:
        """Write ``map.sfmap``, ``surface.ply`` and, by configuration, ``mesh.ply``; the paths written."""
        return products.save_products(self, folder)

    @staticmethod
    def load(path: Path, device: str = "cpu") -> Reconstruction:
        """Read a map written by :meth:`save`; it can be drawn at once and grown by further keyframes.

        Args:
            device: where it is drawn and learnt from now on, cpu or cuda.

        Raises:
            FormatError: not a map of this version.
        """
        saved = map_file.read(path)
        out = Reconstruction(replace(saved.config, device=device))
        out._start(saved.resolution)
        out.scale, out.poses, out.units = saved.scale, saved.poses, saved.units
        map_file.restore(saved, out._points, out._trainer)  # type: ignore[arg-type]
        return out

    def _start(self, resolution: float) -> None:
        c = self.config
        self.resolution = resolution
        self._points = NeuralPoints(resolution, c.levels, c.multiplier)
        self._field = ColorField(self._points, c)
        self._renderer = Renderer(c, self._points, self._field)
        self._trainer = Trainer(self._field, c, self._rng)

    def _merge(self, keyframe: Keyframe, seen: Observation) -> tuple[Float32, np.ndarray]:
        """Fuse with the surface drawn so far: (depth [M] m, mask [M] of the pixels that show new surface).

        A pixel whose depth agrees with the drawn surface adds no point, and its colour is learnt where the
        ray hits that surface: there the renderer will ask for it.
        """
        assert keyframe.depth is not None
        z = keyframe.depth.z.reshape(-1)[seen.pixels]
        if self.config.merge_gap == 0 or not self.views:
            return z, np.ones(len(z), bool)
        drawn = self.depth(keyframe.camera, keyframe.T_map_camera).reshape(-1)[seen.pixels]
        gap = self.config.merge_gap * np.maximum(self.resolution, seen.footprints)
        with np.errstate(invalid="ignore"):
            known = np.abs(drawn - z) < np.maximum(gap, seen.sigmas)
        return np.where(known, drawn, z), ~known

    def _view(self, keyframe: Keyframe, seen: Observation, z: Float32) -> KeyframeView:
        shape = keyframe.image.shape[:2]
        depth = np.full(shape, np.nan, np.float32)
        depth.reshape(-1)[seen.pixels] = z
        weights = None
        if keyframe.depth is not None and keyframe.depth.variance is not None:
            weights = np.zeros(shape, np.float32)
            weights.reshape(-1)[seen.pixels] = seen.weights
        T, image = keyframe.T_map_camera, rgb(keyframe.image)
        return KeyframeView.make(keyframe.stamp_ns, keyframe.camera, T, image, depth, weights)
