"""Frames do not depend on how the messages interleave; every drop has its reason."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sf_interfaces.errors import CalibrationError
from sf_interfaces.geometry import se3
from sf_interfaces.sync import FrameAssembler, SyncConfig
from sf_interfaces.types import Camera, DepthMap, Frame, PointCloud

MS = 1_000_000
CAMERA = Camera(32, 24, 30.0, 30.0, 16.0, 12.0, "cam")
T_CAM_LIDAR = np.array([[0, -1, 0, 0.1], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1.0]])


def _image(i: int) -> np.ndarray:
    return np.full((24, 32, 3), i % 256, np.uint8)


def _cloud(stamp_ns: int, seed: int = 0) -> PointCloud:
    rng = np.random.default_rng(seed)
    points = rng.uniform([2, -1, -0.5], [6, 1, 0.5], (60, 3))
    return PointCloud(points, time_offset_ns=np.arange(60) * MS, stamp_ns=stamp_ns, frame_id="lidar")


def _streams(stamps: dict[str, list[int]]) -> dict[str, list]:
    """Per topic, the pushes in their order, as functions of the assembler."""
    motion = [se3.exp(np.array([0.02 * i, 0, 0.01 * i, 0, 0.01 * i, 0])) for i in range(60)]
    return {
        "image": [lambda a, t=t: a.push_image(t, _image(t // MS), "cam") for t in stamps["image"]],
        "depth": [
            lambda a, t=t: a.push_depth(t, DepthMap(np.full((24, 32), 1 + t / 1e9)), "cam") for t in stamps["depth"]
        ],
        "lidar": [lambda a, t=t: a.push_cloud(_cloud(t, t // MS)) for t in stamps["lidar"]],
        "pose": [lambda a, t=t, i=i: a.push_pose(t, motion[i]) for i, t in enumerate(stamps["pose"])],
        "info": [lambda a: a.push_camera(CAMERA)],
        "tf": [
            lambda a: a.push_transform("base", "cam", np.eye(4)),
            lambda a: a.push_transform("base", "lidar", T_CAM_LIDAR),
        ],
    }


def _same(a: Frame, b: Frame) -> bool:
    def equal(x: object, y: object) -> bool:
        return (x is None) == (y is None) and (x is None or np.array_equal(x, y, equal_nan=True))

    def parts(f: Frame) -> list:
        sparse, depth = f.sparse_depth, f.depth
        return [
            f.image,
            depth and depth.z,
            None if sparse is None else sparse.uv,
            None if sparse is None else sparse.z,
            f.T_map_camera,
        ]

    return a.stamp_ns == b.stamp_ns and all(equal(x, y) for x, y in zip(parts(a), parts(b), strict=True))


def _run(config: SyncConfig, pushes: list) -> tuple[list[Frame], dict[str, int]]:
    assembler, frames = FrameAssembler(config), []

    def take() -> None:
        for frame in assembler.ready():
            frames.append(frame)
            pose = se3.exp(np.array([frame.stamp_ns / 1e9, 0.1, 0, 0, 0, frame.stamp_ns / 2e9]))
            assembler.feed_back(frame.stamp_ns, pose)

    for push in pushes:
        push(assembler)
        take()
    assembler.end()
    take()
    return frames, assembler.reasons


@st.composite
def _case(draw: st.DrawFn) -> tuple[SyncConfig, list, list]:
    def times(low: int, high: int, jump: bool) -> list[int]:
        stamps = sorted(draw(st.lists(st.integers(1, 400), min_size=low, max_size=high, unique=True)))
        out = [5000 * MS + s * MS for s in stamps]
        return out + [s * MS for s in stamps] if jump else out

    jump = draw(st.booleans())
    stamps = {name: times(0 if name != "image" else 1, 8, jump) for name in ("image", "depth", "lidar", "pose")}
    config = SyncConfig(
        depth=draw(st.booleans()), lidar=draw(st.booleans()), pose=draw(st.booleans()), depth_slop_s=0.03
    )
    streams = _streams(stamps)

    def interleave() -> list:
        left = {name: list(pushes) for name, pushes in streams.items() if pushes}
        out = []
        while left:
            name = draw(st.sampled_from(sorted(left)))
            out.append(left[name].pop(0))
            if not left[name]:
                del left[name]
        return out

    return config, interleave(), interleave()


@settings(max_examples=120, deadline=None)
@given(_case())
def test_any_interleaving_gives_the_same_frames_and_reasons(case: tuple[SyncConfig, list, list]) -> None:
    config, first, second = case
    frames_a, reasons_a = _run(config, first)
    frames_b, reasons_b = _run(config, second)
    assert len(frames_a) == len(frames_b)
    assert all(_same(a, b) for a, b in zip(frames_a, frames_b, strict=True))
    assert reasons_a == reasons_b


def test_the_nearest_depth_within_the_slop_is_taken_and_poses_are_interpolated() -> None:
    assembler = FrameAssembler(SyncConfig(depth=True, pose=True))
    assembler.push_camera(CAMERA)
    for ms, value in ((90, 1.0), (104, 2.0), (140, 3.0)):
        assembler.push_depth(ms * MS, DepthMap(np.full((24, 32), value)), "cam")
    assembler.push_image(100 * MS, _image(1), "cam")
    assert list(assembler.ready()) == []
    assembler.push_pose(80 * MS, np.eye(4))
    assert list(assembler.ready()) == [] and "pose" in assembler.waiting_for
    assembler.push_pose(120 * MS, se3.exp(np.array([1.0, 0, 0, 0, 0, 0])))
    (frame,) = assembler.ready()
    assert frame.depth is not None and frame.depth.z[0, 0] == 2.0
    assert frame.T_map_camera is not None and frame.T_map_camera[0, 3] == pytest.approx(0.5)


def test_poses_are_never_extrapolated() -> None:
    assembler = FrameAssembler(SyncConfig(pose=True))
    assembler.push_camera(CAMERA)
    assembler.push_pose(80 * MS, np.eye(4))
    assembler.push_image(100 * MS, _image(1), "cam")
    assembler.end()
    assert list(assembler.ready()) == []
    assert assembler.reasons == {"image dropped: no given pose on both sides of its stamp": 1}


def test_a_missing_extrinsic_is_reported_and_never_identity() -> None:
    assembler = FrameAssembler(SyncConfig(lidar=True))
    assembler.push_camera(CAMERA)
    for i in range(4):
        assembler.push_image((i * 100 + 1) * MS, _image(i), "cam")
        assembler.push_cloud(_cloud((i * 100 + 1) * MS))
        assert list(assembler.ready()) == []
    sentence = "no transform from 'lidar' to 'cam': publish it on /tf_static or pass --extrinsic"
    assert assembler.waiting_for == sentence
    assembler.end()
    assert [f.sparse_depth for f in assembler.ready()] == [None] * 4
    assert assembler.reasons[sentence] == 4


def test_deskew_moves_points_by_the_motion_fed_back() -> None:
    config = SyncConfig(lidar=True, extrinsic=(0.1, 0, 0, 0.5, -0.5, 0.5, 0.5))
    results = []
    for speed in (0.0, 5.0):
        assembler = FrameAssembler(config)
        assembler.push_camera(CAMERA)
        assembler.feed_back(0, np.eye(4))
        assembler.feed_back(100 * MS, se3.exp(np.array([0, 0, speed * 0.1, 0, 0, 0])))
        points = np.array([[4.0, 0.0, 0.0]])
        assembler.push_cloud(
            PointCloud(points, time_offset_ns=np.array([40 * MS]), stamp_ns=200 * MS, frame_id="lidar")
        )
        assembler.push_image(200 * MS, _image(0), "cam")
        (frame,) = assembler.ready()
        assert frame.sparse_depth is not None
        results.append(frame.sparse_depth.z[0])
    assert results[0] == pytest.approx(4.0)
    # Measured 40 ms after the image while driving forward at 5 m/s: 0.2 m farther seen from the image.
    assert results[1] == pytest.approx(4.2)


def test_bad_messages_are_dropped_with_a_reason() -> None:
    assembler = FrameAssembler(SyncConfig(lidar=True, extrinsic=(0, 0, 0, 0, 0, 0, 1)))
    assembler.push_camera(CAMERA)
    assembler.push_cloud(PointCloud(np.zeros((0, 3)), stamp_ns=100, frame_id="lidar"))
    assembler.push_image(50, _image(0), "cam")
    assembler.push_image(50, _image(0), "cam")
    assembler.push_image(60, np.zeros((10, 10, 3), np.uint8), "cam")
    assembler.push_depth(60, DepthMap(np.ones((24, 32))), "cam")
    assembler.end()
    assert [f.stamp_ns for f in assembler.ready()] == [50]
    reasons = " | ".join(assembler.reasons)
    for words in (
        "no finite point",
        "not newer",
        "image is 10x10",
        "no depth input",
        "without a lidar sweep",
    ):
        assert words in reasons


def test_stamp_zero_is_named_once_and_a_jump_back_begins_a_new_epoch() -> None:
    assembler = FrameAssembler()
    assembler.push_camera(CAMERA)
    for stamp in (0, 5_000 * MS, 4_999 * MS, 10 * MS, 20 * MS):
        assembler.push_image(stamp, _image(0), "cam")
    seen = [(assembler.epoch, f.stamp_ns) for f in assembler.ready()]
    assert seen == [(0, 5_000 * MS), (1, 10 * MS), (1, 20 * MS)]
    assert sum(n for r, n in assembler.reasons.items() if "stamp is 0" in r) == 1
    assert sum(n for r, n in assembler.reasons.items() if "jumped back" in r) == 1


def test_live_waiting_ends_in_stream_time() -> None:
    assembler = FrameAssembler(SyncConfig(depth=True, max_wait_s=0.1))
    assembler.push_camera(CAMERA)
    assembler.push_image(1 * MS, _image(0), "cam")
    assembler.push_image(101 * MS, _image(0), "cam")
    assert list(assembler.ready()) == []
    assembler.push_image(102 * MS, _image(0), "cam")
    (frame,) = assembler.ready()
    assert frame.stamp_ns == 1 * MS and frame.depth is None


def test_unregistered_depth_and_a_short_extrinsic_are_refused() -> None:
    with pytest.raises(CalibrationError, match="7 numbers"):
        FrameAssembler(SyncConfig(extrinsic=(1.0, 2.0)))
    assembler = FrameAssembler(SyncConfig(depth=True))
    assembler.push_camera(CAMERA)
    assembler.push_image(1, _image(0), "cam")
    assembler.push_depth(1, DepthMap(np.ones((24, 32))), "ir")
    assert list(assembler.ready()) == []
    assert any("register depth to the image" in reason for reason in assembler.reasons)


def test_depth_leads_where_there_is_no_image() -> None:
    assembler = FrameAssembler(SyncConfig(image=False, depth=True))
    assembler.push_camera(CAMERA)
    assembler.push_depth(7, DepthMap(np.ones((24, 32))), "cam")
    (frame,) = assembler.ready()
    assert frame.image is None and frame.depth is not None and frame.stamp_ns == 7


WIDE = Camera(32, 24, 20.0, 20.0, 16.0, 12.0, "cam")


@pytest.mark.parametrize("info_first", [True, False])
def test_frames_carry_the_calibration_valid_at_their_stamp(info_first: bool) -> None:
    assembler, frames = FrameAssembler(), []
    for i, camera in enumerate([CAMERA, CAMERA, CAMERA, WIDE, WIDE, WIDE]):
        pushes = [
            lambda i=i, camera=camera: assembler.push_camera(camera, None, (i + 1) * 100 * MS),
            lambda i=i: assembler.push_image((i + 1) * 100 * MS, _image(i), "cam"),
        ]
        for push in pushes if info_first else reversed(pushes):
            push()
            frames += assembler.ready()
    assembler.end()
    frames += assembler.ready()
    assert [f.camera for f in frames] == [CAMERA] * 3 + [WIDE] * 3
    assert sum("changed: frames use the new" in reason for reason in assembler.reasons) == 1


def test_autofocus_jitter_does_not_change_the_calibration() -> None:
    assembler = FrameAssembler()
    for i in range(5):
        focus = Camera(32, 24, 30.0 + 0.02 * i, 30.0, 16.0, 12.0, "cam")
        assembler.push_camera(focus, None, (i + 1) * 100 * MS)
        assembler.push_image((i + 1) * 100 * MS, _image(i), "cam")
    assert {f.camera for f in assembler.ready()} == {CAMERA}
    assert sum(n for r, n in assembler.reasons.items() if "too little" in r) == 4


def test_a_calibration_sent_once_holds_back_nothing() -> None:
    assembler = FrameAssembler()
    assembler.push_camera(CAMERA, None, 1)
    assembler.push_image(900 * MS, _image(0), "cam")
    assert len(list(assembler.ready())) == 1
    assembler.push_camera(CAMERA, None, 2)  # now a change may be on its way, but not for ever
    assembler.push_image(1000 * MS, _image(1), "cam")
    assert not list(assembler.ready()) and "camera_info" in assembler.waiting_for
    assembler.push_image(5000 * MS, _image(2), "cam")
    assert [f.stamp_ns for f in assembler.ready()] == [1000 * MS]
