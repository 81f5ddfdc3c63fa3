"""Smooth closed camera paths: periodic C2 splines through way points of position, heading and pitch."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from sf_interfaces.types import Float64


class CameraPath:
    """A closed path flown at constant average speed.

    Args:
        positions: way points [N, 3] m; yaw: [N] rad of the optical axis about z (unwrapped);
        pitch: [N] rad, up > 0; turns: whole turns of yaw in one lap; speed: m/s.
    """

    def __init__(self, positions: Float64, yaw: Float64, pitch: Float64, turns: int, speed: float) -> None:
        n = len(positions)
        knots = np.arange(n + 1) / n
        ramp = 2 * np.pi * turns
        values = np.column_stack([positions, yaw - ramp * knots[:-1], pitch])
        self._spline = CubicSpline(knots, np.vstack([values, values[:1]]), bc_type="periodic")
        self._ramp = ramp
        dense = self._spline(np.linspace(0, 1, 400))[:, :3]
        self._lap = float(np.linalg.norm(np.diff(dense, axis=0), axis=1).sum()) / speed

    def pose(self, t: float | Float64) -> Float64:
        """T_map_camera (optical) at times t s, any shape [...] -> [..., 4, 4]."""
        s = np.asarray(t, dtype=np.float64) / self._lap
        x, y, z, yaw, pitch = np.moveaxis(self._spline(s % 1.0), -1, 0)
        yaw = yaw + self._ramp * s
        zero = np.zeros_like(yaw)
        forward = np.stack([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)], -1)
        right = np.stack([np.sin(yaw), -np.cos(yaw), zero], -1)
        T = np.zeros((*yaw.shape, 4, 4))
        T[..., :3, :3] = np.stack([right, np.cross(forward, right), forward], -1)
        T[..., :3, 3] = np.stack([x, y, z], -1)
        T[..., 3, 3] = 1.0
        return T


@dataclass(frozen=True)
class PathPlan:
    """An oval lap: half axes m, height m with its sway, heading relative to outward, pitch and speed."""

    half: tuple[float, float]
    height: float
    sway: float = 0.1
    heading: float = np.pi
    pitch: float = -0.12
    speed: float = 0.6
    squareness: float = 1.0


def oval(plan: PathPlan, seed: int, points: int = 16) -> CameraPath:
    """A lap round the origin that looks ``plan.heading`` away from outward, with seeded sway."""
    rng = np.random.default_rng([seed, 77])
    a = 2 * np.pi * np.arange(points) / points
    c, s = np.cos(a), np.sin(a)
    power = 1 / plan.squareness
    x = plan.half[0] * np.sign(c) * np.abs(c) ** power
    y = plan.half[1] * np.sign(s) * np.abs(s) ** power
    jitter = rng.uniform(-1, 1, (points, 3)) * (0.05 * plan.half[0], 0.05 * plan.half[1], plan.sway)
    yaw = a + plan.heading + rng.uniform(-0.12, 0.12, points)
    pitch = plan.pitch + rng.uniform(-0.06, 0.06, points)
    return CameraPath(np.column_stack([x, y, np.full(points, plan.height)]) + jitter, yaw, pitch, 1, plan.speed)
