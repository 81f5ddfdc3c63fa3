"""Drawing the map: the first layer of points (IPR), then colour where the rays hit (Sec. IV-D)."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera, DepthMap, Float32, Float64, Scale, UInt8
from sf_recon.config import ReconConfig
from sf_recon.core.color_field import ColorField
from sf_recon.core.detail import detail, nearest_views
from sf_recon.core.ipr_reference import normals_of
from sf_recon.core.keyframe_view import KeyframeView
from sf_recon.core.neural_points import NeuralPoints
from sf_recon.core.observation import backproject
from sf_recon.core.rasterizer import make_rasterizer, raster_options
from sf_recon.core.silhouette import sharpen


@dataclass(frozen=True, slots=True)
class RenderedView:
    """A drawn view. Where no surface is drawn depth is NaN; the image shows a keyframe's colour there, or black."""

    image: UInt8  # [H, W, 3]
    depth: DepthMap  # with variance where asked for: that of the depth which placed the surface, m^2
    normal: Float32 | None = None  # [H, W, 3] unit, optical frame, towards the camera; NaN = none

    @property
    def hole_fraction(self) -> float:
        """Fraction of pixels that show no surface."""
        return 1.0 - self.depth.density


def normals(camera: Camera, z: Float32, gap: float) -> Float32:
    """Unit normals [H, W, 3] (optical frame, towards the camera) of a depth image [H, W] m; NaN = unknown.

    Args:
        gap: step in depth, m, across which pixels do not belong together.
    """
    return normals_of(camera.unproject(camera.pixel_grid(), z.astype(np.float64)).astype(np.float32), gap)


