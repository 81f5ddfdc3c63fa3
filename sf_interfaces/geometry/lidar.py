"""LiDAR sweeps: bring the points of a moving sensor to one instant, and see them as sparse image depth."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sf_interfaces.errors import CalibrationError, FormatError
from sf_interfaces.types import Camera, Float64, SparseDepth, check_pose

_SPACING_CELL = 16  # px; side of the cells that measure where the sweep covers the image
_MIN_OCCLUDER_WINDOW = 2  # px; a quadrant narrower than this holds no neighbour
_MAX_OCCLUDER_WINDOW = 64  # px; beyond it "surrounded" says nothing about visibility


def _check_points(points: ArrayLike) -> Float64:
    out = np.asarray(points, dtype=np.float64)
    if out.ndim != 2 or out.shape[1] != 3:
        raise FormatError(f"LiDAR points must have shape (N, 3), got {out.shape}; give x, y, z columns only")
    return out


def deskew(points: ArrayLike, time_offset_ns: ArrayLike, twist: ArrayLike, reference_offset_ns: int = 0) -> Float64:
    """Move every point to where a sensor standing still at the reference instant would have measured it.

    The motion is a constant body twist: ``T_world_lidar(t) = T_world_lidar(ref) exp((t - ref) twist)``. The
    closed form per point is exact, so there are no time bins.

    Args:
        points: [N, 3] m, each in the LiDAR frame at its own instant.
        time_offset_ns: [N] ns, instants relative to the cloud's stamp.
        twist: [6] velocity (m/s) and angular velocity (rad/s) of the sensor, in the LiDAR frame.
        reference_offset_ns: the instant asked for, such as the image's, relative to the cloud's stamp.

    Returns:
        [N, 3] m, LiDAR frame at the reference instant.

    Raises:
        FormatError: shapes do not agree, or the twist is not six finite numbers.
    """
    p = _check_points(points)
    offsets = np.asarray(time_offset_ns)
    xi = np.asarray(twist, dtype=np.float64)
    if offsets.shape != p.shape[:1]:
        raise FormatError(f"deskew needs one time offset per point, got {offsets.shape} for {len(p)} points")
    if xi.shape != (6,) or not np.isfinite(xi).all():
        raise FormatError("deskew needs a twist of six finite numbers (velocity, angular velocity)")
    t = (offsets - reference_offset_ns)[:, None] * 1e-9  # [N, 1] s
    velocity, omega = xi[:3], xi[3:]
    rate = float(np.linalg.norm(omega))
    angle = rate * t
    half = np.sinc(angle / (2 * np.pi))  # sin(angle / 2) / (angle / 2), exact at zero
    first = t * np.sinc(angle / np.pi)  # sin(angle) / rate
    second = 0.5 * t * t * half * half  # (1 - cos(angle)) / rate^2
    # (angle - sin(angle)) / rate^3, as a series where that is 0 / 0
    series = t**3 / 6 * (1 - angle**2 / 20)
    third = np.where(np.abs(angle) < 1e-3, series, (t - first) / max(rate, 1e-12) ** 2)
    wp, wv = np.cross(omega, p), np.cross(omega, velocity)
    rotated = p + first * wp + second * np.cross(omega, wp)
    return rotated + t * velocity + second * wv + third * np.cross(omega, wv)


def _window_px(uv: Float64) -> int:
    """Side of a quadrant that surely holds a neighbour: 3.5 mean spacings of the points."""
    cells = np.unique((uv // _SPACING_CELL).astype(np.int64) @ np.array([1, 1 << 20]))
    spacing = np.sqrt(len(cells) * _SPACING_CELL**2 / len(uv))
    return int(np.clip(np.ceil(3.5 * spacing), _MIN_OCCLUDER_WINDOW, _MAX_OCCLUDER_WINDOW))


def occluded(uv: Float64, z: Float64, width: int, height: int, margin: float = 0.1) -> NDArray[np.bool_]:
    """Points of a far surface that shine through a near one because LiDAR and camera stand apart.

    A point is hidden when returns nearer by more than ``margin`` surround it: one in each of its four image
    quadrants. Slanted planes are safe at any angle, because the nearer side of a plane never fills all four.
    The quadrant's size follows the spacing of the scan.

    Args:
        uv: [N, 2] px, all inside the image.
        z: [N] m.
        width, height: image size, px.
        margin: relative depth gap of an occluder.

    Returns:
        [N] bool, True = hidden from the camera.
    """
    if len(z) == 0:
        return np.zeros(0, dtype=bool)
    col, row = np.floor(uv).astype(np.int64).T
    order = np.argsort(-z, kind="stable")  # the nearest is written last and wins
    near = np.full((height, width), np.inf, dtype=np.float32)
    near[row[order], col[order]] = z[order]
    side = _window_px(uv)
    kernel = np.ones((side, side), dtype=np.uint8)
    limit = z * (1.0 - margin)
    hidden = np.ones(len(z), dtype=bool)
    for x in (0, side - 1):
        for y in (0, side - 1):
            nearest = cv2.erode(near, kernel, anchor=(x, y), borderType=cv2.BORDER_CONSTANT, borderValue=np.inf)
            hidden &= nearest[row, col] < limit
    return hidden


def project_sweep(
    points: ArrayLike,
    camera: Camera,
    T_camera_lidar: ArrayLike,
    *,
    remove_occluded: bool = True,
    margin: float = 0.1,
    min_range: float = 0.5,
    max_range: float = 200.0,
) -> SparseDepth:
    """Depth of a LiDAR sweep at the image points it hits, in the order of the sweep.

    Args:
        points: [N, 3] m, LiDAR frame, de-skewed to the image's instant (:func:`deskew`).
            Rows that are not finite are dropped.
        camera: the undistorted camera.
        T_camera_lidar: [4, 4], maps LiDAR points into the optical frame.
        remove_occluded: drop points the camera cannot see (:func:`occluded`).
        margin: relative depth gap of an occluder.
        min_range, max_range: m; returns outside are dropped (own vehicle, noise).

    Raises:
        FormatError: the points are not [N, 3].
        CalibrationError: the extrinsic is missing or no rigid motion.
    """
    p = _check_points(points)
    if T_camera_lidar is None:
        raise CalibrationError(
            "T_camera_lidar is missing; give the LiDAR's pose, as /tf_static or in a calibration file"
        )
    try:
        T = check_pose(T_camera_lidar, "T_camera_lidar")
    except FormatError as error:
        raise CalibrationError(str(error)) from error
    squared = np.einsum("ij,ij->i", p, p)
    ahead = np.einsum("ij,j->i", p, T[2, :3]) + T[2, 3] > 1e-3
    p = p[ahead & (squared >= min_range**2) & (squared <= max_range**2)]  # a NaN row fails all
    uv, z = camera.project(np.einsum("ij,kj->ik", p, T[:3, :3]) + T[:3, 3])
    inside = (uv >= 0).all(axis=1) & (uv[:, 0] < camera.width) & (uv[:, 1] < camera.height)
    uv, z = uv[inside], z[inside]
    if remove_occluded:
        visible = ~occluded(uv, z, camera.width, camera.height, margin)
        uv, z = uv[visible], z[visible]
    return SparseDepth(uv, z)
