"""Sensor models: structured-light and time-of-flight depth, spinning and rosette LiDAR."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from sf_bringup.simulate.render import Renderer
from sf_interfaces.types import Float32, Float64, PointCloud

PoseAt = Callable[[Float64], Float64]
SWEEP_PHASE = 0.4  # the LiDAR looks forward this fraction of a sweep after its start; camera fires then


def _jump_edges(z: Float32) -> np.ndarray:
    """Pixels within one pixel of a depth jump of more than 5 percent, [H, W] bool."""
    near = np.nan_to_num(1 / z).astype(np.float32)
    kernel = np.ones((3, 3), np.uint8)
    return cv2.dilate(near, kernel) - cv2.erode(near, kernel) > 0.05 * np.maximum(near, 1e-3)


def structured_light(z: Float32, fx: float, rng: np.random.Generator) -> Float32:
    """Depth [H, W] m as a 7.5 cm baseline pattern projector sees it: NaN outside 0.4-5 m and at most edges.

    Disparity noise of 0.08 px, quantised to 1/8 px, gives an error that grows with z^2.
    """
    base = fx * 0.075
    disparity = base / z + rng.normal(0, 0.08, z.shape)
    out = base / np.maximum(np.round(disparity * 8) / 8, 1e-3)
    drop = (_jump_edges(z) & (rng.random(z.shape) < 0.7)) | (rng.random(z.shape) < 0.003)
    return np.where((z > 0.4) & (z < 5.0) & ~drop, out, np.nan).astype(np.float32)


def time_of_flight(z: Float32, rng: np.random.Generator) -> Float32:
    """Depth [H, W] m of a time-of-flight camera: range-dependent noise, flying pixels at edges, 0.2-8 m."""
    flying = _jump_edges(z) & (rng.random(z.shape) < 0.3)
    mixed = cv2.blur(np.nan_to_num(z), (3, 3))
    out = np.where(flying, mixed, z) + rng.normal(0, 1, z.shape) * (0.002 + 0.0012 * np.nan_to_num(z) ** 2)
    return np.where((z > 0.2) & (z < 8.0), out, np.nan).astype(np.float32)


@dataclass(frozen=True)
class LidarModel:
    """Directions of one sweep and the noise of its ranges (m)."""

    lines: int
    fov_deg: float
    columns: int = 1024
    max_range: float = 120.0
    noise: float = 0.015
    dropout: float = 0.02


LIDARS = {
    "spinning64": LidarModel(64, 45.0),
    "spinning128": LidarModel(128, 90.0),
    "rosette": LidarModel(1, 70.0, 24000, 200.0),
}


def ray_pattern(model: LidarModel, sweep: int, period: float, fov_deg: float) -> tuple[Float64, Float64]:
    """Unit directions [N, 3] (x forward, z up) and times [N] s after the start of sweep number ``sweep``."""
    if model.lines == 1:
        t = (np.arange(model.columns) + 0.5) / model.columns * period
        a = sweep * period + t
        reach = np.radians(model.fov_deg / 4)
        u = reach * (np.cos(764.0 * a) + np.cos(488.7 * a))
        v = reach * (np.sin(764.0 * a) - np.sin(488.7 * a))
        d = np.stack([np.ones_like(u), np.tan(u), np.tan(v)], -1)
        return d / np.linalg.norm(d, axis=1, keepdims=True), t
    fraction = (np.arange(model.columns) + 0.5) / model.columns
    azimuth = -2 * np.pi * (fraction - SWEEP_PHASE)
    centred = np.arctan2(np.sin(azimuth), np.cos(azimuth))
    keep = np.abs(centred) <= np.radians(fov_deg / 2)
    elevation = np.radians(np.linspace(-0.5, 0.5, model.lines) * model.fov_deg)
    az, el = np.meshgrid(azimuth[keep], elevation, indexing="ij")
    d = np.stack([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)], -1)
    return d.reshape(-1, 3), np.repeat(fraction[keep] * period, model.lines)


def lidar_sweep(
    renderer: Renderer,
    model: LidarModel,
    pose: PoseAt,
    start: float,
    sweep: int,
    period: float,
    fov_deg: float,
    rng: np.random.Generator,
) -> tuple[PointCloud, Float32]:
    """One raw (not de-skewed) sweep: every ray leaves from the true T_map_lidar = ``pose`` at its own time.

    Returns the cloud in the moving LiDAR frame, stamp 0, time offsets in ns, and intensities [N] in 0..255.
    """
    directions, t = ray_pattern(model, sweep, period, fov_deg)
    instants, inverse = np.unique(t, return_inverse=True)
    T = pose(start + instants)[inverse]
    world = np.einsum("nij,nj->ni", T[:, :3, :3], directions)
    hits = renderer.cast(T[:, :3, 3], world)
    keep = (hits.distance < model.max_range) & (hits.distance > 0.3) & (rng.random(len(t)) >= model.dropout)
    distance = hits.distance[keep] + rng.normal(0, model.noise, int(keep.sum()))
    facing = np.abs(np.einsum("nc,nc->n", renderer.face_normals(hits.triangle[keep]), world[keep]))
    tint = renderer.scene.tint[hits.triangle[keep]].mean(1)
    points = (directions[keep] * distance[:, None]).astype(np.float32)
    offsets = np.round(t[keep] * 1e9).astype(np.int64)
    return PointCloud(points, time_offset_ns=offsets), np.clip(200 * facing * tint, 0, 255).astype(np.float32)
