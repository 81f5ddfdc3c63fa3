"""Bundle adjustment: Jacobians against differences, and recovery of known poses."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera
from sf_tracking.core.bundle import Edges, adjust, project_jacobian, residuals

CAMERA = Camera(640, 480, 500.0, 480.0, 320.0, 240.0)


def problem(seed: int, noise: float = 0.0, outliers: int = 0) -> tuple[np.ndarray, Edges]:
    """True poses T_cw [5, 4, 4] and the edges between all of them."""
    rng = np.random.default_rng(seed)
    poses = se3.exp(rng.normal(0, 0.15, (5, 6)))
    parts = []
    for i in range(5):
        points = CAMERA.unproject(rng.uniform((0, 0), (640, 480), (40, 2)), rng.uniform(2, 8, 40))
        for j in range(5):
            uv, _ = CAMERA.project(se3.transform(poses[j] @ se3.inverse(poses[i]), points))
            uv = uv + rng.normal(0, noise, uv.shape)
            uv[:outliers] += 60.0
            info = np.broadcast_to(np.eye(2), (40, 2, 2))
            if i != j:
                parts.append(Edges(np.full(40, i), np.full(40, j), points, uv, info))
    return poses, Edges.concatenate(parts)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6))
def test_projection_jacobian_equals_differences(seed: int) -> None:
    rng = np.random.default_rng(seed)
    point = np.array([[*rng.uniform(-1, 1, 2), rng.uniform(1, 5)]])
    J = project_jacobian(CAMERA, point)[0]
    step = 1e-6
    for k in range(6):
        xi = np.eye(6)[k] * step
        ahead, _ = CAMERA.project(se3.transform(se3.exp(xi), point))
        behind, _ = CAMERA.project(se3.transform(se3.exp(-xi), point))
        np.testing.assert_allclose(J[:, k], (ahead - behind)[0] / (2 * step), rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("seed", range(4))
def test_exact_observations_give_the_exact_poses(seed: int) -> None:
    truth, edges = problem(seed)
    start = truth.copy()
    start[1:] = se3.exp(np.random.default_rng(seed).normal(0, 0.03, (4, 6))) @ truth[1:]
    found = adjust(CAMERA, start, edges, np.arange(5) >= 1, scale=3.0, iterations=30)
    np.testing.assert_allclose(found, truth, atol=1e-6)
    np.testing.assert_array_equal(found[0], truth[0])


def test_outliers_lose_their_weight() -> None:
    truth, edges = problem(1, noise=0.3, outliers=6)
    start = truth.copy()
    start[1:] = se3.exp(np.random.default_rng(1).normal(0, 0.01, (4, 6))) @ truth[1:]
    found = adjust(CAMERA, start, edges, np.arange(5) >= 1, scale=3.0, iterations=30)
    error = np.linalg.norm(se3.inverse(found)[:, :3, 3] - se3.inverse(truth)[:, :3, 3], axis=1)
    assert error.max() < 0.005  # m; without the robust kernel the outliers move poses by decimetres


def test_points_behind_the_camera_carry_no_residual() -> None:
    edges = Edges(np.array([0]), np.array([1]), np.array([[0.0, 0.0, 1.0]]), np.array([[5.0, 5.0]]), np.eye(2)[None])
    backwards = se3.exp(np.array([0, 0, -3.0, 0, 0, 0]))
    r, _, _, valid = residuals(CAMERA, np.stack([np.eye(4), backwards]), edges)
    assert not valid[0] and not r.any()


def test_rotations_stay_orthonormal_over_many_products() -> None:
    truth, edges = problem(2)
    poses = truth.copy()
    for _ in range(50):
        poses = adjust(CAMERA, se3.exp(np.full(6, 0.01)) @ poses, edges, np.arange(5) >= 1, 3.0, 2)
    R = poses[:, :3, :3]
    np.testing.assert_allclose(R @ np.swapaxes(R, 1, 2), np.broadcast_to(np.eye(3), R.shape), atol=1e-10)
