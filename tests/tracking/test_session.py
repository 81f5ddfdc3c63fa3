"""A session outlives its trackers: one map over a changed calibration and over the death of the process."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sf_bringup.simulate import SimulationSpec, Simulator
from sf_interfaces.errors import FormatError
from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera, DepthMap, Frame
from sf_tracking.config import TrackingConfig
from sf_tracking.core.places import features, place_of_frame
from sf_tracking.core.recognise import sight
from sf_tracking.core.session import TrackingSession
from sf_tracking.core.tracker import Tracker, TrackingState

COUNT, CUT = 18, 10
CONFIG = TrackingConfig()


@pytest.fixture(scope="module")
def walk() -> tuple[list[Frame], list[np.ndarray]]:
    """Frames of a slow walk and their true poses in the first camera."""
    size = {"width": 320, "height": 240, "focal": 240.0, "supersampling": 1}
    simulator = Simulator(SimulationSpec("lounge", frames=COUNT, fps=20.0, depth="exact", **size))
    frames, poses = [], []
    for i in range(COUNT):
        image, z, T = simulator.frame(i)
        frames.append(Frame((i + 1) * 50_000_000, simulator.spec.camera, image, DepthMap(z)))
        poses.append(T)
    return frames, [se3.inverse(poses[0]) @ T for T in poses]


def error(T: np.ndarray | None, truth: np.ndarray) -> float:
    assert T is not None
    return float(np.linalg.norm(T[:3, 3] - truth[:3, 3]))


def test_without_incidents_a_session_is_its_tracker(walk: tuple[list[Frame], list[np.ndarray]]) -> None:
    session, tracker = TrackingSession(CONFIG), Tracker(CONFIG)
    for frame in walk[0][:6]:
        mine, its = session.track(frame), tracker.track(frame)
        np.testing.assert_array_equal(mine.T_map_camera, its.T_map_camera)
    assert len(session.finish().keyframes) == len(tracker.finish().keyframes)
    np.testing.assert_array_equal(session.trajectory().poses, tracker.trajectory().poses)


def test_a_restored_session_finds_its_place_and_keeps_the_trajectory(
    walk: tuple[list[Frame], list[np.ndarray]], tmp_path: Path
) -> None:
    frames, truth = walk
    first = TrackingSession(CONFIG)
    for frame in frames[:CUT]:
        first.track(frame)
    first.save(tmp_path / "state" / "tracking.npz")
    second = TrackingSession.restore(CONFIG, tmp_path / "state" / "tracking.npz")
    for frame, T in zip(frames[CUT + 2 :], truth[CUT + 2 :], strict=True):
        update = second.track(frame)
        assert update.state is TrackingState.TRACKING
        assert error(update.T_map_camera, T) < 0.08
    second.finish()
    assert len(second.trajectory()) == COUNT - 2
    assert set(first.keyframe_trajectory().stamps_ns) <= set(second.keyframe_trajectory().stamps_ns)


def test_a_restored_session_knows_what_it_has_seen(walk: tuple[list[Frame], list[np.ndarray]], tmp_path: Path) -> None:
    """It finds its place to millimetres, so that what it sees again is known and makes no keyframes."""
    config = TrackingConfig(window=3, keyframe_flow=0.004)
    first = TrackingSession(config)
    for frame in walk[0]:
        first.track(frame)
    first.save(tmp_path / "tracking.npz")
    second = TrackingSession.restore(config, tmp_path / "tracking.npz")
    known = len(second.keyframe_trajectory())
    published = 0
    for k in range(40):  # back and forth where the keyframes are final
        i = [*range(6, 0, -1), *range(6)][k % 12]
        update = second.track(replace(walk[0][i], stamp_ns=walk[0][-1].stamp_ns + (k + 1) * 50_000_000))
        published += len(update.keyframes)
        assert k < 3 or error(update.T_map_camera, walk[1][i]) < 0.01
    assert known >= 4 and published <= 2


def test_a_view_of_another_place_is_not_joined_to_the_map(
    walk: tuple[list[Frame], list[np.ndarray]], tmp_path: Path
) -> None:
    session = TrackingSession(CONFIG)
    for frame in walk[0][:CUT]:
        session.track(frame)
    session.save(tmp_path / "s.npz")
    elsewhere = np.random.default_rng(0).integers(0, 256, (240, 320, 3), dtype=np.uint8)
    restored = TrackingSession.restore(CONFIG, tmp_path / "s.npz")
    update = restored.track(replace(walk[0][CUT], image=elsewhere))
    assert update.T_map_camera is None and update.state is TrackingState.LOST
    assert restored.track(walk[0][CUT + 1]).T_map_camera is not None, "the map is searched again with every frame"


def test_a_changed_calibration_goes_on_in_the_same_map(walk: tuple[list[Frame], list[np.ndarray]]) -> None:
    frames, truth = walk
    half = Camera(160, 120, 120.0, 120.0, 80.0, 60.0)
    small = [
        replace(f, camera=half, image=f.image[::2, ::2], depth=DepthMap(f.depth.z[::2, ::2]))  # type: ignore[index, union-attr]
        for f in frames[CUT:]
    ]
    session = TrackingSession(CONFIG)
    kept = sum(len(session.track(frame).keyframes) for frame in frames[:CUT])
    updates = [session.track(frame) for frame in small]
    assert error(updates[0].T_map_camera, truth[CUT]) < 0.15
    assert updates[0].keyframes, "what the old calibration saw is final now"
    kept += sum(len(update.keyframes) for update in updates) + len(session.finish().keyframes)
    assert kept == len(session.keyframe_trajectory())
    assert len(session.trajectory()) > CUT


def test_a_view_needs_depth_and_finds_its_own_image(walk: tuple[list[Frame], list[np.ndarray]]) -> None:
    frame = walk[0][3]
    assert frame.image is not None and frame.camera is not None
    assert place_of_frame(replace(frame, depth=None)) is None
    seen = place_of_frame(frame)
    assert seen is not None
    found = sight([seen], np.eye(4)[None], features(frame.image), frame.camera)
    assert found is not None and np.abs(found.T - np.eye(4)).max() < 0.02


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 damaged", b"{}"])
def test_a_damaged_snapshot_is_refused_with_a_sentence(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "s.npz").write_bytes(content)
    with pytest.raises(FormatError, match="start anew"):
        TrackingSession.restore(CONFIG, tmp_path / "s.npz")
