"""Bundle adjustment: Jacobians against differences, a dense solver as reference, and recovery of known scenes."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from sf_interfaces.geometry import se3
from sf_interfaces.geometry.align import align
from sf_interfaces.types import Camera
from sf_tracking.core.bundle import Problem, adjust, cost, information_root, project
from sf_tracking.core.bundle_reference import jacobians, whiten

CAMERA = Camera(640, 480, 500.0, 480.0, 320.0, 240.0)


def scene(seed: int, n: int = 4, m: int = 25, noise: float = 0.0, outliers: int = 0) -> tuple[Problem, Problem]:
    """A true problem and the same with disturbed poses and inverse depths; keyframe 0 is exact."""
    rng = np.random.default_rng(seed)
    T = se3.exp(rng.normal(0, 0.15, (n, 6)))
    uv0, w = rng.uniform((0, 0), (640, 480), (n, m, 2)), 1 / rng.uniform(2, 8, (n, m))
    rays = (uv0 - (CAMERA.cx, CAMERA.cy)) / (CAMERA.fx, CAMERA.fy)
    T_ts = T[None] @ se3.inverse(T)[:, None]
    uv, _ = project(CAMERA, T_ts, rays[:, None], w[:, None])
    uv = uv + rng.normal(0, noise, uv.shape)
    uv[:, :, :outliers] += 40.0
    information = np.broadcast_to(np.array([[1.0, 0.2], [0.2, 0.7]]), (n, n, m, 2, 2)).copy()
    information[np.arange(n), np.arange(n)] = 0.0
    no_motion = np.broadcast_to(np.eye(4), (n, n, 4, 4)), np.zeros((n, n, 6, 6))
    truth = Problem(T, rays, w, w, np.zeros((n, m)), uv, information_root(information), *no_motion)
    start = se3.exp(rng.normal(0, 0.02, (n, 6))) @ T
    start[0] = T[0]
    return truth, replace(truth, T_cw=start, w=w * rng.uniform(0.8, 1.25, w.shape))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6))
def test_jacobians_equal_differences(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rays, w = rng.uniform(-0.6, 0.6, (1, 2)), rng.uniform(0.1, 1.0, 1)
    T = se3.exp(rng.normal(0, 0.1, 6))
    _, X = project(CAMERA, T, rays, w)
    information = np.array([[[2.0, 0.6], [0.6, 1.5]]])
    root = information_root(information)
    np.testing.assert_allclose((whiten(np.array([[0.3, -0.7]]), root) ** 2).sum(), 0.663, rtol=1e-9)
    J, J_w = jacobians(CAMERA, X, w, T[:3, 3], root)
    step = 1e-6

    def difference(ahead: np.ndarray, behind: np.ndarray) -> np.ndarray:
        return whiten((ahead - behind) / (2 * step), root)

    for k in range(6):
        xi = np.eye(6)[k] * step
        ahead, behind = (project(CAMERA, se3.exp(s * xi) @ T, rays, w)[0] for s in (1, -1))
        np.testing.assert_allclose(J[k], difference(ahead, behind), rtol=1e-4, atol=1e-3)
    ahead, behind = (project(CAMERA, T, rays, w + s * step)[0] for s in (1, -1))
    np.testing.assert_allclose(J_w, difference(ahead, behind), rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("seed", range(3))
def test_exact_observations_with_measured_depth_give_the_exact_poses(seed: int) -> None:
    truth, start = scene(seed)
    start = replace(start, prior_weight=np.full(start.w.shape, 1e4))
    found, information = adjust(CAMERA, start, np.arange(4) >= 1, 3.0, 30)
    np.testing.assert_allclose(found.T_cw, truth.T_cw, atol=1e-5)
    np.testing.assert_allclose(found.w, truth.w, atol=1e-5)
    assert (information >= 1e3).all()


@pytest.mark.parametrize("seed", range(3))
def test_without_depth_the_scene_is_exact_up_to_its_scale(seed: int) -> None:
    truth, start = scene(seed)
    found, _ = adjust(CAMERA, start, np.arange(4) >= 1, 3.0, 60)
    a, b = (se3.inverse(p.T_cw)[:, :3, 3] for p in (found, truth))
    scale, T = align(a, b, with_scale=True)
    np.testing.assert_allclose(se3.transform(T, scale * a), b, atol=1e-4)
    np.testing.assert_allclose(found.w / scale, truth.w, rtol=1e-2)


def test_two_fixed_poses_also_hold_the_scale() -> None:
    truth, start = scene(5)
    start.T_cw[1] = truth.T_cw[1]
    found, _ = adjust(CAMERA, start, np.arange(4) >= 2, 3.0, 60)
    np.testing.assert_allclose(found.T_cw, truth.T_cw, atol=1e-5)


def test_schur_complement_reaches_the_optimum_of_a_dense_solver() -> None:
    """Oracle: scipy on all parameters with numeric derivatives, the same Cauchy cost."""
    truth, start = scene(7, n=3, m=6, noise=0.5)
    start = replace(start, prior=truth.w * 1.02, prior_weight=np.full(start.w.shape, 1e3))

    def rebuild(x: np.ndarray) -> Problem:
        T = start.T_cw.copy()
        T[1:] = se3.exp(x[:12].reshape(2, 6)) @ T[1:]
        return replace(start, T_cw=T, w=x[12:].reshape(3, 6))

    def errors(x: np.ndarray) -> np.ndarray:
        p = rebuild(x)
        T_ts = p.T_cw[None] @ se3.inverse(p.T_cw)[:, None]
        r = p.uv - project(CAMERA, T_ts, p.rays[:, None], p.w[:, None])[0]
        squared = (whiten(r, p.root) ** 2).sum(axis=2)
        both = np.r_[squared.ravel(), (p.prior_weight * (p.prior - p.w) ** 2).ravel()]
        return 3.0 * np.sqrt(np.log1p(both / 9.0))

    found, _ = adjust(CAMERA, start, np.arange(3) >= 1, 3.0, 60)
    oracle = least_squares(errors, np.r_[np.zeros(12), start.w.ravel()], max_nfev=25)
    assert cost(CAMERA, found, 3.0) <= 2 * oracle.cost * (1 + 1e-3)


def test_outliers_lose_their_weight() -> None:
    truth, start = scene(1, m=40, noise=0.3, outliers=6)
    start = replace(start, prior_weight=np.full(start.w.shape, 1e4))
    found, _ = adjust(CAMERA, start, np.arange(4) >= 1, 3.0, 40)
    error = np.linalg.norm(se3.inverse(found.T_cw)[:, :3, 3] - se3.inverse(truth.T_cw)[:, :3, 3], axis=1)
    assert error.max() < 0.005  # m; without the robust kernel the outliers move poses by decimetres


def test_measured_motions_pull_as_strongly_as_they_are_sure() -> None:
    truth, start = scene(3)
    motion = truth.T_cw[None] @ se3.inverse(truth.T_cw)[:, None]
    sure = np.zeros((4, 4, 6, 6))
    sure[1:, 0] = 1e8 * np.eye(6)  # of keyframe 0 relative to each other one
    blind = replace(start, root=np.zeros_like(start.root), motion=motion, motion_information=sure)
    found, _ = adjust(CAMERA, blind, np.arange(4) >= 1, 3.0, 20)
    np.testing.assert_allclose(found.T_cw, truth.T_cw, atol=1e-6)


def test_a_patch_never_seen_stays_where_it_is() -> None:
    _, start = scene(2)
    start.root[0, :, 3] = 0.0
    found, _ = adjust(CAMERA, start, np.arange(4) >= 1, 3.0, 10)
    assert found.w[0, 3] == pytest.approx(start.w[0, 3])


def test_points_behind_the_camera_carry_no_residual() -> None:
    uv, _ = project(CAMERA, se3.exp(np.array([0, 0, -3.0, 0, 0, 0])), np.zeros((1, 2)), np.ones(1))
    assert np.isnan(uv).all()


def test_rotations_stay_orthonormal_over_many_products() -> None:
    _, p = scene(2)
    for _ in range(30):
        p = replace(p, T_cw=se3.exp(np.full(6, 0.01)) @ p.T_cw)
        p, _ = adjust(CAMERA, p, np.arange(4) >= 1, 3.0, 2)
    R = p.T_cw[1:, :3, :3]
    np.testing.assert_allclose(R @ np.swapaxes(R, 1, 2), np.broadcast_to(np.eye(3), R.shape), atol=1e-10)
