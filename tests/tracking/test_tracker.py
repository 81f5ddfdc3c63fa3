"""The tracker on scenes with exact poses: accuracy, determinism, loss and recovery."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sf_bringup.evaluation import trajectory_error
from sf_interfaces.errors import FormatError
from sf_interfaces.geometry import se3
from sf_interfaces.types import Frame, Scale, SparseDepth, Trajectory
from sf_tracking.config import TrackingConfig
from sf_tracking.core.patches import extract, measure, to_gray
from sf_tracking.core.tracker import Tracker, TrackingState
from tests.tracking.box_room import CAMERA, BoxRoom, barred, path

CONFIG = TrackingConfig(window=5)


def sequence(kind: str, count: int = 45, seed: int = 3) -> tuple[list[Frame], Trajectory]:
    room, poses = BoxRoom(seed), path(count)
    frames = [room.frame(i, T, kind) for i, T in enumerate(poses)]
    return frames, Trajectory(np.array([f.stamp_ns for f in frames]), poses)


@pytest.mark.parametrize("kind", ["sparse", "dense"])
def test_a_walk_is_tracked_to_millimetres(kind: str) -> None:
    frames, truth = sequence(kind)
    tracker = Tracker(CONFIG)
    assert all(tracker.track(f).T_map_camera is not None for f in frames)
    tracker.finish()
    error = trajectory_error(tracker.trajectory(), truth)
    assert error.pairs == len(frames)
    assert error.rmse < 0.01 and error.path_length > 1.0  # m


def test_keyframes_become_final_once_in_order_and_all_of_them() -> None:
    frames, _ = sequence("sparse")
    tracker = Tracker(CONFIG)
    final = [k for f in frames for k in tracker.track(f).keyframes]
    early = len(final)
    final += tracker.finish().keyframes
    stamps = [k.stamp_ns for k in final]
    assert 0 < early < len(final)
    assert stamps == sorted(set(stamps)) and stamps[0] == frames[0].stamp_ns
    final_pose = dict(zip(tracker.trajectory().stamps_ns.tolist(), tracker.trajectory().poses, strict=True))
    for keyframe in final:
        np.testing.assert_array_equal(keyframe.T_map_camera, final_pose[keyframe.stamp_ns])
        assert keyframe.depth is not None and keyframe.landmarks is not None


def test_the_same_frames_give_the_same_bytes() -> None:
    def run() -> bytes:
        tracker = Tracker(CONFIG)
        for frame in sequence("sparse", 25)[0]:
            tracker.track(frame)
        tracker.finish()
        return tracker.trajectory().poses.tobytes()

    assert run() == run()


def test_changes_of_exposure_do_not_read_as_motion() -> None:
    room, poses = BoxRoom(5), path(25)
    gains = 1.0 - 0.35 * np.abs(np.sin(np.arange(25) / 3.0))
    frames = [room.frame(i, T, "sparse", float(g)) for i, (T, g) in enumerate(zip(poses, gains, strict=True))]
    tracker = Tracker(CONFIG)
    for frame in frames:
        tracker.track(frame)
    tracker.finish()
    truth = Trajectory(np.array([f.stamp_ns for f in frames]), poses)
    assert trajectory_error(tracker.trajectory(), truth).rmse < 0.015


def test_black_images_are_lost_and_the_known_place_is_found_again() -> None:
    frames, truth = sequence("sparse", 30)
    black = [replace(f, image=np.zeros_like(f.image), sparse_depth=None) for f in frames[18:21]]
    tracker = Tracker(CONFIG)
    states = [tracker.track(f).state for f in (*frames[:18], *black, *frames[21:])]
    assert states[17] is TrackingState.TRACKING
    assert states[18:21] == [TrackingState.LOST] * 3
    assert states[-1] is TrackingState.TRACKING
    tracker.finish()
    assert len(tracker.trajectory()) == len(frames) - states.count(TrackingState.LOST)
    assert trajectory_error(tracker.trajectory(), truth).rmse < 0.02


def test_frames_without_depth_are_tracked_against_what_is_known() -> None:
    room, poses = BoxRoom(3), path(20)
    frames = [room.frame(i, T, "none" if i % 3 else "sparse") for i, T in enumerate(poses)]
    tracker = Tracker(CONFIG)
    assert all(tracker.track(f).T_map_camera is not None for f in frames)
    tracker.finish()
    truth = Trajectory(np.array([f.stamp_ns for f in frames]), poses)
    assert trajectory_error(tracker.trajectory(), truth).rmse < 0.015


@pytest.mark.parametrize("missing", [(), (5, 9, 10, 11, 16)])
def test_a_rosette_scanner_is_tracked_and_keeps_its_scale_where_sweeps_are_missing(missing: tuple[int, ...]) -> None:
    room, poses = BoxRoom(3), path(20)
    tracker = Tracker(CONFIG)
    for i, T in enumerate(poses):
        frame = room.frame(i, T, "none" if i in missing else "rosette")
        update = tracker.track(frame)
        assert update.T_map_camera is not None and update.scale is Scale.METRIC
    tracker.finish()
    truth = Trajectory(tracker.trajectory().stamps_ns, poses)
    assert trajectory_error(tracker.trajectory(), truth).rmse < 0.005  # m, without alignment of scale


def test_the_dense_stroke_of_a_scanner_does_not_tilt_the_surface() -> None:
    """Points a tenth of a pixel apart on lines six pixels apart: the nearest ones of a place lie on one line."""
    rng = np.random.default_rng(0)
    u, v = np.meshgrid(np.arange(5.0, 315.0, 0.1), np.arange(5.0, 235.0, 6.0))
    uv = np.stack([u.ravel(), v.ravel()], axis=-1)
    scan = SparseDepth(uv, 3.0 + rng.normal(0, 0.015, len(uv)))
    frame = Frame(0, CAMERA, np.zeros((240, 320), np.uint8), sparse_depth=scan)
    found = measure(frame, rng.uniform(30, 200, (50, 2)), TrackingConfig())
    assert (np.abs(found.slope).max(axis=1) < 0.02 * found.w).all()  # of the inverse depth, per px
    np.testing.assert_allclose(found.w, 1 / 3, rtol=0.02)


def test_bars_that_repeat_do_not_pull_a_turn_to_another_bar() -> None:
    """Sparse depth on weak texture; the turn of the first frame is most of the distance between two bars."""
    room, turn = BoxRoom(1, barred(1)), np.array([0.05, 0.0, 0.03, 0.0, 0.1, 0.0])
    tracker = Tracker(TrackingConfig())
    for i in range(6):
        truth = se3.exp(i * turn)
        found = tracker.track(room.frame(i, truth)).T_map_camera
        assert found is not None, f"lost at frame {i}"
        np.testing.assert_allclose(found[:3, 3], truth[:3, 3], atol=0.01)


def test_a_large_first_motion_is_survived() -> None:
    room = BoxRoom(7)
    jump = se3.exp(np.array([0.25, 0.0, 0.1, 0.0, 0.06, 0.0]))  # about 40 px on a 320 px image
    tracker = Tracker(CONFIG)
    tracker.track(room.frame(0, np.eye(4)))
    found = tracker.track(room.frame(1, jump)).T_map_camera
    assert found is not None
    np.testing.assert_allclose(found[:3, 3], jump[:3, 3], atol=0.01)


def test_bad_frames_are_refused_in_a_sentence() -> None:
    room, tracker = BoxRoom(), Tracker(CONFIG)
    frame = room.frame(5, np.eye(4))
    tracker.track(frame)
    with pytest.raises(FormatError, match="does not increase"):
        tracker.track(frame)
    with pytest.raises(FormatError, match="image and its camera_info"):
        tracker.track(Frame(frame.stamp_ns + 1, None))


def test_patches_are_spread_measured_and_away_from_steps_in_depth() -> None:
    room = BoxRoom(1)
    frame = room.frame(0, se3.exp(np.array([0, 0, 0, 0, 0.5, 0])), "dense")
    z = np.array(frame.depth.z)
    z[:, 200:] += 1.0  # an artificial step
    stepped = replace(frame, depth=replace(frame.depth, z=z))
    uv, found = extract(stepped, to_gray(frame.image), TrackingConfig(patches=100))
    assert 50 < len(uv) <= 100
    col, row = np.floor(uv).astype(int).T
    np.testing.assert_allclose(1 / found.w, z[row, col], rtol=0.01)  # a plane bridges the creases of the room
    assert np.median(np.abs(1 / found.w - z[row, col])) < 1e-4
    assert (np.abs(col - 199.5) > 3).all()
    quadrants = {(c > CAMERA.width // 2, r > CAMERA.height // 2) for c, r in zip(col, row, strict=True)}
    assert len(quadrants) == 4
    # Where a plane is seen, its inverse depth is linear in the image: one pixel further it is what slope says.
    ahead = 1 / z[row, col + 1] - found.w
    np.testing.assert_allclose(np.median(np.abs(ahead - found.slope[:, 0])), 0.0, atol=1e-5)


def test_invalid_depth_never_becomes_a_measurement() -> None:
    frame = BoxRoom(1).frame(0, np.eye(4), "dense")
    z = np.array(frame.depth.z)
    z[:120] = np.nan
    uv, found = extract(replace(frame, depth=replace(frame.depth, z=z)), to_gray(frame.image), TrackingConfig())
    assert np.isnan(found.w[uv[:, 1] < 110]).all()
    assert np.isfinite(found.w[uv[:, 1] > 130]).all()
