"""Dense bundle adjustment on correspondences whose answer is known: optimum, covariance, start."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from views import adjust, exact, rotation_error_deg

from sf_depth.core import dense_ba, pinhole
from sf_depth.core import dense_ba_reference as reference
from sf_depth.core.dense_ba import Estimate, Observations
from sf_depth.core.start import Size, start
from sf_interfaces.errors import ConfigError, InsufficientParallax
from sf_interfaces.geometry import se3

SIZE = Size(640, 480)


def relative_error(found: Estimate, truth: Estimate) -> np.ndarray:
    ratio = np.median(found.inverse_depth / truth.inverse_depth)
    return found.inverse_depth / ratio / truth.inverse_depth - 1


def disturbed(truth: Estimate, focal: float = 1.0) -> Estimate:
    rng = np.random.default_rng(1)
    theta = truth.theta * [focal, focal, 1, 1, 0]
    T = se3.exp(rng.normal(0, 0.03, (len(truth.T), 6))) @ truth.T
    return Estimate(theta, T, np.full_like(truth.inverse_depth, 0.4))


@pytest.mark.parametrize("free, k1", [("none", 0.0), ("f", 0.0), ("pinhole", 0.0), ("radial", -0.1)])
def test_the_optimum_is_the_truth_within_the_noise(free: str, k1: float) -> None:
    seen, truth = exact(k1=k1)
    found = adjust(seen, disturbed(truth, 1.0 if free == "none" else 0.8), intrinsics=free)
    assert found.iterations <= 25
    assert rotation_error_deg(found.estimate.T, truth.T) < 0.05
    assert np.median(np.abs(relative_error(found.estimate, truth))) < 0.004
    np.testing.assert_allclose(found.estimate.theta[:2], truth.theta[:2], rtol=2e-3)
    np.testing.assert_allclose(found.estimate.theta[4], k1, atol=2e-3)


def turned(truth: Estimate, size: float = 0.01) -> Estimate:
    """The same with a turn of every source."""
    return replace(truth, turn=np.random.default_rng(3).normal(0, size, (len(truth.T), 3)), turn_deviation=0.01)


def test_jacobians_match_differences() -> None:
    seen, truth = exact(count=7, sources=1, k1=-0.08)
    truth = replace(turned(truth, 0.0), theta=truth.theta * [1, 0.9, 1, 1, 1])
    columns = pinhole.free_columns(truth.theta, "radial")
    x = pinhole.rays(truth.theta, seen.uv)
    dx = pinhole.rays_jacobian(truth.theta, x, columns)
    row = reference.rows(seen, truth, 0)
    A, a = reference.jacobians(truth, 0, x, row, dx, truth.inverse_depth, True, columns)

    def predicted(step: np.ndarray, dd: float = 0.0) -> np.ndarray:
        there = dense_ba.moved(truth, (step, np.full(7, dd)), True, columns)
        return seen.target[0] - reference.residuals(seen, there)[0]

    for k in range(11):
        step = 1e-6 * np.eye(11)[k]
        np.testing.assert_allclose((predicted(step) - predicted(-step)) / 2e-6, A[k], rtol=1e-4, atol=1e-4)
    zero = np.zeros(11)
    np.testing.assert_allclose((predicted(zero, 1e-6) - predicted(zero, -1e-6)) / 2e-6, a, rtol=1e-4, atol=1e-4)


def test_one_step_solves_the_full_normal_equations() -> None:
    """The Schur complement and its back-substitution against a dense solve; a wrong sign fails here."""
    seen, truth = exact(count=40, sources=2)
    at = disturbed(truth, 0.9)
    columns = pinhole.free_columns(at.theta, "pinhole")
    system = dense_ba.linearise(seen, at, 1.0, True, columns)
    P, N = system.E.shape
    whole = np.zeros((P + N, P + N))
    whole[:P, :P], whole[:P, P:], whole[P:, :P] = system.H, system.E, system.E.T
    whole[P:, P:] = np.diag(system.C)
    damping = 1e-3
    whole[np.diag_indices(P + N)] *= 1 + damping
    expected = np.linalg.solve(whole, np.concatenate([system.g, system.w]))
    dx, dd = dense_ba.step(system, damping)
    np.testing.assert_allclose(dx, expected[:P], rtol=1e-2, atol=1e-5)
    np.testing.assert_allclose(dd, expected[P:], rtol=1e-2, atol=1e-4)


def close(found: np.ndarray, expected: np.ndarray) -> None:
    """Within 1e-5 of the largest value."""
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5 * np.abs(expected).max(initial=1e-30))


@pytest.mark.parametrize("free, k1", [("none", 0.0), ("f", 0.0), ("pinhole", 0.0), ("radial", -0.1)])
@pytest.mark.parametrize("poses, turn", [(True, True), (True, False), (False, True), (False, False)])
def test_the_kernels_compute_what_the_reference_says(free: str, k1: float, poses: bool, turn: bool) -> None:
    seen, truth = exact(count=1307, k1=k1)  # blocks and vectors that do not come out even
    rng = np.random.default_rng(0)
    weight = rng.random(seen.weight.shape) * (rng.random(seen.weight.shape) < 0.8)
    seen = Observations(seen.uv, np.where(weight[:, None] > 0, seen.target, np.nan), weight)
    T = truth.T.copy()
    T[0, 2, 3] -= 1.5  # some points lie behind it
    at = replace(truth, T=T, inverse_depth=truth.inverse_depth * rng.uniform(0.97, 1.03, 1307))
    at = turned(at) if turn else at
    columns = pinhole.free_columns(at.theta, free)

    r = reference.residuals(seen, at)
    squares = dense_ba.squared_residuals(seen, at)
    expected = np.where(weight > 0, reference.squared(r), np.nan)
    assert np.isnan(r[0, 0][weight[0] > 0]).any()
    np.testing.assert_allclose(squares, expected, rtol=1e-6)
    np.testing.assert_allclose(dense_ba.robust_cost(squares, weight, 0.7), reference.cost(r, weight, 0.7), rtol=1e-6)

    system = dense_ba.linearise(seen, at, 0.7, poses, columns, scores=True)
    said = reference.linearise(seen, at, reference.robust(r, weight, 0.7), r, 0.7, poses, columns)
    for name in ("H", "g", "E", "C", "w", "scores"):
        close(getattr(system, name), getattr(said, name))
    dx, dd = dense_ba.step(said, 1e-3)
    expected_dx, expected_dd = reference.step(said, 1e-3)
    np.testing.assert_allclose(dx, expected_dx, rtol=1e-3, atol=1e-5)  # as far as the free scale lets them
    close(dd, expected_dd) if not poses else np.testing.assert_allclose(dd, expected_dd, rtol=1e-2, atol=1e-4)


def test_deviations_hold_what_they_promise() -> None:
    inside, pulls = [], []
    for seed in range(12):
        seen, truth = exact(count=800, seed=seed)
        found = adjust(seen, truth, intrinsics="f")
        factor = np.linalg.norm(truth.T[:, :3, 3]) / np.linalg.norm(found.estimate.T[:, :3, 3])
        error = found.estimate.inverse_depth / factor - truth.inverse_depth
        inside.append(np.mean(np.abs(error) < np.sqrt(found.inverse_depth_variance)))
        pulls.append((np.log(found.estimate.theta[0] / 520)) / np.sqrt(found.covariance[24, 24]))
    assert 0.6 < np.mean(inside) < 0.76
    assert 0.4 < np.sqrt(np.mean(np.square(pulls))) < 1.7


def turning(seed: int) -> tuple[Observations, Estimate]:
    """What sources see that turn while their rows are read one after the other."""
    seen, truth = exact(count=1500, seed=seed)
    omega = np.random.default_rng(100 + seed).normal(0, 0.006, (4, 3))
    target = seen.target.copy()
    for j in range(4):
        X = reference.transformed(truth.T[j], pinhole.rays(truth.theta, seen.uv), truth.inverse_depth)
        for _ in range(5):  # which row sees a point depends on where it is seen
            row = (target[j, 1] - truth.theta[3]) / truth.theta[1]
            Y = X + row * np.cross(omega[j], X, axisb=0).T
            target[j] = pinhole.project(truth.theta, Y[:2] / Y[2])
    noise = np.random.default_rng(seed).normal(0, 0.3, target.shape)
    return replace(seen, target=target + noise), replace(truth, turn=omega)


def test_cameras_that_turn_while_they_are_read_are_found_and_steadied() -> None:
    off: dict[bool, list[float]] = {False: [], True: []}
    shifts = []
    for seed in range(6):
        seen, truth = turning(seed)
        for turn in (False, True):
            found = adjust(seen, replace(truth, turn=None), turn=0.004 if turn else 0.0)
            off[turn].append(rotation_error_deg(found.estimate.T, truth.T))
        assert found.covariance.shape == (26, 26)  # poses, f and k1: turns are marginalised
        steady = replace(seen, target=dense_ba.steadied(found.estimate, seen.target))
        left = reference.residuals(steady, replace(found.estimate, turn=None))
        shifts.append(np.median(np.abs(left)))
        assert np.abs(found.estimate.turned - truth.turned).mean() < 0.4 * np.abs(truth.turned).mean()
    assert np.mean(off[True]) < 0.5 * np.mean(off[False])
    assert max(shifts) < 0.25  # px: the noise


def test_wrong_correspondences_and_points_behind_do_not_matter() -> None:
    seen, truth = exact(noise=0.2)
    rng = np.random.default_rng(2)
    target = seen.target.copy()
    wrong = rng.random(target.shape[2]) < 0.2
    target[:, :, wrong] = rng.uniform(0, 480, target[:, :, wrong].shape)
    found = adjust(replace(seen, target=target), disturbed(truth), intrinsics="none")
    assert rotation_error_deg(found.estimate.T, truth.T) < 0.1
    assert np.median(np.abs(relative_error(found.estimate, truth)[~wrong])) < 0.01
    assert (found.estimate.inverse_depth > 0).all()


def test_given_poses_keep_the_scale() -> None:
    seen, truth = exact()
    at = replace(truth, inverse_depth=np.full_like(truth.inverse_depth, 0.4))
    found = adjust(seen, at, poses=False)
    np.testing.assert_array_equal(found.estimate.T, truth.T)
    assert np.median(np.abs(found.estimate.inverse_depth / truth.inverse_depth - 1)) < 0.004


@pytest.mark.parametrize("focal", [260.0, 520.0, 1040.0, 1500.0])
def test_the_start_needs_no_guess_of_the_focal_length(focal: float) -> None:
    seen, truth = exact(focal=focal, noise=0.3)
    found = adjust(seen, start(seen, SIZE, None), intrinsics="f")
    assert abs(found.estimate.theta[0] / focal - 1) < 0.01
    assert rotation_error_deg(found.estimate.T, truth.T) < 0.1


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("turning", [True, False])
def test_no_parallax_is_said_in_words(known: bool, turning: bool) -> None:
    seen, truth = exact(noise=0.2)
    T = truth.T.copy()
    T[:, :3, 3] = 0.0
    if not turning:
        T[:] = np.eye(4)
    blank = Observations(seen.uv, np.zeros_like(seen.target), seen.weight)
    noise = reference.residuals(seen, truth)
    target = -reference.residuals(blank, replace(truth, T=T)) + noise
    with pytest.raises(InsufficientParallax, match="no parallax"):
        start(replace(seen, target=target), SIZE, truth.theta if known else None)


def test_unknown_sets_of_intrinsics_are_refused() -> None:
    with pytest.raises(ConfigError, match="choose one of"):
        pinhole.free_columns(np.ones(5), "skew")
