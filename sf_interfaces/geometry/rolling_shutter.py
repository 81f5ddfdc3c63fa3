"""Rolling shutters: images whose rows were read one after the other while the camera moved, and as they should be.

A frame is what a camera with a global shutter would have seen at one instant, that of the principal point's row. The
camera at a row that is read ``dt`` later sees the point X, as it is at that instant, at ``X + dt (v + w x X)``.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera, DepthMap, Float32, Float64, Frame

_CELL = 5  # px between the points at which the shift is computed; odd, so that enlarging meets them
_ROUNDS = 2  # of finding the row in which a point is read


@dataclass(frozen=True, slots=True)
class Readout:
    """How long the sensors take.

    Args:
        image: s from the first to the last row of the image; 0: global shutter. Negative: the last row is first.
        depth: the same of the depth images registered to it.
    """

    image: float
    depth: float = 0.0

    def __bool__(self) -> bool:
        return self.image != 0.0


def velocity_between(first: tuple[int, Float64], second: tuple[int, Float64]) -> Float64:
    """[6] of points in the camera's frame, per s, between two stamps (ns) with T_cw [4, 4]."""
    return np.asarray(se3.log(second[1] @ se3.inverse(first[1])) / (1e-9 * (second[0] - first[0])))


def nearness(camera: Camera, uv: Float64, w: Float64) -> Float32:
    """Inverse depth at the points of a grid over the image, [rows, columns]: that of the nearest known one.

    Args:
        uv, w: places [N, 2] px and inverse depths [N] of what is known; where it is nothing, the grid is 0.
    """
    shape = _grid_shape(camera)
    out, missing = np.zeros(shape, np.float32), np.ones(shape, np.uint8)
    if not len(w):
        return out
    column, row = np.rint((uv - 0.5) / _CELL).astype(np.int64).T
    inside = (row >= 0) & (row < shape[0]) & (column >= 0) & (column < shape[1])
    place = row[inside], column[inside]
    out[place], missing[place] = w[inside], 0
    _, label = cv2.distanceTransformWithLabels(missing, cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
    known = np.zeros(int(label.max()) + 1, np.float32)
    known[label[missing == 0]] = out[missing == 0]
    return np.asarray(known[label])


def unrolled(frame: Frame, velocity: Float64, near: Float32, readout: Readout) -> Frame:
    """The frame as a global shutter would have taken it. Sparse depth is that of the instant already.

    Args:
        velocity: [6] of points in the camera's frame, unit/s and rad/s: X(dt) = exp(dt velocity) X.
        near: inverse depth of :func:`nearness`, in the unit of the velocity.
    """
    if frame.image is None or frame.camera is None or not velocity.any():
        return frame
    u, v = _sources(frame.camera, velocity, near, readout.image)
    image = cv2.remap(frame.image, u, v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    measured = frame.depth
    if measured is not None and readout.depth:
        measured = _depth_unrolled(measured, frame.camera, velocity, near, readout.depth)
    return replace(frame, image=image, depth=measured)


def unrolled_by_flow(frame: Frame, velocity: Float32, readout: Readout) -> Frame:
    """The same by how its pixels move, px/s, [h, w, 2] at any size: what moves in depth beside it is left out."""
    if frame.image is None or frame.camera is None:
        return frame
    camera = frame.camera
    size = (camera.width, camera.height)
    flow = cv2.resize(velocity, size, interpolation=cv2.INTER_LINEAR)
    own_u, own_v = (np.arange(side, dtype=np.float32) for side in size)

    def places(seconds: float) -> tuple[Float32, Float32]:
        dt = ((own_v + 0.5 - camera.cy) * (seconds / camera.height)).astype(np.float32)[:, None]
        return own_u + dt * flow[..., 0], own_v[:, None] + dt * flow[..., 1]

    image = cv2.remap(frame.image, *places(readout.image), cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return replace(frame, image=image)


def shift(camera: Camera, velocity: Float64, near: Float32, readout: float) -> float:
    """px that a point of the grid is displaced by at most."""
    grid = _grid(camera)
    return float(np.linalg.norm(_read_at(camera, grid, velocity, near, readout) - grid, axis=2).max())


def _grid_shape(camera: Camera) -> tuple[int, int]:
    return -(-camera.height // _CELL) + 1, -(-camera.width // _CELL) + 1


def _grid(camera: Camera) -> Float64:
    """Places of the grid's points, [rows, columns, 2] px."""
    rows, columns = _grid_shape(camera)
    v, u = np.mgrid[0:rows, 0:columns] * float(_CELL) + 0.5
    return np.stack([u, v], axis=-1)


def _read_at(camera: Camera, uv: Float64, velocity: Float64, near: Float32, readout: float) -> Float64:
    """Where points that should be at ``uv`` [rows, columns, 2] px were read."""
    x = camera.unproject(uv, np.ones(uv.shape[:-1]))
    moved = velocity[:3] * near[..., None] + np.cross(velocity[3:], x)
    out = uv
    for _ in range(_ROUNDS):
        dt = (out[..., 1] - camera.cy) * (readout / camera.height)
        out, _ = camera.project(x + dt[..., None] * moved)
    return out


def _sources(camera: Camera, velocity: Float64, near: Float32, readout: float) -> tuple[Float32, Float32]:
    """Columns and rows, as OpenCV counts them, from which the pixels come, [H, W] each."""
    grid = _grid(camera)
    off = (_read_at(camera, grid, velocity, near, readout) - grid).astype(np.float32)
    rows, columns = grid.shape[:2]
    first = _CELL // 2
    large = cv2.resize(off, (columns * _CELL, rows * _CELL), interpolation=cv2.INTER_LINEAR)
    large = large[first : first + camera.height, first : first + camera.width]
    own = np.arange(max(camera.width, camera.height), dtype=np.float32)
    return large[..., 0] + own[: camera.width], large[..., 1] + own[: camera.height, None]


def _depth_unrolled(known: DepthMap, camera: Camera, velocity: Float64, near: Float32, readout: float) -> DepthMap:
    """Depth of the instant: the nearest pixels, and what the camera came nearer by between their rows and it."""
    u, v = _sources(camera, velocity, near, readout)
    nothing: Any = {"borderMode": cv2.BORDER_CONSTANT, "borderValue": float("nan")}
    z = cv2.remap(known.z, u, v, cv2.INTER_NEAREST, **nothing)
    dt = (np.arange(camera.height) + 0.5 - camera.cy) * (readout / camera.height)
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    turned = velocity[3] * y[:, None] - velocity[4] * x
    z = (z * (1.0 - dt[:, None] * turned) - dt[:, None] * velocity[2]).astype(np.float32)
    variance = None if known.variance is None else cv2.remap(known.variance, u, v, cv2.INTER_NEAREST, **nothing)
    return DepthMap(z, variance, known.scale)
