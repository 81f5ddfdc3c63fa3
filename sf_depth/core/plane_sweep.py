"""Inverse depth of a reduced image by plane sweep and semi-global aggregation, once poses and intrinsics are known.

Flow follows what moves little between two views. What stands out far in front of its surroundings moves more than
its whole width, and flow, which starts from the surroundings, misses it. With known geometry its match is a search
along one line, in all sources at once: every plane of a sweep through space warps the sources onto the reference,
and the plane on which they look most alike wins (Hirschmueller's aggregation decides where the images do not).
Comparison and aggregation are compiled; ``plane_sweep_reference`` says what they are.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from sf_depth.core import pinhole
from sf_depth.core.dense_ba import Estimate
from sf_depth.core.matching import grey, pixel_grid
from sf_depth.core.parallel import each
from sf_interfaces.native import kernels
from sf_interfaces.types import Float32, UInt8

REDUCTION = 4  # the sweep sees every image at this fraction of its size
_STEP = 0.75  # px of the reduced image between two planes, in the source that moves most
_FEWEST, _MOST = 16, 160  # planes
_NEAREST, _FARTHEST = (1.5, 5.0), 0.5  # range of the sweep: times the nearest, the median, the farthest seen so far
WINDOW = (3, 3)  # px that are compared
NOISE = 4.0  # grey levels^2 of variance that mean no texture
UNSEEN = 0.6  # dissimilarity of a source that does not see the point: that of a poor match
BEND, BREAK = 0.06, 2.4  # cost of a neighbour on the next plane, and on any other
EDGE = 8.0  # grey levels at which a break costs half
MIN_Z = 0.05  # of the reference depth


def sweep_planes(reference: UInt8, sources: Sequence[UInt8], at: Estimate, reduction: int = REDUCTION) -> Float32:
    """Inverse depth [H / reduction, W / reduction] of a reference image.

    Args:
        sources: the images that ``at.T`` places.
        at: geometry so far; its inverse depths give the range of the sweep.
    """
    return sweep(compare(reference, sources, at, reduction), planes_of(at, reduction))


def compare(reference: UInt8, sources: Sequence[UInt8], at: Estimate, reduction: int) -> Compared:
    """The images, reduced, with the geometry by which they are compared."""
    height, width = reference.shape[0] // reduction, reference.shape[1] // reduction
    size = (width, height)
    first, *others = (
        cv2.resize(grey(image), size, interpolation=cv2.INTER_AREA).astype(np.float32)
        for image in (reference, *sources)
    )
    return Compared(first, others, at, reference.shape[1] / width, reference.shape[0] / height)


def sweep(part: Compared, planes: Float32) -> Float32:
    """Inverse depth [h, w] by the planes [D] on which the images look most alike."""
    cost = np.stack(each(part.dissimilarity, planes), axis=2)  # [h, w, D]
    return _winner(_aggregated(cost, part.smooth), planes)


def planes_of(at: Estimate, reduction: int) -> Float32:
    """Inverse depths that are evenly spaced in the image, [D]."""
    median, low, high = np.quantile(at.inverse_depth, [0.5, 0.01, 0.99])
    nearest, farthest = max(_NEAREST[0] * high, _NEAREST[1] * median), max(_FARTHEST * low, 1e-3 * median)
    moved = at.theta[0] / reduction * np.linalg.norm(at.T[:, :3, 3], axis=1).max() * (nearest - farthest)
    return np.linspace(farthest, nearest, int(np.clip(moved / _STEP, _FEWEST, _MOST)), dtype=np.float32)


class Compared:
    """The reduced reference and its sources, compared plane by plane."""

    def __init__(self, first: Float32, others: list[Float32], at: Estimate, fx: float, fy: float) -> None:
        self.first, self.others = first, np.stack(others)
        self.theta, self.zoom = at.theta.astype(np.float32), np.array([fx, fy], np.float32)
        uv = pixel_grid(first.shape).reshape(-1, 2).T * self.zoom[:, None]
        x = pinhole.rays(at.theta, np.ascontiguousarray(uv))
        T = at.T.astype(np.float32)
        self.rotated = np.stack([R[:3, :2] @ x + R[:3, 2:3] for R in T])  # [S, 3, N]
        self.t = np.ascontiguousarray(T[:, :3, 3])
        self.smooth = cv2.GaussianBlur(first, (0, 0), 0.7)  # edges, not noise, tell surfaces apart
        self.mean = cv2.blur(first, WINDOW)
        self.scale = 1.0 / np.sqrt(cv2.blur(first * first, WINDOW) - self.mean**2 + np.float32(NOISE))

    def dissimilarity(self, d: np.float32) -> Float32:
        """1 - correlation with the two sources most alike, if the scene were at inverse depth d, [h, w].

        Two, since what one source does not see another does.
        """
        return self._dissimilarity(self.rotated, d)

    def dissimilarity_of(self, d: Float32) -> Float32:
        """The same of a surface: every pixel has its own inverse depth, d [h, w]."""
        return self._dissimilarity(self.rotated + self.t[:, :, None] * d.reshape(-1), np.float32(0))

    def _dissimilarity(self, X: Float32, d: np.float32) -> Float32:
        """Points X + t d, in units of the depth in the reference, X [S, 3, N]."""
        images = (self.first, self.mean, self.scale, self.others)
        geometry = (X, self.t, self.theta, self.zoom)
        return np.asarray(kernels("sf_depth").dissimilarity(*images, *geometry, MIN_Z, NOISE, UNSEEN, d))


def _aggregated(cost: Float32, image: Float32) -> Float32:
    """Sum of the best paths to every pixel from four sides, [h, w, D] (semi-global matching)."""
    columns, rows = each(lambda upright: best_paths(cost, image, upright), (True, False))
    columns += rows
    return columns


def best_paths(cost: Float32, image: Float32, upright: bool) -> Float32:
    """Cost [h, w, D] of the best paths along the columns or the rows that end in a pixel on a plane, both ways."""
    return np.asarray(kernels("sf_depth").best_paths(cost, image, upright, BEND, BREAK, EDGE))


def _winner(total: Float32, planes: Float32) -> Float32:
    """Inverse depth [h, w] of the least cost, between planes by a parabola through three costs."""
    k = total.argmin(axis=2).clip(1, len(planes) - 2)[..., None]
    before, here, after = (np.take_along_axis(total, k + step, axis=2)[..., 0] for step in (-1, 0, 1))
    off = (before - after) / np.maximum(2.0 * (before - 2.0 * here + after), 1e-6)
    d = planes[k[..., 0]] + np.clip(off, -0.5, 0.5) * (planes[1] - planes[0])
    return np.asarray(cv2.medianBlur(d.astype(np.float32), 5))
