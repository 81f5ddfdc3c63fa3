"""Improved Point Rasterization in numpy: definition of the kernel, oracle of its tests (Sec. IV-C).

1. A point covers the pixels whose centre lies in a window of side ``coverage * resolution * f / z`` around
   its projection (at least one pixel wide, at most ``2 * max_half``). The paper's adaptive radius: near
   points grow, so that a surface has no holes however close the camera is.
2. A pixel takes its ``k_ray`` nearest points in depth; ties go to the lower index.
3. Of these, front to back, it keeps the first layer: up to the first step in depth of ``layer_gap`` or more
   (z_t - z_{t-1} for t > 0, cumulative product). The paper's formula has z_{t+1} - z_t, which would drop the
   last point of the front surface.
4. The drawn position is their mean with weights exp(-q2 / sigma), q the offset from the pixel centre in
   half-widths. Pixel centres are at + 0.5, as in training.
5. Its normal is the mean of the points' normals with the same weights, each turned towards the camera; where
   points have none, that of the drawn surface: the cross product of the differences of the neighbouring
   pixels' positions, leaving out neighbours beyond a step of ``layer_gap``.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sf_interfaces.types import Camera, Float32, Float64

MIN_STEP = 1e-5  # of the depth; pixels that show the same point differ by rounding only
MIN_SINE = 1e-2  # of the angle between two differences that span a surface


@dataclass(frozen=True, slots=True)
class RasterOptions:
    """Lengths in the unit of the points."""

    radius: float  # half-width of a point's window
    near: float  # points with z below are left out
    layer_gap: float  # step in depth that ends the first layer
    max_half: float = 64.0  # cap of the half-width, px
    k_ray: int = 8
    sigma: float = 0.5


@dataclass(frozen=True, slots=True)
class Raster:
    """What the rays hit. All but the depth are None unless asked for."""

    depth: Float32  # [H, W] m along z, NaN = hole
    position: Float32 | None = None  # [H, W, 3] m, camera frame, NaN = hole
    index: NDArray[np.int32] | None = None  # [H, W, K] first-layer points, front to back, -1 = none
    weight: Float32 | None = None  # [H, W, K] of these points, sum 1 where a surface is, 0 = none
    normal: Float32 | None = None  # [H, W, 3] unit, camera frame, towards the camera, NaN = unknown

    @property
    def hole(self) -> np.ndarray:
        """Pixels no point covers, [H, W] bool."""
        return ~np.isfinite(self.depth)


OUTPUTS = ("position", "index", "weight", "normal")  # images besides the depth, in the order of Raster


@dataclass(frozen=True, slots=True)
class _Projected:
    """Visible points only."""

    ids: NDArray[np.intp]  # [M] rows in the cloud
    xyz: Float32  # [M, 3] camera frame
    uv: Float32  # [M, 2] px
    half: Float32  # [M, 2] half-width of the window, px


def rasterize_reference(
    points: Float32,
    camera: Camera,
    T_camera_map: Float64,
    options: RasterOptions,
    *,
    outputs: Collection[str] = ("position",),
    normals: Float32 | None = None,
) -> Raster:
    """Draw points [N, 3] (map frame). Slow: one step of Python per covered pixel."""
    T = T_camera_map.astype(np.float32)
    visible = _project(points.astype(np.float32), camera, T, options)
    shape = (camera.height, camera.width)
    position = np.full((*shape, 3), np.nan, np.float32)
    index = np.full((*shape, options.k_ray), -1, np.int32)
    weight = np.zeros((*shape, options.k_ray), np.float32)
    normal = np.full((*shape, 3), np.nan, np.float32)
    for (row, column), hits in _cover(visible, camera).items():
        nearest = np.array([i for _, i in sorted(hits)[: options.k_ray]])
        z = visible.xyz[nearest, 2]
        step_ok = np.concatenate([[True], np.diff(z) < np.float32(options.layer_gap)])
        first = nearest[np.cumprod(step_ok).astype(bool)]
        q = (np.array([column + 0.5, row + 0.5]) - visible.uv[first]) / visible.half[first]
        w = np.exp(-(q**2).sum(axis=1) / options.sigma)
        w /= w.sum()
        position[row, column] = w @ visible.xyz[first]
        index[row, column, : len(first)] = visible.ids[first]
        weight[row, column, : len(first)] = w
        if normals is not None:
            own = normals[visible.ids[first]] @ T[:3, :3].T
            normal[row, column] = _mean_normal(own, w, position[row, column])
    if normals is None:
        normal = normals_of(position, options.layer_gap)
    images = {"position": position, "index": index, "weight": weight, "normal": normal}
    return Raster(position[..., 2].copy(), **{name: images[name] for name in outputs})


def _project(p: Float32, camera: Camera, T: Float32, options: RasterOptions) -> _Projected:
    """Step 1 without the windows' clipping; in float32 and in the order of the kernel, so that no tie differs."""
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        x, y, z = (p[:, 0] * r[0] + p[:, 1] * r[1] + p[:, 2] * r[2] + r[3] for r in T[:3])
        fx, fy, cx, cy = (np.float32(v) for v in (camera.fx, camera.fy, camera.cx, camera.cy))
        uv = np.stack([fx * x / z + cx, fy * y / z + cy], axis=1)
        half = np.stack([np.float32(options.radius) * f / z for f in (fx, fy)], axis=1)
    half = np.clip(half, np.float32(0.5), np.float32(options.max_half))
    xyz = np.stack([x, y, z], axis=1)
    ids = np.flatnonzero(np.isfinite(xyz).all(axis=1) & np.isfinite(uv).all(axis=1) & (z >= np.float32(options.near)))
    return _Projected(ids, xyz[ids], uv[ids], half[ids])


