"""Views of simulated scenes and exact correspondences, with everything known."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from sf_bringup.simulate.render import Renderer
from sf_bringup.simulate.scenes import SCENES
from sf_depth.core import dense_ba, posterior
from sf_depth.core import dense_ba_reference as reference
from sf_depth.core.dense_ba import Estimate, Observations
from sf_depth.core.posterior import Adjusted
from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera, Float32, Float64, UInt8

CAMERA = Camera(320, 240, 260.0, 260.0, 160.0, 120.0)


@dataclass(frozen=True)
class Views:
    """Images of one camera with exact depth and poses."""

    camera: Camera
    images: list[UInt8]
    z: list[Float32]
    poses: list[Float64]  # T_map_camera

    @property
    def T_source_reference(self) -> Float64:
        return np.stack([se3.inverse(T) @ self.poses[0] for T in self.poses[1:]])


@lru_cache(maxsize=4)
def room(count: int = 5, roll_deg: float = 4.0, baseline: float = 0.35) -> Views:
    """Views of a furnished room from around one place, each turned a little, with sensor noise."""
    renderer = Renderer(SCENES["lounge"](0))
    rng = np.random.default_rng(3)
    T0 = np.eye(4)
    T0[:3, :3] = np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])
    T0[:3, 3] = (-1.6, -0.2, 1.4)
    poses = [T0]
    for k in range(count - 1):
        angle = 2 * np.pi * k / (count - 1) + 0.4
        step = baseline * np.array([np.cos(angle), 0.6 * np.sin(angle), rng.uniform(-0.3, 0.3)])
        turn = np.radians([-6 * np.sin(angle) * 0.6, -6 * np.cos(angle), rng.uniform(-roll_deg, roll_deg)])
        poses.append(T0 @ se3.exp(np.concatenate([step, turn])))
    images, z = [], []
    for T in poses:
        image, depth = renderer.render(CAMERA, T)
        noisy = image + rng.standard_normal(image.shape)
        images.append(np.clip(noisy + 0.5, 0, 255).astype(np.uint8))
        z.append(depth)
    return Views(CAMERA, images, z, poses)


def exact(
    count: int = 3000, sources: int = 4, *, focal: float = 520.0, k1: float = 0.0, noise: float = 0.2, seed: int = 0
) -> tuple[Observations, Estimate]:
    """Correspondences of a wavy surface under known motion, with Gaussian noise in px, and the truth."""
    rng = np.random.default_rng(seed)
    theta = np.array([focal, focal, 320.0, 240.0, k1])
    uv = rng.uniform((0, 0), (640, 480), (count, 2)).T
    d = 1.0 / (2.0 + 1.5 * np.sin(uv[0] / 90) * np.cos(uv[1] / 70) + uv[0] / 300)
    T = se3.exp(np.hstack([rng.normal(0, 0.3, (sources, 3)), rng.normal(0, 0.08, (sources, 3))]))
    truth = Estimate(theta, T, d)
    blank = Observations(uv, np.zeros((sources, 2, count)), np.ones((sources, count)))
    target = -reference.residuals(blank, truth) + rng.normal(0, noise, (sources, 2, count))
    return Observations(uv, target, np.ones((sources, count))), truth


def rotation_error_deg(T: Float64, truth: Float64) -> float:
    """Largest rotation between corresponding poses [S, 4, 4], deg."""
    return float(np.degrees(np.linalg.norm(se3.log(T @ se3.inverse(truth))[..., 3:], axis=-1)).max())


__all__ = ["CAMERA", "Views", "exact", "room", "rotation_error_deg"]


def adjust(seen: Observations, at: Estimate, poses: bool = True, intrinsics: str = "none", **options: Any) -> Adjusted:
    """The optimum with its covariance."""
    found = dense_ba.optimum(seen, at, poses=poses, intrinsics=intrinsics, **options)
    return posterior.with_covariance(seen, found, poses, intrinsics)
