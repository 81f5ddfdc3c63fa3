"""A whole session: drift that a loop takes back, and a lost camera that finds its way home."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sf_interfaces.types import Frame, Scale
from sf_tracking.config import TrackingConfig
from sf_tracking.core.session import TrackingSession
from sf_tracking.core.tracker import TrackingState
from tests.tracking.box_room import BoxRoom, circle, warming_up

CONFIG = TrackingConfig(patches=120, window=5)
LAP, RADIUS = 72, 1.2  # frames, m


def frames(poses: np.ndarray, kind: str = "dense") -> list[Frame]:
    room = BoxRoom(3)
    return [room.frame(i, T, kind) for i, T in enumerate(poses)]


def black(after: Frame, count: int) -> list[Frame]:
    image = np.zeros_like(after.image)
    return [Frame(after.stamp_ns + 10_000_000 * (k + 1), after.camera, image) for k in range(count)]


def later(frame: Frame, ns: int) -> Frame:
    return replace(frame, stamp_ns=frame.stamp_ns + ns)


def distance(T: np.ndarray | None, truth: np.ndarray) -> float:
    assert T is not None
    return float(np.linalg.norm(T[:3, 3] - truth[:3, 3]))


def test_a_loop_takes_back_what_wrong_depth_made_drift() -> None:
    lap = 48
    given = warming_up(frames(circle(lap + 16, lap, RADIUS)), 12, 36)
    session, plain = TrackingSession(CONFIG), TrackingSession(replace(CONFIG, loops=False))
    jumps, odometry = [], []
    for frame in given:
        update = session.track(frame)
        plain.track(frame)
        odometry.append(update.T_odom_camera)
        if update.correction is not None:
            jumps.append(update)
    session.finish()
    plain.finish()
    gap, plain_gap = (
        np.linalg.norm(t.positions[lap : lap + 14] - t.positions[:14], axis=1).mean()
        for t in (session.trajectory(), plain.trajectory())
    )
    assert plain_gap > 0.05 and gap < 0.25 * plain_gap
    assert jumps, "the loop closes while the camera still moves"
    first = jumps[0]
    assert first.correction is not None and (first.correction.scales == 1.0).all()
    corrected = first.correction.keyframes
    assert corrected.stamps_ns[-1] == first.keyframes[-1].stamp_ns
    np.testing.assert_array_equal(corrected.poses[-1], first.keyframes[-1].T_map_camera)
    steps = np.linalg.norm(np.diff(np.array(odometry)[:, :3, 3], axis=0), axis=1)
    assert steps.max() < 2 * np.median(steps), "in odom nothing jumps"


@pytest.mark.parametrize("kind", ["dense", "none"])
def test_a_lost_camera_goes_on_where_it_knows_a_place(kind: str) -> None:
    poses = circle(50, LAP, RADIUS)
    given = frames(poses, kind)
    session = TrackingSession(CONFIG)
    before = [session.track(frame) for frame in given]
    assert before[-1].state is TrackingState.TRACKING
    dark = black(given[-1], 12)
    assert all(session.track(frame).state is TrackingState.LOST for frame in dark)
    again = [later(frame, given[-1].stamp_ns) for frame in given[6:34]]  # elsewhere: it was there long ago
    after = [session.track(frame) for frame in again]
    found = [k for k, update in enumerate(after) if update.T_map_camera is not None]
    assert found and found[0] <= (3 if kind != "none" else 24)
    assert all(update.T_map_camera is not None for update in after[found[0] :])
    known = dict(zip(session.trajectory().stamps_ns.tolist(), session.trajectory().poses, strict=True))
    size = (
        np.ptp([T[:3, 3] for T in poses], axis=0).max()
        if kind != "none"
        else np.ptp(list(known.values()), axis=0).max()
    )
    for k in found:
        assert distance(after[k].T_map_camera, known[given[6 + k].stamp_ns]) < 0.03 * size
    assert after[-1].scale is (Scale.METRIC if kind != "none" else Scale.ARBITRARY)
    stamps = {keyframe.stamp_ns for update in (*before, *after, session.finish()) for keyframe in update.keyframes}
    new = sum(stamp > dark[-1].stamp_ns for stamp in stamps)
    assert new if kind == "none" else new <= 2, (
        "the map goes on, and with measured depth it is known to be the same place"
    )


def test_on_new_ground_the_map_is_kept_and_what_was_seen_is_placed_later() -> None:
    poses = circle(LAP, LAP, RADIUS)
    given = frames(poses)
    session = TrackingSession(CONFIG)
    for frame in [*given[:30], *black(given[29], 10)]:
        session.track(frame)
    kept = session.keyframe_trajectory().stamps_ns
    away = [session.track(later(frame, 10**9)) for frame in given[48:64]]  # a part of the room never seen
    assert all(update.state is TrackingState.LOST and not update.keyframes for update in away)
    home = [session.track(later(frame, 10**9)) for frame in given[64:]]
    home += [session.track(later(frame, 10**9 + given[-1].stamp_ns)) for frame in given[:12]]
    assert home[-1].T_map_camera is not None and distance(home[-1].T_map_camera, poses[11]) < 0.05
    session.finish()
    trajectory = session.trajectory()
    index = np.searchsorted(trajectory.stamps_ns, given[56].stamp_ns + 10**9)
    assert distance(trajectory.poses[index], poses[56]) < 0.1, "seen while lost"
    assert set(kept) <= set(session.keyframe_trajectory().stamps_ns)


def test_a_restarted_session_knows_places_of_long_ago(tmp_path: Path) -> None:
    poses = circle(50, LAP, RADIUS)
    given = frames(poses)
    session = TrackingSession(CONFIG)
    for frame in given:
        session.track(frame)
    session.save(tmp_path / "s.npz")
    restored = TrackingSession.restore(CONFIG, tmp_path / "s.npz")
    updates = [restored.track(later(frame, given[-1].stamp_ns)) for frame in given[4:12]]
    assert updates[2].T_map_camera is not None and distance(updates[2].T_map_camera, poses[6]) < 0.05
    known = set(session.keyframe_trajectory().stamps_ns)
    assert known <= set(restored.keyframe_trajectory().stamps_ns)
