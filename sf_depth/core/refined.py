"""The depth of a sweep, refined between its planes and without them.

On the planes of a sweep every window is a piece of a plane that faces the camera, and aggregation counts in whole
planes. Once depth is known about, windows are compared on the surface itself, which may lie at a slant, and every
pixel tries ever smaller steps to both sides of it: what changes for the better where it and the pixels around that
look like it are counted together stays.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from itertools import product

import cv2
import numpy as np

from sf_depth.core.parallel import each
from sf_depth.core.plane_sweep import Compared
from sf_interfaces.types import Float32

_STEPS = (2.0, 1.0, 0.5, 0.25, 0.5, 0.25)  # planes; fine steps once more, where the first led away
_GAIN = 0.02  # of dissimilarity that a step of a plane or more has to bring
_AROUND = (-4, -2, 0, 2, 4)  # px: the rows and columns of the pixels that are counted together
_ALIKE = 10.0  # grey levels at which a pixel around counts 1 / e
_NEAREST = 0.5  # of the least inverse depth: no step leads beyond


def refined(part: Compared, d: Float32, spacing: float) -> tuple[Float32, Float32]:
    """Inverse depth [h, w] off the planes, from that on the planes, and how unlike the images are there.

    Args:
        spacing: inverse depth between two planes.
    """
    together = _Together(part.smooth)
    least = np.float32(_NEAREST * d.min())
    best = together(part.dissimilarity_of(d))
    for step in _STEPS:
        gain = np.float32(_GAIN if step >= 1 else 0.0)
        beside = [np.maximum(d + np.float32(side * step * spacing), least) for side in (-1, 1)]
        for other, cost in zip(beside, each(lambda at: together(part.dissimilarity_of(at)), beside), strict=True):
            better = cost < best - gain
            d, best = np.where(better, other, d), np.where(better, cost, best)
    return np.asarray(cv2.medianBlur(d, 3)), best


class _Together:
    """Means over the pixels around each pixel of an image [h, w], weighted by how much they look like it."""

    def __init__(self, image: Float32) -> None:
        self._reach = max(_AROUND)
        unlike = [np.abs(around - image) for around in self._around(image)]
        weights = [np.exp(-difference / np.float32(_ALIKE)) for difference in unlike]
        total = np.sum(weights, axis=0)
        self._weights = [weight / total for weight in weights]

    def __call__(self, cost: Float32) -> Float32:
        mean = np.zeros_like(cost)
        for weight, around in zip(self._weights, self._around(cost), strict=True):
            mean += weight * around
        return mean

    def _around(self, image: Float32) -> list[Float32]:
        """The image moved so that each pixel around comes to lie on its pixel; borders are repeated."""
        height, width = image.shape
        padded = np.pad(image, self._reach, mode="edge")
        corners = product((self._reach + offset for offset in _AROUND), repeat=2)
        return [padded[row : row + height, column : column + width] for row, column in corners]
