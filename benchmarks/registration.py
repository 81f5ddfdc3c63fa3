"""Does depth lie on colour? What the depth edges find on 7-Scenes, and how wrong that is where the truth is known.

python benchmarks/registration.py [--data FOLDER] [--scenes room hall] [--frames 30] [--out bench]
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from common import Benchmark, print_rows

from sf_bringup.simulate import PRESETS, SimulationSpec, Simulator
from sf_bringup.simulate.sensors import structured_light
from sf_interfaces.geometry import se3
from sf_interfaces.geometry.depth_alignment import Alignment, align
from sf_interfaces.geometry.edge_views import EdgeViews, Shot
from sf_interfaces.io.datasets.files import read_depth, read_rgb
from sf_interfaces.io.datasets.indoor import SevenScenes, stamp_30hz
from sf_interfaces.types import Camera, DepthMap, Float32, Float64

# What came with the recording of 7-Scenes, before its registration was measured.
GIVEN = se3.orthonormalise(
    np.array(
        [
            [0.99997, 0.00268, -0.00790, -0.02556],
            [-0.00274, 0.99996, -0.00815, 0.00010],
            [0.00788, 0.00817, 0.99994, 0.00203],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
)
# Frames of 7-Scenes: all, before the lost depth image, and the two parts of those.
PARTS = {"0-199": (1, 199), "0-99": (1, 99), "101-176": (101, 177)}
# Rotations by which the claimed pose of a simulated depth camera is wrong, deg about its x, y and z.
ERRORS_DEG = ((0.0, 0.0, 0.0), (0.3, -0.6, 0.5), (-1.0, 0.4, -0.8), (0.1, 0.1, 0.0))
BASELINE = np.array([-0.025, 0.002, 0.001])  # m, from the depth to the colour camera
PROJECTOR = 0.075  # m, to the right of the depth camera


class Rig:
    """A simulated colour camera with a depth camera beside it that has a lens, a place and a clock of its own.

    Args:
        lag_s: the depth image shows what was so long before its stamp.
        every: s between frames.
        noisy: depth as a structured-light sensor gives it, with the shadow of its projector; else exact.
    """

    def __init__(self, spec: SimulationSpec, lag_s: float = 0.0, every: float = 0.5, noisy: bool = True) -> None:
        self.simulator, self.lag_s, self.every, self.noisy = Simulator(spec), lag_s, every, noisy
        self.color = spec.camera
        focal = spec.focal * 1.1
        self.depth = Camera(spec.width, spec.height, focal, focal, spec.width / 2 + 3, spec.height / 2 - 2, "depth")
        self.T_color_depth = se3.exp(np.array([*BASELINE, 0.01, -0.005, 0.008]))

    def shots(self, count: int) -> Iterator[Shot]:
        """Depth images with the colour images before, at and after them."""
        spec, period = self.simulator.spec, 1 / self.simulator.spec.fps
        for k in range(count):
            times = [(k + 0.5) * self.every + j * period for j in (-1, 0, 1)]
            stamps = [round(1e9 * (1 + t)) for t in times]
            images = [self._image(t) for t in times]
            T = self.simulator.path.pose(times[1] - self.lag_s) @ self.T_color_depth
            z = self.simulator.renderer.render(self.depth, T, 1)[1]
            if self.noisy:
                rng = np.random.default_rng([spec.seed, 7, k])
                z = np.where(shadowed(z, self.depth.fx), np.nan, structured_light(z, self.depth.fx, rng))
            yield Shot((stamps[0], stamps[1], stamps[2]), (images[0], images[1], images[2]), DepthMap(z), stamps[1])

    def _image(self, t: float) -> np.ndarray:
        image = self.simulator.renderer.render(self.color, self.simulator.path.pose(t), 1)[0]
        rng = np.random.default_rng([self.simulator.spec.seed, 8, round(1e6 * t)])
        return np.clip(image + rng.standard_normal(image.shape) + 0.5, 0, 255).astype(np.uint8)


def shadowed(z: Float32, focal: float) -> np.ndarray:
    """Pixels that a projector to the right of the camera does not light: something nearer lies to the right, [H, W]."""
    column = np.arange(z.shape[1]) - focal * PROJECTOR / np.nan_to_num(z, nan=1e4)  # as the projector sees it
    nearest = np.minimum.accumulate(column[:, ::-1], axis=1)[:, ::-1]
    return np.asarray(column > nearest + 1)


def found(shots: Iterable[Shot], depth: Camera, color: Camera, T_color_depth: Float64) -> Alignment | None:
    """How the depth of shots lies on colour."""
    views = EdgeViews(depth, color, T_color_depth)
    for shot in shots:
        views.add(shot)
    return align(views)
