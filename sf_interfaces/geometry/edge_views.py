"""From a depth image and three colour images to what their edges tell: where they are, and how they move.

The motion is taken from the colour images themselves, so that no poses are needed.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from sf_interfaces.geometry.depth_edges import DepthEdges, Gradients, depth_edges, gradients, seen
from sf_interfaces.types import Camera, DepthMap, Float64, UInt8

WIDTH = 640  # px; wider images are reduced to it
_LONGEST_S = 1.0  # between the images before and after; over more time no motion can be followed


@dataclass(frozen=True, slots=True)
class Shot:
    """A depth image, the colour image taken with it, and those before and after for the motion.

    Args:
        stamps_ns: of the images before, at and after.
        images: before, at and after; undistorted.
        depth: undistorted, of the depth camera.
        depth_ns: its stamp.
    """

    stamps_ns: tuple[int, int, int]
    images: tuple[UInt8, UInt8, UInt8]
    depth: DepthMap
    depth_ns: int


@dataclass(frozen=True, slots=True)
class EdgeView:
    """What counts of a shot.

    Args:
        stamp_ns: of the colour image.
        edges: of the depth image.
        gradients: of the colour image.
        flow: [N, 2] px/s, how the edges move in the colour image; 0 where that cannot be followed.
        ahead: s, from the stamp of the depth image to that of the colour image.
        period: s, between colour images.
    """

    stamp_ns: int
    edges: DepthEdges
    gradients: Gradients
    flow: Float64
    ahead: float
    period: float


class EdgeViews:
    """Takes shots and keeps their edges.

    Args:
        depth_camera, color_camera: of the depth and of the colour images.
        T_color_depth: as it is claimed to be; the unit matrix for depth that is registered.
    """

    def __init__(self, depth_camera: Camera, color_camera: Camera, T_color_depth: Float64) -> None:
        self.depth_camera, self.T_color_depth = depth_camera, T_color_depth
        self.camera = color_camera.scaled(min(1.0, WIDTH / color_camera.width))
        self.enlarged = color_camera.width / self.camera.width  # px of the colour camera in one here
        self.views: list[EdgeView] = []
        self._flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)

    def add(self, shot: Shot) -> None:
        """Find edges and their motion in a shot."""
        edges = depth_edges(shot.depth, self.depth_camera)
        before, at, after = (self._grey(image) for image in shot.images)
        uv, _ = seen(edges, self.camera, self.T_color_depth)
        seconds = (shot.stamps_ns[2] - shot.stamps_ns[0]) * 1e-9
        flow = np.zeros_like(uv)
        if seconds < _LONGEST_S:
            flow = (self._motion(at, after, uv) - self._motion(at, before, uv)) / seconds
        ahead = (shot.stamps_ns[1] - shot.depth_ns) * 1e-9
        self.views.append(EdgeView(shot.stamps_ns[1], edges, gradients(at), flow, ahead, seconds / 2))

    def _grey(self, image: UInt8) -> UInt8:
        grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        size = (self.camera.width, self.camera.height)
        return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.uint8)

    def _motion(self, first: UInt8, second: UInt8, uv: Float64) -> Float64:
        """Where the surroundings of pixels of the first image are in the second, [N, 2] px from the pixels."""
        half = [cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for image in (first, second)]
        field = self._flow.calc(half[0], half[1], None)
        limit = (field.shape[1] - 1, field.shape[0] - 1)
        column, row = np.clip(np.nan_to_num(uv / 2), 0, limit).astype(np.int64).T
        return np.asarray(2.0 * field[row, column], np.float64)
