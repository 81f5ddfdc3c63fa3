"""Where depth jumps, the picture mostly changes too: depth edges against image gradients.

An edge belongs to the near surface: its depth is measured, and from another place or direction the edge is seen where
that surface ends. What lies behind it is no help, since cameras at different places see different parts of it. A
depth camera with a projector has no depth in the projector's shadow, which lies on one side of everything near: the
near surface ends there all the same, so a gap is passed over as long as the far surface shows behind it.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera, DepthMap, Float64, UInt8

_DIRECTIONS = ((1, 0), (-1, 0), (0, 1), (0, -1))
_WIDTH = 640  # px; of a wider depth image, only every so many-th row and column are looked at
_JUMP = 1.08  # what lies behind an edge is farther by this factor
_BREAK = 1.06  # and the next pixel no continuation of the near surface
_REACH = 15  # px, the widest gap (shadow) between near and far surface
_FLAT, _INSIDE = 0.03, 5  # the near surface changes by less than this share over so many px
_MARGIN = 16  # px at the image border, where half of the surroundings are missing
_MOST = 4000  # edge points of an image; more make no estimate better
_SMOOTHING = 1.2  # px, of the image before its gradients, and of the gradients
_STRONG = 90.0  # percentile of the gradients of an image, from which on one counts as much as any


@dataclass(frozen=True, slots=True)
class DepthEdges:
    """Ends of near surfaces in a depth image.

    Args:
        points: [N, 3] m, depth camera frame, on the border between near and far.
        outward: [N, 3] unit vectors in the plane of the depth image, from the near surface to the far one.
    """

    points: Float64
    outward: Float64

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True, slots=True)
class Gradients:
    """How strongly an image changes along its rows and columns, 0 ... 255, [2, H, W] uint8."""

    along: UInt8


@dataclass(frozen=True, slots=True)
class Shift:
    """Where edges fit an image best.

    Args:
        px: (right, down) to move the edges by.
        clarity: the score there over the mean of the scores of all shifts; about 1.1 where edges and image have
            nothing to do with each other.
    """

    px: Float64
    clarity: float


def depth_edges(depth: DepthMap, camera: Camera) -> DepthEdges:
    """The ends of near surfaces along rows and columns, at most 4000 of them, evenly chosen.

    Args:
        camera: of the depth image.
    """
    every = max(1, round(camera.width / _WIDTH))
    z = np.where(depth.valid, depth.z, 0).astype(np.float32)  # 0: none; no filter, which would move borders of gaps
    z = np.ascontiguousarray(z[every // 2 :: every, every // 2 :: every])
    inner = np.zeros(z.shape, bool)
    inner[_MARGIN:-_MARGIN, _MARGIN:-_MARGIN] = True
    points, outward = [], []
    for direction in _DIRECTIONS:
        backward = (-direction[0], -direction[1])
        following = np.roll(z, backward, (1, 0))
        behind = cv2.dilate(z, **_line(direction, _REACH))
        nearest, farthest = cv2.erode(z, **_line(backward, _INSIDE)), cv2.dilate(z, **_line(backward, _INSIDE))
        ends = (following <= 0) | (following > _BREAK * z)
        flat = (nearest > (1 - _FLAT) * z) & (farthest < (1 + _FLAT) * z)
        row, column = np.nonzero(inner & (z > 0) & ends & (behind > _JUMP * z) & flat)
        pixels = every * (np.stack([column, row], axis=1) + 0.5 * np.array(direction)) + every // 2 + 0.5
        points.append(camera.unproject(pixels, z[row, column].astype(np.float64)))
        outward.append(np.tile((*direction, 0.0), (len(row), 1)))
    step = -(-sum(map(len, points)) // _MOST) or 1
    return DepthEdges(np.concatenate(points)[::step], np.concatenate(outward)[::step])


def _line(direction: tuple[int, int], length: int) -> dict[str, Any]:
    """The window of a filter over a pixel and the ``length`` next ones in a direction."""
    du, dv = direction
    kernel = np.ones((length * abs(dv) + 1, length * abs(du) + 1), np.uint8)
    return {"kernel": kernel, "anchor": (length * (du < 0), length * (dv < 0))}


def gradients(image: UInt8) -> Gradients:
    """Absolute changes along rows and columns, in shares of what is a strong one in this image.

    Args:
        image: RGB [H, W, 3] or grey [H, W].
    """
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), _SMOOTHING)
    out = np.empty((2, *grey.shape), np.uint8)
    for axis in range(2):
        change = np.abs(cv2.Sobel(smooth, cv2.CV_32F, 1 - axis, axis))
        share = np.minimum(change / (np.percentile(change, _STRONG) + 1e-6), 1.0)
        out[axis] = np.round(255 * cv2.GaussianBlur(share, (0, 0), _SMOOTHING))
    return Gradients(out)


def seen(edges: DepthEdges, camera: Camera, T_camera_depth: Float64) -> tuple[Float64, NDArray[np.intp]]:
    """Where another camera sees the edges, px [N, 2] (NaN behind it), and along which axis they change the image [N].

    Returns:
        Axis 0 for an edge that runs down the image, 1 for one that runs along a row.
    """
    uv, z = camera.project(se3.transform(T_camera_depth, edges.points))
    uv[z <= 0] = np.nan
    turned = np.abs(edges.outward @ T_camera_depth[:2, :3].T)
    return uv, (turned[:, 1] > turned[:, 0]).astype(np.intp)


def scores_of_shifts(uv: Float64, axis: NDArray[np.intp], found: Gradients, radius: int) -> Float64:
    """Mean gradient at the edges, for all shifts by whole pixels up to ``radius``, [2r + 1 down, 2r + 1 right].

    NaN where too few edges stay in the image.
    """
    side = 2 * radius + 1
    windows = sliding_window_view(found.along, (side, side), axis=(1, 2))  # [2, H - 2r, W - 2r, side, side]
    # An edge exactly between two pixels, as all are in registered depth, takes either by turns: no half pixel is lost.
    pixel = np.where(np.arange(len(uv))[:, None] % 2, np.floor(uv), np.ceil(uv) - 1)
    corner = np.nan_to_num(pixel, nan=-1e6).astype(np.int64) - radius
    inside = (corner >= 0).all(axis=1) & (corner < (windows.shape[2], windows.shape[1])).all(axis=1)
    if not inside.any():
        return np.full((side, side), np.nan)
    chosen = windows[axis[inside], corner[inside, 1], corner[inside, 0]]
    return np.asarray(chosen.reshape(-1, side * side).mean(axis=0, dtype=np.float64).reshape(side, side) / 255)


def best_shift(scores: Float64) -> Shift | None:
    """The maximum of the scores to a fraction of a pixel; None where it lies on the border of what was tried."""
    radius = len(scores) // 2
    row, column = (int(k) for k in np.unravel_index(np.argmax(np.nan_to_num(scores)), scores.shape))
    if not np.isfinite(scores).all() or not (0 < row < 2 * radius and 0 < column < 2 * radius):
        return None
    du = _vertex(*scores[row, column - 1 : column + 2])
    dv = _vertex(*scores[row - 1 : row + 2, column])
    clarity = float(scores[row, column] / max(scores.mean(), 1e-9))
    return Shift(np.array([column - radius + du, row - radius + dv]), clarity)


def _vertex(before: float, at: float, after: float) -> float:
    """Where the parabola through three values at -1, 0, 1 has its maximum."""
    bend = before - 2 * at + after
    return 0.5 * (before - after) / bend if bend < 0 else 0.0
