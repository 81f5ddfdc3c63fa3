"""The measures against evo and against cases with known answers."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from evo.core import metrics, sync
from evo.core.trajectory import PoseTrajectory3D
from evo.tools import file_interface
from hypothesis import given, settings
from hypothesis import strategies as st

from sf_bringup.eval_files import read_trajectory
from sf_bringup.evaluation import TrajectoryError, depth_error, interpolate_pose, match_stamps, trajectory_error
from sf_bringup.evaluation.depth import ause
from sf_bringup.evaluation.robust_mvd import all_views, mvd_error, oracle_view_choice
from sf_interfaces.errors import ConfigError, FormatError
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


def evo_errors(estimate: PoseTrajectory3D, reference: PoseTrajectory3D, scale: bool, delta: int) -> dict[str, float]:
    """ATE and RPE of already matched trajectories, by evo alone."""
    estimate.align(reference, correct_scale=scale)
    out = {}
    for name, metric in (
        ("ape", metrics.APE(metrics.PoseRelation.translation_part)),
        ("rpe", metrics.RPE(metrics.PoseRelation.translation_part, delta, metrics.Unit.frames, all_pairs=True)),
        ("rot", metrics.RPE(metrics.PoseRelation.rotation_angle_deg, delta, metrics.Unit.frames, all_pairs=True)),
    ):
        metric.process_data((reference, estimate))
        out |= {f"{name}_{s.value}": metric.get_statistic(s) for s in metrics.StatisticsType}
    return out


def assert_equal_to_evo(ours: TrajectoryError, evo: dict[str, float]) -> None:
    pairs = {
        "rmse": "ape_rmse", "mean": "ape_mean", "median": "ape_median", "max": "ape_max",
        "rpe_rmse": "rpe_rmse", "rpe_median": "rpe_median",
        "rpe_rotation_rmse": "rot_rmse", "rpe_rotation_median": "rot_median",
    }  # fmt: skip
    assert {k: getattr(ours, k) for k in pairs} == pytest.approx({k: evo[v] for k, v in pairs.items()}, abs=1e-6)


@pytest.mark.parametrize("delta", [1, 7])
@pytest.mark.parametrize("kind, scale", [(Scale.METRIC, 1.0), (Scale.ARBITRARY, 0.37)])
@pytest.mark.parametrize("seed", range(3))
def test_trajectory_errors_equal_evo(seed: int, kind: Scale, scale: float, delta: int) -> None:
    reference = wander(seed)
    estimate = disturbed(reference, seed + 100, scale, kind)
    ours = trajectory_error(estimate, reference, delta=delta)
    evo = evo_errors(as_evo(estimate), as_evo(reference), kind is Scale.ARBITRARY, delta)
    assert_equal_to_evo(ours, evo)
    assert ours.pairs == 60 and ours.delta == delta


@pytest.mark.parametrize(
    "name, alignment",
    [
        ("freiburg1_xyz-rgbdslam.txt", "se3"),
        ("freiburg1_xyz-rgbdslam_drift.txt", "se3"),
        ("freiburg1_xyz-ORB_kf_mono.txt", "sim3"),
    ],
)
def test_recorded_trajectories_equal_evo(shared_data: Callable[[str], Path], name: str, alignment: str) -> None:
    folder = shared_data("trajectories_evo")
    truth = folder / "freiburg1_xyz-groundtruth.txt"
    ours = trajectory_error(read_trajectory(folder / name), read_trajectory(truth), alignment=alignment)
    reference, estimate = sync.associate_trajectories(
        file_interface.read_tum_trajectory_file(truth), file_interface.read_tum_trajectory_file(folder / name)
    )
    assert ours.pairs == reference.num_poses
    assert_equal_to_evo(ours, evo_errors(estimate, reference, alignment == "sim3", 1))


def test_recorded_kitti_trajectory_equals_evo(shared_data: Callable[[str], Path]) -> None:
    folder = shared_data("trajectories_evo")
    files = folder / "KITTI_00_ORB.txt", folder / "KITTI_00_gt.txt"
    ours = trajectory_error(*map(read_trajectory, files), alignment="sim3", delta=10)
    estimate, reference = map(file_interface.read_kitti_poses_file, files)
    evo = evo_errors(estimate, reference, True, 10)
    assert ours.rmse == pytest.approx(evo["ape_rmse"], abs=1e-6)
    assert ours.rpe_rmse == pytest.approx(evo["rpe_rmse"], abs=1e-4)  # we re-orthonormalise the file's rotations


def test_degenerate_trajectories_are_refused_in_words() -> None:
    reference = wander(0)
    one = Trajectory(reference.stamps_ns[:1], reference.poses[:1])
    with pytest.raises(FormatError, match="only 1 of 1 poses"):
        trajectory_error(one, reference)
    still = Trajectory(reference.stamps_ns, np.tile(np.eye(4), (60, 1, 1)), Scale.ARBITRARY)
    with pytest.raises(FormatError, match="no scale can be found"):
        trajectory_error(still, reference)
    assert trajectory_error(still, reference, alignment="se3").rpe_rotation_rmse > 0
    with pytest.raises(FormatError, match="60 frames apart"):
        trajectory_error(reference, reference, delta=60)
    with pytest.raises(ConfigError, match="choose se3"):
        trajectory_error(reference, reference, alignment="sim2")


def test_no_alignment_leaves_the_offset_in() -> None:
    reference = wander(1)
    shifted = np.array(reference.poses)
    shifted[:, 0, 3] += 0.25
    error = trajectory_error(Trajectory(reference.stamps_ns, shifted), reference, alignment="none")
    assert error.rmse == error.max == pytest.approx(0.25) and error.rpe_rmse == pytest.approx(0, abs=1e-12)


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


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000), st.floats(0.2, 5), st.floats(-0.02, 0.05))
def test_depth_alignment_undoes_scale_and_shift(seed: int, scale: float, shift: float) -> None:
    rng = np.random.default_rng(seed)
    truth = DepthMap(rng.uniform(1, 5, (8, 9)))
    guess = DepthMap(scale * truth.z, np.full((8, 9), 0.01 * scale**2))
    for alignment in ("median", "lstsq"):
        error = depth_error(guess, truth, alignment)
        assert error.absrel < 1e-3 and error.within_1_sigma == error.delta1 == 100
    bent = DepthMap(1 / (scale / truth.z + shift))
    assert depth_error(bent, truth, "lstsq").absrel < 1e-3
    with pytest.raises(ConfigError, match="choose none"):
        depth_error(guess, truth, "mean")


def test_variance_calibration_of_a_gaussian() -> None:
    rng = np.random.default_rng(0)
    sigma = rng.uniform(0.01, 0.1, (300, 400))
    truth = DepthMap(np.full((300, 400), 3.0))
    error = depth_error(DepthMap(3 + sigma * rng.standard_normal(sigma.shape), sigma**2), truth)
    assert error.within_1_sigma == pytest.approx(68.27, abs=0.5)
    assert error.within_2_sigma == pytest.approx(95.45, abs=0.5)
    expected = np.mean(0.5 * np.log(2 * np.pi * sigma**2)) + 0.5
    assert error.nll == pytest.approx(expected, abs=0.01)
    overconfident = depth_error(DepthMap(truth.z + sigma, sigma**2 / 100), truth)
    assert overconfident.nll > error.nll + 10


def test_ause_is_zero_for_a_perfect_ranking_and_known_for_the_reverse() -> None:
    error = np.linspace(0.0, 1.0, 2000)
    assert ause(error, error) == pytest.approx(0)
    assert ause(error, 3 * error**2) == pytest.approx(0)  # only the order counts
    # With e uniform on 0..1 and f removed the oracle leaves a mean of (1-f)/2, the reverse (1+f)/2: difference 2f.
    assert ause(error, -error) == pytest.approx(2 * np.mean(np.arange(20) / 20), abs=2e-3)
    assert ause(np.zeros(5), np.ones(5)) == 0.0


def test_robust_mvd_counts_what_is_not_predicted() -> None:
    truth = np.array([[2.0, 4.0], [0.0, 5.0]])
    prediction = np.array([[1.0, 2.02], [3.0, np.nan]])
    error = mvd_error(prediction, truth, "median")  # factor 3 / 1.51
    factor = 3.0 / 1.51
    rel = [abs(factor - 2) / 2, abs(2.02 * factor - 4) / 4, (5 - 0.1) / 5]
    assert error.absrel == pytest.approx(100 * np.mean(rel)) and error.density == pytest.approx(200 / 3)
    assert error.inlier == pytest.approx(200 / 3)
    sparse = mvd_error(prediction, truth, "median", sparse=True)
    assert sparse.absrel == pytest.approx(100 * np.mean(rel[:2])) and sparse.inlier == 100
    assert mvd_error(np.array([[500.0]]), np.array([[50.0]])).absrel == pytest.approx(100)  # clipped to 100 m
    half = mvd_error(np.array([[2.0, 3.0]]), np.repeat(np.repeat([[2.0, 3.0]], 4, 0), 4, 1))
    assert half.absrel == 0 and half.inlier == 100
    with pytest.raises(FormatError, match="no pixel"):
        mvd_error(np.zeros((2, 2)), truth)


def test_the_oracle_chooses_views_and_all_views_does_not() -> None:
    truth = np.full((2, 2), 2.0)
    bias = {0: 0.4, 1: 0.1, 2: -0.1, 3: 3.0}

    def predict(views: Sequence[int]) -> np.ndarray:
        return truth + np.mean([bias[v] for v in views])

    chosen = oracle_view_choice(predict, [0, 1, 2, 3], truth)
    assert set(chosen.views) == {1, 2} and chosen.absrel == pytest.approx(0, abs=1e-9)
    everything = all_views(predict, [0, 1, 2, 3], truth)
    assert everything.views == (0, 1, 2, 3) and everything.absrel == pytest.approx(100 * 0.85 / 2)


def test_poses_are_interpolated_and_never_extrapolated() -> None:
    T = se3.exp(np.array([0.2, 0.0, 0.0, 0.0, 0.0, 0.4]))
    line = Trajectory(np.array([0, 100]), np.array([np.eye(4), T]))
    half = interpolate_pose(line, 50)
    assert half is not None
    np.testing.assert_allclose(half @ half, T, atol=1e-12)
    assert interpolate_pose(line, -1) is None and interpolate_pose(line, 101) is None
