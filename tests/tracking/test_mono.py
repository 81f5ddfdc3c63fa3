"""Without depth: the map begins with parallax, keeps an arbitrary scale, and says so."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace

import numpy as np

from sf_bringup.evaluation import trajectory_error
from sf_interfaces.geometry import se3
from sf_interfaces.types import Frame, Scale, Trajectory
from sf_tracking.config import TrackingConfig
from sf_tracking.core.initialise import two_views
from sf_tracking.core.tracker import Tracker, TrackingState
from tests.tracking.box_room import CAMERA, BoxRoom, path

CONFIG = TrackingConfig(patches=150, window=6)


def truth_of(frames: list[Frame], poses: np.ndarray) -> Trajectory:
    return Trajectory(np.array([f.stamp_ns for f in frames]), poses)


def test_a_walk_without_depth_is_tracked_to_millimetres_up_to_scale() -> None:
    room, poses = BoxRoom(3), path(40)
    frames = [room.frame(i, T, "none") for i, T in enumerate(poses)]
    tracker = Tracker(CONFIG)
    updates = [tracker.track(f) for f in frames]
    keyframes = [k for u in (*updates, tracker.finish()) for k in u.keyframes]
    assert updates[0].state is TrackingState.INITIALISING and updates[-1].state is TrackingState.TRACKING
    assert updates[-1].scale is Scale.ARBITRARY and tracker.trajectory().scale is Scale.ARBITRARY
    assert all(k.scale is Scale.ARBITRARY and k.depth is None for k in keyframes)
    error = trajectory_error(tracker.trajectory(), truth_of(frames, poses))
    assert error.pairs >= len(frames) - 2  # frames before the map began get their pose afterwards
    assert error.rmse < 0.006  # m
    for keyframe in keyframes[1:-2]:
        assert keyframe.landmarks is not None and len(keyframe.landmarks) > 40
        uv, z = CAMERA.project(keyframe.landmarks.points.astype(np.float64))
        col, row = np.floor(uv).astype(int).T
        index = next(i for i, f in enumerate(frames) if f.stamp_ns == keyframe.stamp_ns)
        ratio = z * error.scale / room.view(poses[index])[1][row, col]
        assert abs(np.median(ratio) - 1) < 0.02 and np.percentile(np.abs(ratio - 1), 80) < 0.06


def test_pure_rotation_begins_no_map_but_is_survived_by_one() -> None:
    room = BoxRoom(4)
    turning = [se3.exp(np.array([0, 0, 0, 0, 0.02 * i, 0])) for i in range(10)]
    tracker = Tracker(CONFIG)
    states = [tracker.track(room.frame(i, T, "none")).state for i, T in enumerate(turning)]
    assert set(states) == {TrackingState.INITIALISING}

    walk = list(path(25))
    turn = [walk[-1] @ se3.exp(np.array([0, 0, 0, 0, -0.025 * (i + 1), 0])) for i in range(16)]
    poses = np.array(walk + turn)
    frames = [room.frame(i, T, "none") for i, T in enumerate(poses)]
    tracker = Tracker(CONFIG)
    updates = [tracker.track(f) for f in frames]
    assert all(u.state is TrackingState.TRACKING for u in updates[15:])
    tracker.finish()
    assert trajectory_error(tracker.trajectory(), truth_of(frames, poses)).rmse < 0.02


def test_a_still_camera_without_depth_waits() -> None:
    room, tracker = BoxRoom(1), Tracker(CONFIG)
    updates = [tracker.track(room.frame(i, np.eye(4), "none")) for i in range(6)]
    assert all(u.state is TrackingState.INITIALISING and u.T_map_camera is None for u in updates)
    assert tracker.finish().keyframes == () and len(tracker.trajectory()) == 0


def test_a_metric_map_stays_metric_through_frames_without_depth() -> None:
    room, poses = BoxRoom(3), path(36)
    frames = [room.frame(i, T, "dense" if i < 6 else "none") for i, T in enumerate(poses)]
    tracker = Tracker(CONFIG)
    updates = [tracker.track(f) for f in frames]
    assert all(u.scale is Scale.METRIC and u.T_map_camera is not None for u in updates)
    keyframes = [k for u in (*updates, tracker.finish()) for k in u.keyframes]
    assert sum(k.depth is None for k in keyframes) >= 2
    error = trajectory_error(tracker.trajectory(), truth_of(frames, poses))
    assert error.rmse < 0.01 and error.path_length > 0.9  # m, aligned without scale


def test_a_plane_in_view_determines_the_motion_or_waits() -> None:
    rng = np.random.default_rng(0)
    uv0 = rng.uniform((20, 20), (300, 220), (120, 2))
    rays = CAMERA.unproject(uv0, np.ones(120))
    normal = np.array([0.3, 0.1, 1.0])
    points = rays * (3.0 / (rays @ normal))[:, None]
    for step in (0.02, 0.2, 0.5):
        T = se3.exp(np.array([step, 0.1 * step, 0.2 * step, 0.02, -0.05, 0.01]))
        uv1 = CAMERA.project(se3.transform(T, points))[0] + rng.normal(0, 0.1, uv0.shape)
        found = two_views(CAMERA, uv0, uv1, np.ones(120, bool), replace(CONFIG))
        if found is not None:
            direction = T[:3, 3] / np.linalg.norm(T[:3, 3])
            assert found.T[:3, 3] @ direction > 0.98
            np.testing.assert_allclose(found.T[:3, :3], T[:3, :3], atol=0.02)