def fill(z: Float32) -> Float32:
    """The depth image with every hole at the depth of the nearest drawn pixel; 1 m where nothing is drawn."""
    hole = ~np.isfinite(z)
    if not hole.any():
        return z
    if hole.all():
        return np.ones_like(z)
    _, label = cv2.distanceTransformWithLabels(hole.astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
    table = np.zeros(label.max() + 1, np.float32)
    table[label[~hole]] = z[~hole]
    return np.where(hole, table[label], z)


@lru_cache(maxsize=4)
def _squares(height: int, width: int) -> NDArray[np.intp]:
    """Flat pixel indices in an order in which 16 and 64 that follow one another are squares: the decoder's groups."""
    v, u = np.divmod(np.arange(height * width), width)
    return np.lexsort((u % 4, v % 4, u // 4 % 2, v // 4 % 2, u // 8, v // 8))


def _middle(z: Float32) -> float:
    """About the median of what is drawn of a depth image, m; 1 m where nothing is."""
    coarse = z[::4, ::4]
    drawn = coarse[np.isfinite(coarse)]
    return float(np.median(drawn)) if len(drawn) else 1.0


class Renderer:
    """Draws views of neural points; holds no state of its own."""

    def __init__(self, config: ReconConfig, points: NeuralPoints, field: ColorField) -> None:
        self.config, self.points, self.field = config, points, field
        self._draw = make_rasterizer(config)

    def depth(self, camera: Camera, T_map_camera: Float64, views: Sequence[KeyframeView] = ()) -> tuple[Float32, UInt8]:
        """Depth [H, W] m of the first layer, NaN = hole, and the level of the points that drew it, [H, W].

        Coarse points are drawn where no finer ones stand. With ``views``, the nearest of them sharpen its borders.
        """
        T_camera_map = se3.inverse(T_map_camera)
        z = np.full((camera.height, camera.width), np.nan, np.float32)
        levels = np.zeros(z.shape, np.uint8)
        for index, level in enumerate(self.points.levels):
            drawn = self.points.tops(index)
            if len(drawn) == 0:
                continue
            options = raster_options(self.config, level.spacing)
            other = self._draw(drawn, camera, T_camera_map, options, outputs=()).depth
            with np.errstate(invalid="ignore"):
                nearer = np.isfinite(other) & (np.isnan(z) | (other + options.layer_gap < z))
            z[nearer], levels[nearer] = other[nearer], index
        if self.config.sharpen and len(views):
            z = self._sharpened(z, levels, camera, T_map_camera, views)
        return z, levels

    def _sharpened(
        self, z: Float32, levels: UInt8, camera: Camera, T_map_camera: Float64, views: Sequence[KeyframeView]
    ) -> Float32:
        deciding = [view for view, _ in nearest_views(views, T_map_camera, _middle(z), self.config.sharpen)]
        spacing = np.array([level.spacing for level in self.points.levels], np.float32)[levels]
        with np.errstate(invalid="ignore"):
            half = 0.5 * self.config.coverage * spacing * np.float32(max(camera.fx, camera.fy)) / z
        gap = self.config.layer_gap * self.points.levels[0].spacing
        return sharpen(z, half, gap, deciding, camera, T_map_camera)

    def render(
        self,
        camera: Camera,
        T_map_camera: Float64,
        views: Sequence[KeyframeView],
        scale: Scale,
        *,
        full: bool = False,
    ) -> RenderedView:
        """Draw the surface from a pose, ``full`` with normals and variance."""
        c = self.config
        z, levels = self.depth(camera, T_map_camera, views)
        surface = np.isfinite(z)
        image, trust = np.zeros((*z.shape, 3), np.float32), np.zeros(z.shape, np.float32)
        if c.detail and len(views) and surface.any():
            nearest = nearest_views(views, T_map_camera, _middle(z), c.detail)
            found = detail(nearest, camera, T_map_camera, fill(z), surface, reach=c.detail_reach, threads=c.threads)
            image, trust = found.color, found.confidence
            if not c.fill_holes:
                image[~surface] = 0
        self._add_learnt(image, trust, camera, T_map_camera, z, levels)
        shown = cv2.convertScaleAbs(image)  # rounds and saturates
        if not full:
            return RenderedView(shown, DepthMap(z, scale=scale))
        depth = DepthMap(z, self._variance(camera, T_map_camera, z), scale)
        gap = c.layer_gap * self.points.levels[0].spacing
        return RenderedView(shown, depth, normals(camera, z, gap))

    def _add_learnt(
        self, image: Float32, trust: Float32, camera: Camera, T_map_camera: Float64, z: Float32, levels: UInt8
    ) -> None:
        """Mix the field's colour into the image [H, W, 3] in 0..255 where the keyframes are not trusted fully."""
        order = _squares(*z.shape)
        open_ = order[(np.isfinite(z) & (trust < 1)).reshape(-1)[order]]
        drawn_by = levels.reshape(-1)[open_]
        for level in range(len(self.points.levels)):
            pixels = open_[drawn_by == level]
            points, _ = backproject(camera, T_map_camera, z.reshape(-1)[pixels], pixels)
            learnt = 255 * self.field.color(points, T_map_camera[:3, 3], level)
            share, flat = trust.reshape(-1)[pixels, None], image.reshape(-1, 3)
            flat[pixels] = share * flat[pixels] + (1 - share) * learnt

    def _variance(self, camera: Camera, T_map_camera: Float64, z: Float32) -> Float32:
        """Variance [H, W] m^2 of the nearest point of the finest level that has one near; NaN at holes."""
        drawn = np.flatnonzero(np.isfinite(z))
        points, _ = backproject(camera, T_map_camera, z.reshape(-1)[drawn], drawn)
        sigma = np.full(len(drawn), np.nan, np.float32)
        for level in reversed(self.points.levels):
            ids, _ = level.nearest(points, 1, self.config.threads)
            near = ids[:, 0] >= 0
            sigma[near] = level.sigmas[ids[near, 0]]
        variance = np.full(z.shape, np.nan, np.float32)
        variance.reshape(-1)[drawn] = sigma**2
        return variance
