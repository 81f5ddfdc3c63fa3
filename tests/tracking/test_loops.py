"""Loops: a known place corrects the map, a place that only looks alike does not."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from sf_interfaces.geometry import se3
from sf_interfaces.types import DepthMap, Keyframe, PointCloud, Scale
from sf_tracking.config import TrackingConfig
from sf_tracking.core import sim3
from sf_tracking.core.keyframe_map import KeyframeMap
from sf_tracking.core.places import Index, features
from tests.tracking.box_room import CAMERA, STEP_NS, BoxRoom, circle

LAP, AGAIN = 36, 8


def turn(count: int) -> np.ndarray:
    """A walk once round in ``LAP`` keyframes."""
    return circle(count, LAP, 0.8)


@lru_cache
def views(alike: bool = False) -> list[tuple[np.ndarray, np.ndarray]]:
    """Image and depth of each keyframe; ``alike``: all four walls show the same."""
    room = BoxRoom(3)
    if alike:
        room._textures[[1, 4, 5]] = room._textures[0]
    return [room.view(T) for T in turn(LAP + AGAIN)]


def drifted(drift: float, scale: float = 1.0) -> np.ndarray:
    """Poses whose every step errs by ``drift`` m sideways and up and by a change of unit."""
    truth = turn(LAP + AGAIN)
    S = [np.eye(4)]
    for step in se3.inverse(truth[:-1]) @ truth[1:]:
        S.append(S[-1] @ sim3.similarity(se3.exp(np.array([drift, drift, 0, 0, 0, 0])) @ step, scale))
    return np.array(S)


def keyframes(S: np.ndarray, alike: bool = False, mono: bool = False) -> list[Keyframe]:
    """Keyframes whose poses and landmarks are as a tracker that drifts would give them."""
    out, rng = [], np.random.default_rng(0)
    for k, ((image, z), s) in enumerate(zip(views(alike), S, strict=True)):
        corners = features(image).uv if not mono else np.unique(np.floor(features(image).uv), axis=0) + 0.5
        corners = corners[rng.permutation(len(corners))[:250]]
        column, row = np.floor(corners).astype(int).T
        points = CAMERA.unproject(corners, z[row, column] * sim3.scale_of(s)).astype(np.float32)
        depth, scale = (None, Scale.ARBITRARY) if mono else (DepthMap(z), Scale.METRIC)
        # The map's unit is that of the first keyframe, so a pose says where the tracker believes to be.
        out.append(Keyframe(k * STEP_NS, CAMERA, image, sim3.rigid(s), depth, PointCloud(points), scale))
    return out


def walk(keyframe_map: KeyframeMap, given: list[Keyframe]) -> list[int]:
    """Add keyframes as a session does: what comes after a correction starts from it. Lengths of the map at closures."""
    start, closed = np.eye(4), []
    for keyframe in given:
        S, cloud = start @ keyframe.T_map_camera, keyframe.landmarks
        assert cloud is not None
        cloud = PointCloud(cloud.points * np.float32(sim3.scale_of(S)))
        keyframe_map.add(replace(keyframe, T_map_camera=sim3.rigid(S), landmarks=cloud))
        if (motion := keyframe_map.correct()) is not None:
            start = motion[-1] @ start
            closed.append(len(keyframe_map))
    keyframe_map.complete()
    return closed + [len(keyframe_map)] * (keyframe_map.correct() is not None)


def true_loops(keyframe_map: KeyframeMap) -> bool:
    """Every loop ties views of the same part of the room."""
    turns = [(j - i) % LAP for i, j, _, _, loop in keyframe_map.edges if loop]
    return len(turns) > 0 and all(min(k, LAP - k) <= 3 for k in turns)


def errors(S: np.ndarray) -> np.ndarray:
    return np.linalg.norm(S[:, :3, 3] - turn(LAP + AGAIN)[:, :3, 3], axis=1)


def gap(S: np.ndarray) -> float:
    """Mean distance, m, between the second visit of a place and the first."""
    return float(np.linalg.norm(S[LAP:, :3, 3] - S[:AGAIN, :3, 3], axis=1).mean())


def test_a_known_place_takes_back_the_drift() -> None:
    S, found = drifted(0.004), KeyframeMap()
    assert errors(S)[-1] > 0.15
    assert walk(found, keyframes(S)) and true_loops(found)
    assert gap(S) > 0.12 and gap(found.S) < 0.015
    assert errors(found.S).max() < 0.6 * errors(S).max()
    np.testing.assert_allclose(sim3.scale_of(found.S), 1.0, atol=1e-9)


def test_without_drift_a_loop_tells_nothing_and_changes_nothing() -> None:
    found = KeyframeMap()
    assert not walk(found, keyframes(turn(LAP + AGAIN)))
    np.testing.assert_array_equal(found.S, turn(LAP + AGAIN))


def test_a_unit_that_drifts_is_taken_back_too() -> None:
    S, found = drifted(0.0, 0.995), KeyframeMap()  # 20 % over the way
    found.scale = Scale.ARBITRARY
    closed = walk(found, keyframes(S, mono=True))
    assert closed and true_loops(found)
    units = sim3.scale_of(found.S)
    assert units[LAP // 2] > 1.04, "half-way the unit had shrunk"
    np.testing.assert_allclose(units[closed[0] - 1 :], 1.0, atol=0.05, err_msg="what came after has the map's unit")
    assert gap(S) > 0.07 and gap(found.S) < 0.03
    around = np.linalg.norm(np.diff(found.S[LAP - 2 : LAP + 4, :3, 3], axis=0), axis=1)
    true = np.linalg.norm(np.diff(turn(LAP + AGAIN)[LAP - 2 : LAP + 4, :3, 3], axis=0), axis=1)
    np.testing.assert_allclose(around.sum(), true.sum(), rtol=0.1)


def test_walls_that_all_look_alike_close_only_the_true_loop() -> None:
    found = KeyframeMap()
    closed = walk(found, keyframes(drifted(0.004), alike=True))
    assert not closed or (closed[0] > LAP - 3 and true_loops(found))


def test_a_known_view_is_known_and_a_keyframe_that_is_dropped_leaves_no_trace() -> None:
    found, given = KeyframeMap(), keyframes(turn(LAP + AGAIN))
    walk(found, given[:LAP])
    words, edges = found._index._holders.copy(), len(found.edges)
    second = given[LAP]  # where the first one was
    assert found.knows(second, TrackingConfig())
    assert not found.knows(
        replace(second, T_map_camera=turn(1)[0] @ se3.exp(np.r_[0.5, np.zeros(5)])), TrackingConfig()
    )
    stamps = [second.stamp_ns + round(s * 1e9) for s in (55, 65, 120, 135)]
    assert [found.knows(replace(second, stamp_ns=t), TrackingConfig()) for t in stamps] == [True, False, False, False]
    found.add(second)
    assert not found.told
    found.drop()
    assert len(found) == len(found.places) == LAP and len(found.edges) == edges
    np.testing.assert_array_equal(found._index._holders, words)
    found.add(given[LAP + 1])
    i, j, Z, sigma, loop = found.edges[-1]
    assert (i, j, loop) == (LAP - 1, LAP, False) and found._walked[-1] > found._walked[-2] + 0.2
    np.testing.assert_allclose(Z, se3.inverse(turn(LAP)[-1]) @ turn(LAP + 2)[-1], atol=1e-9)
    assert sigma[0] > 1.3 * found.edges[-2][3][0], "two steps err more than one"


def test_loops_can_be_switched_off() -> None:
    assert not walk(KeyframeMap(loops=False), keyframes(drifted(0.004)))


def test_the_index_finds_what_shares_descriptors() -> None:
    rng, index = np.random.default_rng(0), Index()
    known = [rng.integers(0, 256, (300, 32), dtype=np.uint8) for _ in range(50)]
    for descriptors in [*known, np.zeros((0, 32), np.uint8)]:
        index.add(descriptors)
    noisy = np.packbits(np.unpackbits(known[17], axis=1) ^ (rng.random((300, 256)) < 0.1), axis=1)
    scores = index.scores(noisy)
    assert np.argmax(scores) == 17 and scores[17] > 3 * np.sort(scores)[-2] and scores[50] == 0
    assert len(Index().scores(noisy)) == 0


def test_a_place_that_is_seen_again_and_again_makes_keyframes_ever_more_seldom() -> None:
    found, given, made = KeyframeMap(), keyframes(turn(LAP + AGAIN)), []
    walk(found, given[:LAP])
    for second in range(5, 2000, 5):
        again = replace(given[LAP], stamp_ns=second * 10**9)
        if not found.knows(again, TrackingConfig()):
            found.add(again)
            made.append(second)
    assert made == [65, 135, 275, 555, 1115]