def _cover(visible: _Projected, camera: Camera) -> dict[tuple[int, int], list[tuple[float, int]]]:
    """For every pixel (row, column) the points that cover it: (depth, number among the visible ones)."""
    lists: dict[tuple[int, int], list[tuple[float, int]]] = {}
    low = np.ceil(visible.uv - visible.half - np.float32(0.5))
    high = np.floor(visible.uv + visible.half - np.float32(0.5))
    for i, z in enumerate(visible.xyz[:, 2]):
        columns = range(max(0, int(low[i, 0])), min(camera.width - 1, int(high[i, 0])) + 1)
        for row in range(max(0, int(low[i, 1])), min(camera.height - 1, int(high[i, 1])) + 1):
            for column in columns:
                lists.setdefault((row, column), []).append((float(z), i))
    return lists


def _mean_normal(own: Float32, weights: Float64, position: Float32) -> Float32:
    """Weighted mean [3] of normals [M, 3] (camera frame), each turned towards the camera; NaN where they cancel."""
    own = np.where((own @ position)[:, None] > 0, -own, own)
    mean = weights @ own
    norm = np.linalg.norm(mean)
    return (mean / norm if norm > 1e-6 else np.full(3, np.nan)).astype(np.float32)


def normals_of(position: Float32, layer_gap: float) -> Float32:
    """Step 5 without normals of the points: [H, W, 3] from positions [H, W, 3] (camera frame)."""

    def difference(axis: int) -> Float32:
        ends = []
        for shift in (1, -1):  # the neighbour before, then the one behind; the pixel itself beyond a step
            moved = np.roll(position, shift, axis)
            edge: list[slice | int] = [slice(None), slice(None)]
            edge[axis] = 0 if shift == 1 else -1
            moved[tuple(edge)] = np.nan
            with np.errstate(invalid="ignore"):
                same_layer = np.abs(moved[..., 2] - position[..., 2]) < np.float32(layer_gap)
            ends.append(np.where(same_layer[..., None], moved, position))
        step: Float32 = ends[1] - ends[0]
        return step

    x, y = difference(1), difference(0)
    normal = np.cross(y, x)
    norm, across, down = (np.linalg.norm(v, axis=2, keepdims=True) for v in (normal, x, y))
    with np.errstate(invalid="ignore"):
        sound = (np.minimum(across, down) > MIN_STEP * position[..., 2:]) & (norm > MIN_SINE * across * down)
    return np.where(sound, normal / np.where(sound, norm, 1), np.nan).astype(np.float32)
