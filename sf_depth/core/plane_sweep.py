"""Inverse depth of a reduced image by plane sweep and semi-global aggregation, once poses and intrinsics are known.

Flow follows what moves little between two views. What stands out far in front of its surroundings moves more than
its whole width, and flow, which starts from the surroundings, misses it. With known geometry its match is a search
along one line, in all sources at once: every plane of a sweep through space warps the sources onto the reference,
and the plane on which they look most alike wins (Hirschmueller's aggregation decides where the images do not).
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
from sf_interfaces.types import Float32, UInt8

REDUCTION = 4  # the sweep sees every image at this fraction of its size
_STEP = 0.75  # px of the reduced image between two planes, in the source that moves most
_FEWEST, _MOST = 16, 160  # planes
_NEAREST, _FARTHEST = (1.5, 5.0), 0.5  # range of the sweep: times the nearest, the median, the farthest seen so far
_WINDOW = (3, 3)  # px that are compared
_NOISE = 4.0  # grey levels^2 of variance that mean no texture
_UNSEEN = 0.6  # dissimilarity of a source that does not see the point: that of a poor match
_BEND, _BREAK = 0.06, 2.4  # cost of a neighbour on the next plane, and on any other
_EDGE = 8.0  # grey levels at which a break costs half
_MIN_Z = 0.05  # of the reference depth


def sweep_planes(reference: UInt8, sources: Sequence[UInt8], at: Estimate, reduction: int = REDUCTION) -> Float32:
    """Inverse depth [H / reduction, W / reduction] of a reference image.

    Args:
        sources: the images that ``at.T`` places.
        at: geometry so far; its inverse depths give the range of the sweep.
    """
    height, width = reference.shape[0] // reduction, reference.shape[1] // reduction
    size = (width, height)
    first, *others = (
        cv2.resize(grey(image), size, interpolation=cv2.INTER_AREA).astype(np.float32)
        for image in (reference, *sources)
    )
    planes = _planes(at, reduction)
    part = _Compared(first, others, at, reference.shape[1] / width, reference.shape[0] / height)
    cost = np.stack(each(part.dissimilarity, planes), axis=2)  # [h, w, D]
    return _winner(_aggregated(cost, cv2.GaussianBlur(first, (0, 0), 0.7)), planes)


def _planes(at: Estimate, reduction: int) -> Float32:
    """Inverse depths that are evenly spaced in the image, [D]."""
    median, low, high = np.quantile(at.inverse_depth, [0.5, 0.01, 0.99])
    nearest, farthest = max(_NEAREST[0] * high, _NEAREST[1] * median), max(_FARTHEST * low, 1e-3 * median)
    moved = at.theta[0] / reduction * np.linalg.norm(at.T[:, :3, 3], axis=1).max() * (nearest - farthest)
    return np.linspace(farthest, nearest, int(np.clip(moved / _STEP, _FEWEST, _MOST)), dtype=np.float32)


class _Compared:
    """The reduced reference and its sources, compared plane by plane."""

    def __init__(self, first: Float32, others: list[Float32], at: Estimate, fx: float, fy: float) -> None:
        self._first, self._others, self._theta = first, others, at.theta
        self._zoom = np.array([[fx], [fy]], np.float32)
        uv = pixel_grid(first.shape).reshape(-1, 2).T * self._zoom
        x = pinhole.rays(at.theta, uv)
        T = at.T.astype(np.float32)
        self._rotated = [R[:3, :2] @ x + R[:3, 2:3] for R in T]  # [3, N] each
        self._t = T[:, :3, 3:]
        self._mean = cv2.blur(first, _WINDOW)
        self._scale = 1.0 / np.sqrt(cv2.blur(first * first, _WINDOW) - self._mean**2 + np.float32(_NOISE))

    def dissimilarity(self, d: np.float32) -> Float32:
        """1 - correlation with the two sources most alike, if the scene were at inverse depth d, [h, w].

        Two, since what one source does not see another does.
        """
        best, second = (np.full(self._first.shape, np.inf, np.float32) for _ in range(2))
        for other, rotated, t in zip(self._others, self._rotated, self._t, strict=True):
            cost = self._against(other, rotated + t * d)
            second = np.minimum(second, np.maximum(best, cost))
            best = np.minimum(best, cost)
        return best if len(self._others) == 1 else 0.5 * (best + second)

    def _against(self, other: Float32, X: Float32) -> Float32:
        """1 - normalised correlation with one source, of whose points X [3, N] the reference would be made."""
        uv = pinhole.project(self._theta, X[:2] / np.maximum(X[2], np.float32(_MIN_Z))).astype(np.float32)
        shape = other.shape
        u, v = (row.reshape(shape) for row in uv / self._zoom - np.float32(0.5))
        b = cv2.remap(other, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        mean = cv2.blur(b, _WINDOW)
        variance = np.maximum(cv2.blur(b * b, _WINDOW) - mean * mean, 0.0) + np.float32(_NOISE)
        alike = (cv2.blur(self._first * b, _WINDOW) - self._mean * mean) * self._scale / np.sqrt(variance)
        outside = (u < -0.5) | (u > shape[1] - 0.5) | (v < -0.5) | (v > shape[0] - 0.5)
        outside |= X[2].reshape(shape) < _MIN_Z
        return np.where(outside, np.float32(_UNSEEN), 1.0 - alike)


def _aggregated(cost: Float32, image: Float32) -> Float32:
    """Sum of the best paths to every pixel from four sides, [h, w, D] (semi-global matching)."""
    turned, across = cost.transpose(1, 0, 2), image.T
    ways = [(cost, image), (cost[::-1], image[::-1]), (turned, across), (turned[::-1], across[::-1])]
    down, up, right, left = each(lambda way: _path(*way), ways)
    return down + up[::-1] + (right + left[::-1]).transpose(1, 0, 2)


def _path(cost: Float32, image: Float32) -> Float32:
    """Cost [n, m, D] of the best path along the first axis that ends in a pixel on a plane."""
    total = np.empty_like(cost)
    total[0] = cost[0]
    padded = np.full((cost.shape[1], cost.shape[2] + 2), np.inf, np.float32)
    for i in range(1, len(cost)):
        last = padded[:, 1:-1]
        last[:] = total[i - 1]
        least = last.min(axis=1, keepdims=True)
        step = _BREAK / (1.0 + np.abs(image[i] - image[i - 1]) / _EDGE)
        best = np.minimum(padded[:, :-2], padded[:, 2:])
        best += np.float32(_BEND)
        np.minimum(best, last, out=best)
        np.minimum(best, least + np.maximum(step, _BEND).astype(np.float32)[:, None], out=best)
        best -= least
        np.add(cost[i], best, out=total[i])
    return total


def _winner(total: Float32, planes: Float32) -> Float32:
    """Inverse depth [h, w] of the least cost, between planes by a parabola through three costs."""
    k = total.argmin(axis=2).clip(1, len(planes) - 2)[..., None]
    before, here, after = (np.take_along_axis(total, k + step, axis=2)[..., 0] for step in (-1, 0, 1))
    off = (before - after) / np.maximum(2.0 * (before - 2.0 * here + after), 1e-6)
    d = planes[k[..., 0]] + np.clip(off, -0.5, 0.5) * (planes[1] - planes[0])
    return np.asarray(cv2.medianBlur(d.astype(np.float32), 5))
