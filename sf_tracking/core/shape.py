"""Alignment of measured depth: point-to-plane, from one view's surface to another's.

It sees what patches do not: bare walls, and the geometry between textured places. The loops over pixels and points are
compiled; :mod:`.shape_reference` is the same in numpy.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera, Float32, Float64, Frame
from sf_tracking.config import TrackingConfig
from sf_tracking.core.native import intrinsics, native

_COLUMNS = 80  # of the grid on which dense depth is compared
_UNUSUAL, _ROUGH = 4.0, 0.002  # times the usual deviation from a plane, plus so much of the depth: still one surface
_NEIGHBOURS = 8  # sparse points that define a surface normal
_FLAT = 0.1  # residual of that plane relative to its extent
_POINTS = 1500  # sparse points compared at most
_SCALE = 2.0  # of the robust kernel, standard deviations
_LEAST = 0.03  # of the noise model of dense depth, which is that of the worst sensor; a scanner's noise is known
_INDEPENDENT = 0.1  # share of the cells of dense depth: neighbours err alike. Points of a scanner do not
_OVERLAP = 0.2  # of the source's points must fall on the target's surface, near or far
_MIN_POINTS = 60
_FIRST_REACH, _REACH = 0.10, 0.03  # relative to depth: how far apart surfaces may lie, at first and at last
_SLACK = 0.02  # added to both
_STEPS = 5
_STILL = 1e-5


@dataclass(frozen=True, slots=True)
class Shape:
    """The surface that one view measured."""

    points: Float64  # [K, 3] m, camera frame
    normals: Float64  # [K, 3] unit, NaN where the surface is not smooth
    grid: NDArray[np.int64] | None  # [h, w] index of the point in each cell, -1: none; None: scattered points
    tree: cKDTree | None  # of scattered points
    sigma: Float64  # [K] m, deviation of depth
    least: float  # share of ``sigma`` that is believed at least, where distances show less
    independent: float  # share of the points that err on their own

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True, slots=True)
class ShapeFit:
    """Relative pose of two shapes and its information."""

    T: Float64  # [4, 4] T_target_source
    information: Float64  # [6, 6] for exp(xi) T
    share: float  # of the source's points that fall on the target's surface: those that lie on it
    overlap: float  # of the source's points: those that fall on the target's surface


def shape_of(frame: Frame, config: TrackingConfig) -> Shape | None:
    """The surface of a frame's depth, thinned; None without depth."""
    camera = frame.camera
    assert camera is not None
    if frame.sparse_depth is not None and len(frame.sparse_depth) >= _MIN_POINTS:
        step = max(1, len(frame.sparse_depth) // (2 * _POINTS))
        points = camera.unproject(frame.sparse_depth.uv[::step], frame.sparse_depth.z[::step])
        return _scattered(points, config.lidar_sigma)
    if frame.depth is None:
        return None
    return _gridded(camera, frame.depth.z, config.depth_sigma)


def _scattered(points: Float64, sigma: float) -> Shape:
    tree = cKDTree(points)
    near = points[tree.query(points, k=_NEIGHBOURS)[1]]
    offset = near - near.mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(offset.transpose(0, 2, 1) @ offset)
    flat = (values[:, 0] < _FLAT**2 * values[:, 1]) & (values[:, 1] > 1e-3 * values[:, 2])
    normals = np.where(flat[:, None], vectors[:, :, 0], np.nan)
    return Shape(points, normals, None, tree, np.full(len(points), sigma), least=1.0, independent=1.0)


def _smooth(rough: Float64, depth: Float64, known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which of the ``known`` cells are as smooth as most: what lies across a border of two surfaces lies on neither.

    A sensor's noise grows with its depth (structured light); how much, most cells tell.
    """
    if not known.any():
        return known
    usual = float(np.median(rough[known] / depth[known]))
    with np.errstate(invalid="ignore"):
        return np.asarray(known & (rough < _UNUSUAL * usual * depth + _ROUGH))


def _gridded(camera: Camera, z: Float32, sigma: float) -> Shape:
    step = max(1, round(camera.width / _COLUMNS))
    known, centre, rough = native().thin(np.ascontiguousarray(z, np.float32), step)
    h, w = centre.shape
    good = _smooth(rough, centre, (known > 0.6 * step * step) & (centre > 0))
    v, u = (np.mgrid[0:h, 0:w] + 0.5) * step
    vertices = camera.unproject(np.stack([u, v], axis=-1), np.where(good, centre, np.nan))  # [h, w, 3]
    across, down = np.full_like(vertices, np.nan), np.full_like(vertices, np.nan)
    across[:, 1:-1], down[1:-1] = vertices[:, 2:] - vertices[:, :-2], vertices[2:] - vertices[:-2]
    normal = np.cross(across, down)
    with np.errstate(invalid="ignore", divide="ignore"):
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        inverse = np.where(good, 1.0 / centre, np.nan)
        bend = np.full((h, w), np.nan)  # of the surface round a cell, relative to its depth
        bend[1:-1, 1:-1] = np.maximum(
            np.abs(inverse[1:-1, 2:] + inverse[1:-1, :-2] - 2 * inverse[1:-1, 1:-1]),
            np.abs(inverse[2:, 1:-1] + inverse[:-2, 1:-1] - 2 * inverse[1:-1, 1:-1]),
        ) * centre[1:-1, 1:-1]  # fmt: skip
    normal[~_smooth(bend, centre, np.isfinite(bend))] = np.nan
    index = np.where(good, np.cumsum(good).reshape(h, w) - 1, -1)
    points = vertices[good]
    return Shape(points, normal[good], index, None, sigma * points[:, 2] ** 2, _LEAST, _INDEPENDENT)


def fit_points(frame: Frame, points: Float64, T: Float64, prior: Float64, config: TrackingConfig) -> ShapeFit | None:
    """Pose T_cw of a frame with depth near ``T`` by points [K, 3] of the map it may see; None where that tells none.

    Args:
        prior: [6, 6] information of ``T``, for exp(xi) T.
    """
    shape = shape_of(frame, config)
    if shape is None or frame.camera is None:
        return None
    seen = se3.transform(T, points)
    uv, z = frame.camera.project(seen)
    inside = frame.camera.sees(uv, z)
    seen, z = seen[inside], z[inside]
    sigma = config.depth_sigma * z**2 if frame.depth is not None else np.full(len(z), config.lidar_sigma)
    source = Shape(seen, np.full_like(seen, np.nan), None, None, sigma, shape.least, independent=1.0)
    found = fit(frame.camera, source, shape, np.eye(4), prior, config.shape_trust) if len(seen) else None
    return None if found is None else replace(found, T=found.T @ T)


def _partners(camera: Camera, source: Shape, target: Shape, T: Float64) -> NDArray[np.int64]:
    """Index of the target's point for each of the source's, moved by T, -1: none."""
    if target.tree is not None:
        return np.asarray(target.tree.query(se3.transform(T, source.points))[1])
    assert target.grid is not None
    h, w = target.grid.shape
    found = native().partners(intrinsics(camera), T, source.points, target.grid, w / camera.width, h / camera.height)
    return np.asarray(found)


def fit(camera: Camera, source: Shape, target: Shape, T: Float64, prior: Float64, trust: float) -> ShapeFit | None:
    """Relative pose T_target_source of two shapes near ``T``, held there by ``prior``; None with too little overlap.

    Args:
        prior: [6, 6] information of ``T``, for exp(xi) T.
        trust: how much the points count beside the prior, 0 to 1.
    """
    trust *= source.independent
    away, H, share, overlap = np.zeros(6), np.zeros((6, 6)), 0.0, 0.0
    for step_index in range(_STEPS):
        partner = _partners(camera, source, target, T)
        reach = (_FIRST_REACH if step_index == 0 else _REACH) + _SLACK
        H, g, used, met = native().plane_system(
            T, source.points, source.sigma, partner, target.points, target.normals, reach, _SCALE, source.least, trust
        )
        share, overlap = used / max(1, met), met / len(source)
        if used < _MIN_POINTS or overlap < _OVERLAP:
            return None
        step = np.linalg.solve(H + prior, g - prior @ away)
        T, away = se3.exp(step) @ T, away + step
        if np.abs(step).max() < _STILL:
            break
    return ShapeFit(se3.orthonormalise(T), H, share, overlap)
