"""The measures against evo and against cases with known answers."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from evo.core import metrics
from evo.core.trajectory import PoseTrajectory3D
from hypothesis import given, settings
from hypothesis import strategies as st

from sf_bringup.evaluation import depth_error, interpolate_pose, match_stamps, psnr, trajectory_error
from sf_interfaces.errors import FormatError
from sf_interfaces.geometry import se3
from sf_interfaces.geometry.align import align
from sf_interfaces.types import DepthMap, Scale, Trajectory


def wander(seed: int, count: int = 60) -> Trajectory:
    rng = np.random.default_rng(seed)
    poses = [np.eye(4)]
    for _ in range(count - 1):
        poses.append(poses[-1] @ se3.exp(rng.normal(0, 0.1, 6)))
    return Trajectory(np.arange(count) * 33_333_333, np.array(poses))


def disturbed(reference: Trajectory, seed: int, scale: float, kind: Scale) -> Trajectory:
    rng = np.random.default_rng(seed)
    poses = np.array(reference.poses @ se3.exp(rng.normal(0, 0.02, (len(reference), 6))))
    poses[:, :3, 3] *= scale
    return Trajectory(reference.stamps_ns, se3.exp(rng.normal(0, 1, 6)) @ poses, kind)


def as_evo(trajectory: Trajectory) -> PoseTrajectory3D:
    return PoseTrajectory3D(poses_se3=[np.array(T) for T in trajectory.poses], timestamps=trajectory.stamps_ns * 1e-9)


@pytest.mark.parametrize("kind, scale", [(Scale.METRIC, 1.0), (Scale.ARBITRARY, 0.37)])
@pytest.mark.parametrize("seed", range(3))
def test_ate_equals_evo(seed: int, kind: Scale, scale: float) -> None:
    reference = wander(seed)
    estimate = disturbed(reference, seed + 100, scale, kind)
    ours = trajectory_error(estimate, reference)
    theirs, truth = as_evo(estimate), as_evo(reference)
    theirs.align(truth, correct_scale=kind is Scale.ARBITRARY)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((truth, theirs))
    assert ours.rmse == pytest.approx(ape.get_statistic(metrics.StatisticsType.rmse), abs=1e-9)
    assert ours.max == pytest.approx(ape.get_statistic(metrics.StatisticsType.max), abs=1e-9)
    assert ours.median == pytest.approx(ape.get_statistic(metrics.StatisticsType.median), abs=1e-9)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.1, 10))
def test_alignment_recovers_the_motion(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    source = rng.normal(0, 2, (20, 3))
    T = se3.exp(rng.normal(0, 1, 6))
    found_scale, found = align(source, se3.transform(T, scale * source), with_scale=True)
    assert found_scale == pytest.approx(scale, rel=1e-9)
    np.testing.assert_allclose(found, T, atol=1e-8)


def test_alignment_of_mirrored_points_stays_a_rotation() -> None:
    source = np.random.default_rng(0).normal(size=(10, 3))
    _, T = align(source, source * [1, 1, -1])
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)


def test_trajectories_of_different_clocks_are_refused() -> None:
    reference = wander(0)
    late = Trajectory(reference.stamps_ns + 10**12, reference.poses)
    with pytest.raises(FormatError, match="same clock"):
        trajectory_error(late, reference)


def test_stamps_match_the_nearest_within_the_limit() -> None:
    i, j = match_stamps(np.array([0, 10, 21, 90]), np.array([1, 20, 50]), max_difference_ns=5)
    assert i.tolist() == [0, 2] and j.tolist() == [0, 1]


def test_depth_error_on_a_known_case() -> None:
    truth = DepthMap(np.array([[1.0, 2.0, 4.0, np.nan]], np.float32))
    guess = DepthMap(np.array([[1.0, 2.15, np.nan, 5.0]], np.float32), np.full((1, 4), 0.01, np.float32))
    error = depth_error(guess, truth)
    assert error.pixels == 2
    assert error.absrel == pytest.approx(3.75, rel=1e-5)  # mean of 0 and 7.5 %
    assert error.inlier == pytest.approx(50.0)
    assert error.mae == pytest.approx(0.075, rel=1e-5)
    assert error.density == pytest.approx(200 / 3)
    assert (error.within_1_sigma, error.within_2_sigma) == (50.0, 100.0)


def test_depth_without_overlap_is_refused() -> None:
    empty = DepthMap(np.full((2, 2), np.nan, np.float32))
    with pytest.raises(FormatError, match="no pixel"):
        depth_error(empty, empty)


def test_psnr_of_a_known_error() -> None:
    black = np.zeros((4, 4, 3), np.uint8)
    assert psnr(black, black) == float("inf")
    assert psnr(np.full_like(black, 255), black) == pytest.approx(0.0)
    mask = np.zeros((4, 4), bool)
    mask[0, 0] = True
    half = black.copy()
    half[1:] = 255
    assert psnr(half, black, mask) == float("inf")


def test_poses_are_interpolated_and_never_extrapolated() -> None:
    T = se3.exp(np.array([0.2, 0.0, 0.0, 0.0, 0.0, 0.4]))
    line = Trajectory(np.array([0, 100]), np.array([np.eye(4), T]))
    half = interpolate_pose(line, 50)
    assert half is not None
    np.testing.assert_allclose(half @ half, T, atol=1e-12)
    assert interpolate_pose(line, -1) is None and interpolate_pose(line, 101) is None
