"""Does depth lie on colour? Known turns, lags and lost images are found; where nothing can be told, that is said."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sf_bringup import cli, doctor_recording
from sf_bringup.doctor import Check
from sf_bringup.doctor_recording import judge, recording_checks
from sf_bringup.recorded_shots import Mounting
from sf_bringup.simulate import SimulationSpec
from sf_interfaces.geometry import se3
from sf_interfaces.geometry.depth_alignment import Alignment
from sf_interfaces.geometry.depth_edges import best_shift, depth_edges, gradients, scores_of_shifts, seen
from sf_interfaces.geometry.edge_views import EdgeViews, Shot
from sf_interfaces.geometry.registration import register_depth
from sf_interfaces.io.datasets.indoor import SevenScenes
from sf_interfaces.io.sequence_writer import SequenceWriter
from sf_interfaces.types import Camera, DepthMap, Float64

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))

import registration

LAG_S, PERIOD_S = 0.020, 0.1
TURN = se3.exp(np.array([0.0, 0.0, 0.0, *np.radians((0.5, -0.9, 0.6))]))
SPEC = SimulationSpec("lounge", width=320, height=240, focal=240.0, fps=1 / PERIOD_S)
COLOR, INFO, DEPTH = "/camera/color/image_raw", "/camera/color/camera_info", "/camera/depth/image_raw"


@pytest.fixture(scope="module")
def rig() -> registration.Rig:
    return registration.Rig(SPEC, LAG_S, every=3 * PERIOD_S)  # so that all images are one sequence


@pytest.fixture(scope="module")
def shots(rig: registration.Rig) -> list[Shot]:
    return list(rig.shots(16))


def found(rig: registration.Rig, shots: Iterable[Shot], claimed: Float64) -> Alignment:
    out = registration.found(shots, rig.depth, rig.color, claimed)
    assert out is not None
    return out


def apart_px(rig: registration.Rig, T: Float64) -> float:
    """How far a pose of the depth camera moves what lies 2 m before it, mean over the image."""
    grid = rig.depth.pixel_grid()[::20, ::20].reshape(-1, 2)
    points = rig.depth.unproject(grid, np.full(len(grid), 2.0))
    uv, true = (rig.color.project(se3.transform(pose, points))[0] for pose in (T, rig.T_color_depth))
    return float(np.linalg.norm(uv - true, axis=1).mean())


def test_edges_are_the_ends_of_near_surfaces_and_found_in_the_image() -> None:
    camera = Camera(160, 120, 150.0, 150.0, 80.0, 60.0)
    z = np.full((120, 160), 3.0, np.float32)
    z[40:90, 50:100] = 1.5
    z[40:90, 44:50] = np.nan  # what a projector to the right does not light
    edges = depth_edges(DepthMap(z), camera)
    uv, axis = seen(edges, camera, np.eye(4))
    assert np.allclose(edges.points[:, 2], 1.5)
    assert set(np.round(uv[axis == 0, 0])) == {50, 100} and set(np.round(uv[axis == 1, 1])) == {40, 90}
    wide = depth_edges(DepthMap(np.kron(z, np.ones((8, 8)))), camera.scaled(8.0))
    assert np.abs(np.sort(np.unique(seen(wide, camera, np.eye(4))[0][:, 0]))[[0, -1]] - (50, 100)).max() < 0.3
    image = np.random.default_rng(0).integers(60, 100, (120, 160)).astype(np.uint8)
    image[44:94, 47:97] += 60
    shift = best_shift(scores_of_shifts(uv, axis, gradients(image), 10))
    assert shift is not None and np.allclose(shift.px, (-3, 4), atol=0.2)


def test_a_known_turn_and_lag_are_found(rig: registration.Rig, shots: list[Shot]) -> None:
    claimed = TURN @ rig.T_color_depth
    a = found(rig, shots, claimed)
    assert a.used >= 14 and a.confirmed and a.jump is None
    assert abs(a.off_px - apart_px(rig, claimed)) < 1.0 and apart_px(rig, claimed) > 3.0
    assert apart_px(rig, a.corrected(claimed)) < 1.0 and a.halves_px < 0.5
    assert a.score < a.score_corrected - 0.1
    assert a.lag_s is not None and abs(a.lag_s - LAG_S) < 0.005


def test_what_is_right_is_left_alone(rig: registration.Rig, shots: list[Shot]) -> None:
    stamped = [replace(shot, depth_ns=shot.depth_ns - round(1e9 * LAG_S)) for shot in shots]
    a = found(rig, stamped, rig.T_color_depth)
    assert a.off_px < 1.0 and a.lag_s is not None and abs(a.lag_s) < 0.005


def test_a_lag_of_the_stamps_is_found_with_its_sign(rig: registration.Rig, shots: list[Shot]) -> None:
    stamped = [replace(shot, depth_ns=shot.depth_ns - 50_000_000) for shot in shots]
    a = found(rig, stamped, rig.T_color_depth)
    assert a.lag_s is not None and abs(a.lag_s - (LAG_S - 0.050)) < 0.006


def test_a_lost_depth_image_is_placed(rig: registration.Rig, shots: list[Shot]) -> None:
    late = [replace(s, depth_ns=s.depth_ns - round(1e9 * PERIOD_S) * (k >= 9)) for k, s in enumerate(shots)]
    a = found(rig, late, TURN @ rig.T_color_depth)
    assert a.jump is not None and abs(a.jump.seconds + PERIOD_S) < 0.03
    assert (a.jump.after_ns, a.jump.before_ns) == (shots[8].stamps_ns[1], shots[9].stamps_ns[1])
    assert apart_px(rig, a.corrected(TURN @ rig.T_color_depth)) < 1.2


def test_without_structure_or_relation_nothing_is_told(rig: registration.Rig, shots: list[Shot]) -> None:
    wall = [replace(shot, depth=DepthMap(np.full((240, 320), 2.0, np.float32))) for shot in shots]
    assert registration.found(wall, rig.depth, rig.color, rig.T_color_depth) is None
    mixed = [replace(shot, depth=shots[(k + 7) % len(shots)].depth) for k, shot in enumerate(shots)]
    mixed = [replace(shot, images=tuple(image[::-1] for image in shot.images)) for shot in mixed]
    a = registration.found(mixed, rig.depth, rig.color, rig.T_color_depth)
    assert a is None or not a.confirmed or a.off_px < 1.5 * a.halves_px


def told(rig: registration.Rig, shots: list[Shot], claimed: Float64) -> Check:
    """What the doctor says in space."""
    mounting = Mounting(rig.color, rig.depth, claimed, False)
    views = EdgeViews(rig.depth, rig.color, claimed)
    for shot in shots:
        views.add(shot)
    return judge(views, mounting)[0]


def test_what_no_turn_explains_gets_none(rig: registration.Rig, shots: list[Shot]) -> None:
    aside = rig.T_color_depth.copy()
    aside[0, 3] += 0.07
    found = told(rig, shots, aside)
    assert not found.ok and "no turn explains" in found.detail and "static_transform_publisher" not in found.mend
    far = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, np.radians(8.0), 0.0])) @ rig.T_color_depth
    found = told(rig, shots, far)
    assert "cannot tell" in found.detail and "within 16 px" in found.detail


def write(path: Path, rig: registration.Rig, shots: list[Shot], claimed: Float64, register: bool) -> Path:
    """A bag of shots: depth in its own camera, or registered with the claimed pose."""
    with SequenceWriter(path) as writer:
        if not register:
            writer.tf_static(rig.color.frame_id, "depth", claimed, shots[0].stamps_ns[0])
        for shot in shots:
            for stamp, image in zip(shot.stamps_ns, shot.images, strict=True):
                writer.camera_info(INFO, stamp, rig.color)
                writer.image(COLOR, stamp, image, rig.color.frame_id)
            if register:
                depth = register_depth(shot.depth, rig.depth, rig.color, claimed)
                writer.depth(DEPTH, shot.depth_ns, depth, rig.color.frame_id)
            else:
                writer.camera_info("/camera/depth/camera_info", shot.depth_ns, rig.depth)
                writer.depth(DEPTH, shot.depth_ns, shot.depth, "depth")
    return path


def test_doctor_mends_the_extrinsic_of_a_bag(
    rig: registration.Rig, shots: list[Shot], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = write(tmp_path / "own.mcap", rig, shots, TURN @ rig.T_color_depth, register=False)
    assert cli.main(["doctor", str(bag), "--json"]) == 2
    space, time, shutter = json.loads(capsys.readouterr().out)
    assert shutter["ok"] and "cannot tell" in shutter["detail"]  # of 16 frames
    assert not space["ok"] and "px off" in space["detail"] and "static_transform_publisher" in space["mend"]
    numbers = np.array([float(v) for v in re.findall(r"--q?[xyzw] (\S+)", space["mend"])])
    assert apart_px(rig, se3.from_quaternion(numbers[:3], numbers[3:])) < 1.2
    assert not time["ok"] and "older" in time["detail"] and "subtract" in time["mend"]


def test_doctor_tells_registered_depth_that_is_wrong_and_right(
    rig: registration.Rig, shots: list[Shot], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(doctor_recording, "SHOTS", 24)
    wrong, right = (
        recording_checks(write(tmp_path / f"{name}.mcap", rig, shots, claimed, register=True))[0]
        for name, claimed in (("wrong", TURN @ rig.T_color_depth), ("right", rig.T_color_depth))
    )
    assert not wrong.ok and "register it again" in wrong.mend
    assert right.ok and "within" in right.detail and not right.mend


def test_doctor_says_where_there_is_nothing_to_check(
    rig: registration.Rig, shots: list[Shot], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with SequenceWriter(tmp_path / "rgb.mcap") as writer:
        writer.camera_info(INFO, 1, rig.color)
        writer.image(COLOR, 1, shots[0].images[0], rig.color.frame_id)
    assert cli.main(["doctor", str(tmp_path / "rgb.mcap")]) == 0
    assert "nothing to check: no depth images" in capsys.readouterr().out
    assert cli.main(["doctor", str(tmp_path / "none.mcap")]) == 2
    late = [replace(shot, depth_ns=shot.depth_ns + 10**10) for shot in shots]
    (apart,) = recording_checks(write(tmp_path / "late.mcap", rig, late, np.eye(4), register=True))
    assert not apart.ok and "within 0.1 s" in apart.detail
    with SequenceWriter(tmp_path / "own.mcap") as writer:
        writer.camera_info(INFO, 1, rig.color)
        writer.image(COLOR, 1, shots[0].images[0], rig.color.frame_id)
        writer.depth(DEPTH, 1, shots[0].depth, "depth")
    capsys.readouterr()
    assert cli.main(["doctor", str(tmp_path / "own.mcap")]) == 2
    assert "no /camera/depth/camera_info" in capsys.readouterr().err


def test_seven_scenes_came_with_a_wrong_rotation(shared_data: Callable[[str], Path]) -> None:
    """Frames 101-176: the rotation in use was fitted on frames 0-99."""
    folder = shared_data("rgbd_7scenes_redkitchen_000_199")
    cameras = SevenScenes.DEPTH_CAMERA, SevenScenes.COLOR_CAMERA
    given, used = (
        registration.found(registration.seven_scenes(folder, range(101, 177, 4)), *cameras, T)
        for T in (registration.GIVEN, SevenScenes.T_COLOR_DEPTH)
    )
    assert given is not None and used is not None
    assert given.confirmed and given.off_px > 5 and given.off_px > 5 * given.halves_px
    assert used.off_px < 1.5 and used.score > given.score + 0.15
    agree = given.corrected(registration.GIVEN) @ se3.inverse(SevenScenes.T_COLOR_DEPTH)
    assert np.degrees(np.linalg.norm(se3.log(agree)[3:])) < 0.25
