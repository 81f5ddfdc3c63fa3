"""A keyframe as the map keeps it: its image, where each pixel lies on the surface, and its pose.

Points are recomputed from the pose whenever they are asked for, so a corrected pose moves them all.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sf_interfaces.types import Camera, Float32, Float64, UInt8
from sf_recon.core.observation import backproject

UInt16 = NDArray[np.uint16]
_STEPS = 65535  # of the depth of one view: below 0.1 mm for a room


@dataclass(frozen=True, slots=True)
class Samples:
    """Training pixels of one keyframe."""

    points: Float32  # [N, 3] m, map frame
    directions: Float32  # [N, 3] unit, from the camera to the point, map frame
    colors: Float32  # [N, 3] in 0..1
    weights: Float32  # [N] confidence, mean 1 over the keyframe


@dataclass(slots=True)
class KeyframeView:
    """Five bytes per pixel, seven with a depth variance.

    Args:
        z: [H, W] depth in steps of ``step`` m, 0 = none.
        weights: [H, W] confidence with mean 1 over the usable pixels; None: all equal.
        turns: training iterations so far.
    """

    stamp_ns: int
    camera: Camera
    T_map_camera: Float64
    image: UInt8  # [H, W, 3]
    z: UInt16
    step: float
    weights: NDArray[np.float16] | None = None
    turns: int = 0

    @staticmethod
    def make(
        stamp_ns: int, camera: Camera, T_map_camera: Float64, image: UInt8, z: Float32, weights: Float32 | None
    ) -> KeyframeView:
        """From depth [H, W] m (NaN = unusable) and confidence [H, W]."""
        usable = np.isfinite(z)
        step = float(z[usable].max()) / _STEPS if usable.any() else 1.0
        steps = np.rint(np.where(usable, z, 0) / step).astype(np.uint16)
        confidence = None if weights is None else weights.astype(np.float16)
        return KeyframeView(stamp_ns, camera, np.array(T_map_camera), image, steps, step, confidence)

    @property
    def depth(self) -> Float32:
        """Depth [H, W] m, NaN = none."""
        z = self.z.astype(np.float32) * np.float32(self.step)
        z[self.z == 0] = np.nan
        return z

    @property
    def nbytes(self) -> int:
        """Memory of the arrays."""
        return self.image.nbytes + self.z.nbytes + (0 if self.weights is None else self.weights.nbytes)

    def sample(self, count: int, rng: np.random.Generator) -> Samples:
        """Draw usable pixels with replacement, in row-major order: neighbours share the cells of the point grid."""
        usable = np.flatnonzero(self.z)
        return self.at(np.sort(usable[rng.integers(0, len(usable), count)]))

    def at(self, pixels: NDArray[np.intp]) -> Samples:
        """The samples at flat pixel indices [N]."""
        z = self.z.reshape(-1)[pixels].astype(np.float32) * np.float32(self.step)
        points, directions = backproject(self.camera, self.T_map_camera, z, pixels)
        weights = np.ones(len(pixels), np.float32)
        if self.weights is not None:
            weights = self.weights.reshape(-1)[pixels].astype(np.float32)
        colors = self.image.reshape(-1, 3)[pixels].astype(np.float32) / np.float32(255)
        return Samples(points, directions, colors, weights)
