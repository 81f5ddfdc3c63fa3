"""What goes wrong in practice: light, gaps, moving objects, bare walls, still cameras, memory."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from sf_bringup.evaluation import trajectory_error
from sf_interfaces.errors import FormatError
from sf_interfaces.geometry import se3
from sf_interfaces.types import DepthMap, Frame, Trajectory
from sf_tracking.config import TrackingConfig
from sf_tracking.core.session import TrackingSession
from sf_tracking.core.tracker import Tracker, TrackingState
from tests.tracking.box_room import STEP_NS, BoxRoom, circle, path

CONFIG = TrackingConfig(patches=150, window=6)


def error_of(tracker: Tracker, frames: list[Frame], poses: np.ndarray) -> float:
    """ATE in m."""
    return trajectory_error(tracker.trajectory(), Trajectory(np.array([f.stamp_ns for f in frames]), poses)).rmse


def test_a_still_camera_makes_no_keyframes_and_does_not_drift() -> None:
    room, rng = BoxRoom(2), np.random.default_rng(0)
    still = room.frame(0, np.eye(4), "dense")
    tracker = Tracker(CONFIG)
    for i in range(25):
        noise = rng.normal(0, 2.0, still.image.shape)
        image = np.clip(still.image + noise, 0, 255).astype(np.uint8)
        update = tracker.track(replace(still, stamp_ns=still.stamp_ns + i * 33_000_000, image=image))
    assert np.abs(update.T_map_camera[:3, 3]).max() < 0.002  # m
    assert len(tracker.finish().keyframes) == 1


@pytest.mark.parametrize("window", [3, 9])
def test_a_walk_there_and_back_for_long_makes_the_keyframes_of_one(window: int) -> None:
    """Every third frame lacks its depth; the window holds a part of the walk, or all of it."""
    room, poses, count = BoxRoom(4), path(24, 0.06), 150
    turns = np.abs((np.arange(count) + 23) % 46 - 23)
    frames = [room.frame(k, T, "dense") for k, T in enumerate(poses)]
    session, made, given = TrackingSession(replace(CONFIG, patches=100, window=window)), [], []
    for i, k in enumerate(turns):
        depth = None if i % 3 == 2 else frames[k].depth
        given.append(replace(frames[k], stamp_ns=10**9 + i * STEP_NS, depth=depth))
        made += [(i, keyframe) for keyframe in session.track(given[-1]).keyframes]
    made += [(count, keyframe) for keyframe in session.finish().keyframes]
    once = [keyframe for i, keyframe in made if i < 48]
    assert len(made) <= max(len(once), 6) + 6
    assert all(keyframe.depth is not None for _, keyframe in made)
    found, truth = session.trajectory(), Trajectory(np.array([f.stamp_ns for f in given]), poses[turns])
    assert len(found) == count and trajectory_error(found, truth).rmse < 0.003


def test_a_full_turn_on_the_spot_comes_back_to_its_start() -> None:
    room, poses = BoxRoom(8), circle(61, 60, 0.0)
    frames = [room.frame(i, T, "dense") for i, T in enumerate(poses)]
    tracker = Tracker(CONFIG)
    updates = [tracker.track(f) for f in frames]
    assert all(u.state is TrackingState.TRACKING for u in updates)
    assert np.abs(updates[-1].T_map_camera[:3, 3]).max() < 0.01 and error_of(tracker, frames, poses) < 0.005


def test_half_the_brightness_from_one_frame_to_the_next_is_no_loss() -> None:
    room, poses = BoxRoom(5), path(24)
    frames = [room.frame(i, T, "dense", 1.0 if i < 12 else 0.5) for i, T in enumerate(poses)]
    tracker = Tracker(CONFIG)
    assert all(tracker.track(f).state is TrackingState.TRACKING for f in frames)
    assert error_of(tracker, frames, poses) < 0.005


def test_ten_dropped_frames_are_bridged() -> None:
    room, poses = BoxRoom(6), path(36)
    kept = [i for i in range(36) if not 14 <= i < 24]
    frames = [room.frame(i, poses[i], "dense") for i in kept]
    tracker = Tracker(CONFIG)
    assert all(tracker.track(f).state is TrackingState.TRACKING for f in frames)
    assert error_of(tracker, frames, poses[kept]) < 0.005


def test_frames_out_of_order_are_refused_and_do_no_harm() -> None:
    room, poses = BoxRoom(6), path(12)
    frames = [room.frame(i, T, "dense") for i, T in enumerate(poses)]
    tracker = Tracker(CONFIG)
    for i, frame in enumerate(frames):
        tracker.track(frame)
        if i == 6:
            with pytest.raises(FormatError, match="does not increase"):
                tracker.track(frames[3])
    assert len(tracker.trajectory()) == 12 and error_of(tracker, frames, poses) < 0.005


def test_an_object_that_covers_half_the_image_and_moves_is_not_followed() -> None:
    room, poses = BoxRoom(3), path(26)
    card = cv2.resize(
        np.random.default_rng(9).integers(40, 215, (24, 16), dtype=np.uint8), (160, 240), interpolation=cv2.INTER_CUBIC
    )
    frames = []
    for i, T in enumerate(poses):
        frame = room.frame(i, T, "dense")
        left = 320 - 8 * max(0, i - 6)  # px, it comes in from the right and goes on to the left
        if left < 320:
            image, z = np.array(frame.image), np.array(frame.depth.z)
            start, stop = max(left, 0), min(left + 160, 320)
            image[:, start:stop] = card[:, start - left : stop - left, None]
            z[:, start:stop] = 1.0
            frame = replace(frame, image=image, depth=DepthMap(z))
        frames.append(frame)
    tracker = Tracker(CONFIG)
    assert all(tracker.track(f).state is TrackingState.TRACKING for f in frames)
    keyframes = tracker.finish().keyframes
    assert error_of(tracker, frames, poses) < 0.02 and len(keyframes) < len(frames) / 2


def test_bare_walls_are_tracked_by_their_depth() -> None:
    """Frames 8 to 15 show no texture at all; three walls in view still fix the pose."""
    room = BoxRoom(3)
    corner = se3.exp(np.array([0.5, 0.3, 0.3, 0, 0, 0])) @ se3.exp(np.array([0, 0, 0, 0.45, 0.75, 0]))
    poses = np.array([corner @ T for T in path(24)])
    frames = [room.frame(i, T, "dense") for i, T in enumerate(poses)]
    bare = [replace(f, image=np.full_like(f.image, 128)) if 8 <= i < 16 else f for i, f in enumerate(frames)]
    tracker = Tracker(CONFIG)
    assert all(tracker.track(f).state is TrackingState.TRACKING for f in bare)
    tracker.finish()
    assert len(tracker.trajectory()) == 24 and error_of(tracker, frames, poses) < 0.01


def test_fast_rotation_is_followed() -> None:
    room = BoxRoom(8)
    poses = np.array([se3.exp(np.array([0.01 * i, 0, 0, 0, 0.12 * (i % 2), 0])) for i in range(8)])  # 31 px a frame
    frames = [room.frame(i, T, "dense") for i, T in enumerate(poses)]
    tracker = Tracker(CONFIG)
    assert all(tracker.track(f).state is TrackingState.TRACKING for f in frames)
    assert error_of(tracker, frames, poses) < 0.005


def test_a_grey_image_is_an_image() -> None:
    room, poses = BoxRoom(3), path(10)
    frames = [room.frame(i, T, "dense") for i, T in enumerate(poses)]
    gray = [replace(f, image=np.ascontiguousarray(f.image[..., 0])) for f in frames]
    tracker = Tracker(CONFIG)
    assert all(tracker.track(f).state is TrackingState.TRACKING for f in gray)
    assert error_of(tracker, gray, poses) < 0.005


def test_images_are_kept_for_keyframes_in_the_window_only() -> None:
    room, poses = BoxRoom(3), path(40, 0.05)
    tracker = Tracker(replace(CONFIG, window=3))
    for i, T in enumerate(poses):
        tracker.track(room.frame(i, T, "dense"))
        assert len(tracker._window) <= 4  # one of them on its way out
    assert all(isinstance(T, np.ndarray) and T.nbytes == 128 for T in tracker._final.values())
    assert {len(k.seen) <= 3 for k in tracker._window.keyframes} == {True}
