"""Lines end to end in one process on small simulated bags, and what the command line says of bad input."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import shutil
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from mcap_ros2.reader import read_ros2_messages
from PIL import Image
from rosbags.highlevel import AnyReader

from sf_bringup import cli
from sf_bringup.simulate import SimulationSpec, simulate
from sf_interfaces.io.bag import BagReader
from sf_interfaces.io.sequence_writer import SequenceWriter
from sf_interfaces.types import Camera, DepthMap, PointCloud

SMALL = {"scene": "lounge", "frames": 14, "fps": 10.0, "width": 320, "height": 240, "focal": 240.0, "supersampling": 1}
FAST = ["--set", "recon.iterations=8", "--set", "recon.final_iterations=8", "--set", "recon.pixels=1024"]


@pytest.fixture(scope="module")
def rgbl(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("rgbl") / "rgbl.mcap"
    simulate(SimulationSpec(lidar="spinning64", **SMALL), path)
    return path


@pytest.fixture(scope="module")
def rgbd(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("rgbd") / "rgbd.mcap"
    simulate(SimulationSpec(depth="exact", **SMALL), path)
    return path


def run(*args: str) -> int:
    return cli.main(["run", *args])


def summary(out: Path) -> dict:
    return json.loads((out / "summary.json").read_text())


def test_rgbl_line_leaves_complete_outputs(rgbl: Path, tmp_path: Path) -> None:
    assert run(str(rgbl), "--out", str(tmp_path), *FAST) == 0
    s = summary(tmp_path)
    assert s["line"] == ["tracking", "depth:complete", "recon"]
    assert s["trajectory"]["rmse"] < 0.03 and s["trajectory"]["pairs"] == SMALL["frames"]
    assert s["depth"]["absrel"] < 8 and s["depth"]["density"] > 90
    assert s["render"]["psnr_surface"] > 15
    for name in (
        "keyframes.tum",
        "camera.yaml",
        "surface.ply",
        "map.sfmap",
        "config.yaml",
        "report.html",
        "overview.png",
    ):
        assert (tmp_path / name).stat().st_size > 0
    keyframes = len((tmp_path / "keyframes.tum").read_text().splitlines())
    assert keyframes >= 2 and len(list((tmp_path / "depth").glob("*.npz"))) == keyframes
    with BagReader(tmp_path / "result.mcap") as bag:
        for topic in ("/sf/depth/dense/image", "/sf/depth/dense/variance", "/sf/recon/surface"):
            assert bag.topics[topic].count == keyframes
        assert bag.topics["/sf/tracking/pose"].count == SMALL["frames"]


def test_the_result_opens_with_independent_readers(rgbl: Path, tmp_path: Path) -> None:
    assert run(str(rgbl), "--goal", "tracking", "--out", str(tmp_path)) == 0
    result = tmp_path / "result.mcap"
    with AnyReader([result]) as reader:
        poses = sum(1 for c, _, _ in reader.messages() if c.topic == "/sf/tracking/pose")
    again = sum(1 for m in read_ros2_messages(str(result), topics=["/sf/tracking/pose"]))
    assert poses == again == SMALL["frames"]


def test_rgbd_line_tracks_and_reconstructs(rgbd: Path, tmp_path: Path) -> None:
    assert run(str(rgbd), "--out", str(tmp_path), *FAST) == 0
    s = summary(tmp_path)
    assert s["line"] == ["tracking", "recon"]
    assert s["trajectory"]["rmse"] < 0.02
    assert s["render"]["psnr_surface"] > 15


def test_depth_alone_goes_through_flexion(tmp_path: Path) -> None:
    source, stripped = tmp_path / "rgbd.mcap", tmp_path / "depth_only.mcap"
    simulate(SimulationSpec(depth="exact", **{**SMALL, "fps": 30.0}), source)
    with BagReader(source) as reader, SequenceWriter(stripped) as writer:
        for raw in reader.messages():
            if raw.topic != "/camera/color/image_raw":
                topic = raw.topic.replace("/camera/color/camera_info", "/camera/depth/camera_info")
                writer.bag.write(topic, raw.type, raw.stamp_ns, raw.data)
    out = tmp_path / "out"
    assert run(str(stripped), "--goal", "tracking", "--out", str(out)) == 0
    s = summary(out)
    assert s["line"] == ["flexion", "tracking"]
    # Curvature alone is a poor texture: what is tracked has to be right, not everything is tracked.
    assert s["trajectory"]["rmse"] < 0.05 and s["trajectory"]["pairs"] >= SMALL["frames"] // 2


def test_given_poses_replace_the_tracker(rgbl: Path, tmp_path: Path) -> None:
    first = tmp_path / "first"
    assert run(str(rgbl), "--goal", "tracking", "--out", str(first)) == 0
    out = tmp_path / "out"
    assert run(str(rgbl), "--poses", str(first / "trajectory.tum"), "--out", str(out), *FAST) == 0
    assert summary(out)["line"] == ["depth:complete", "recon"]
    assert (out / "surface.ply").stat().st_size > 0


def test_single_frames_are_completed_without_any_pose(rgbl: Path, tmp_path: Path) -> None:
    assert run(str(rgbl), "--goal", "completion", "--out", str(tmp_path)) == 0
    s = summary(tmp_path)
    assert s["line"] == ["depth:complete"] and s["depth"]["absrel"] < 8
    with BagReader(tmp_path / "result.mcap") as bag:
        assert bag.topics["/sf/depth/dense/image"].count == SMALL["frames"]
        assert not any(name.endswith("/pose") for name in bag.topics), "an unknown pose is never written"


def test_finished_runs_are_exported_rendered_and_measured(
    rgbd: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    assert run(str(rgbd), "--out", str(out), *FAST) == 0
    assert cli.main(["export", str(out), "--out", str(tmp_path / "x"), "--tum", "--kitti", "--ply"]) == 0
    assert len(np.loadtxt(tmp_path / "x" / "trajectory.kitti")) == SMALL["frames"]
    assert cli.main(["render", str(out), "--poses", str(out / "keyframes.tum"), "--out", str(tmp_path / "v")]) == 0
    assert list((tmp_path / "v").glob("*.depth.png"))
    report = (out / "report.html").read_text()
    assert "views that were not used" in report and "trajectory and landmarks" in report
    assert cli.main(["render", str(out), "--fly", "7", "--out", str(tmp_path / "flight.mp4")]) == 0
    video = cv2.VideoCapture(str(tmp_path / "flight.mp4"))
    frames = [video.read()[1] for _ in range(7)]
    assert not video.read()[0] and all(f.shape == frames[0].shape for f in frames)
    assert np.abs(frames[0].astype(int) - frames[6]).mean() > 2 and frames[3].std() > 10
    assert cli.main(["render", str(out), "--fly", "3", "--out", str(tmp_path / "flight.webp")]) == 0
    with Image.open(tmp_path / "flight.webp") as moving:
        assert moving.n_frames == 3 and (moving.height, moving.width) == frames[0].shape[:2]
    capsys.readouterr()
    assert cli.main(["eval", "traj", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rmse"] < 0.02
    assert cli.main(["eval", "completion", str(out)]) == 2
    assert "completion needs an RGB-L run" in capsys.readouterr().err


# ---- bad input: exit code 2 and one sentence


def refused(capsys: pytest.CaptureFixture[str], *args: str) -> str:
    capsys.readouterr()  # what earlier runs said, such as the progress of a slow one
    assert cli.main(list(args)) == 2
    said = capsys.readouterr().err.strip()
    assert said.startswith("sf") and "Traceback" not in said
    return said


def write_bag(path: Path, *, info: bool = True, tf: bool = True, stamp0: int = 10**9, size: int = 64) -> Path:
    camera = Camera(64, 48, 50.0, 50.0, 32.0, 24.0)
    cloud = np.random.default_rng(0).uniform(1, 5, (200, 3)).astype(np.float32)
    with SequenceWriter(path) as writer:
        if tf:
            writer.tf_static("lidar", "camera_optical_frame", np.eye(4), stamp_ns=stamp0)
        for k in range(4):
            stamp = stamp0 + k * 10**8
            image = np.full((48, size, 3), 100, np.uint8)
            writer.image("/camera/color/image_raw", stamp, image, "camera_optical_frame")
            if info:
                writer.camera_info("/camera/color/camera_info", stamp, camera)
            writer.cloud("/lidar/points", PointCloud(cloud, stamp_ns=stamp, frame_id="lidar"))
    return path


def test_missing_input_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "does not exist" in refused(capsys, "run", str(tmp_path / "no.mcap"), "--out", str(tmp_path / "o"))
    assert "does not exist" in refused(capsys, "plan", str(tmp_path / "no.mcap"))


def test_garbage_is_not_a_bag(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad = tmp_path / "bad.mcap"
    bad.write_bytes(b"not a bag at all" * 10)
    assert "bad.mcap" in refused(capsys, "run", str(bad), "--out", str(tmp_path / "o"))


def test_a_truncated_bag_gives_what_it_holds(rgbd: Path, tmp_path: Path) -> None:
    torn = tmp_path / "torn.mcap"
    shutil.copy(rgbd, torn)
    with torn.open("r+b") as file:
        file.truncate(int(torn.stat().st_size * 0.7))
    out = tmp_path / "out"
    assert run(str(torn), "--goal", "tracking", "--out", str(out)) == 0
    assert 3 < summary(out)["trajectory"]["pairs"] < SMALL["frames"]


def test_no_camera_info_says_what_to_add(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = write_bag(tmp_path / "a.mcap", info=False)
    said = refused(capsys, "run", str(bag), "--goal", "tracking", "--out", str(tmp_path / "o"))
    assert "depth:calibrate" in said and "--calibration" in said


def test_no_extrinsic_is_never_identity(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = write_bag(tmp_path / "a.mcap", tf=False)
    said = refused(capsys, "run", str(bag), "--out", str(tmp_path / "o"))
    assert "no transform from 'lidar' to 'camera_optical_frame'" in said and "--extrinsic" in said


def test_topic_of_wrong_type_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = write_bag(tmp_path / "a.mcap")
    said = refused(capsys, "run", str(bag), "--map", "rgb=/lidar/points", "--out", str(tmp_path / "o"))
    assert "PointCloud2" in said and "rgb needs" in said


def test_unknown_settings_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = write_bag(tmp_path / "a.mcap")
    out = ["--out", str(tmp_path / "o"), "--goal", "tracking"]
    assert "did you mean 'patches'" in refused(capsys, "run", str(bag), *out, "--set", "tracking.patchs=3")
    assert "unknown section" in refused(capsys, "run", str(bag), *out, "--set", "traking.patches=3")


def test_images_that_cannot_be_tracked_are_refused_in_words(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    camera = Camera(64, 48, 50.0, 50.0, 32.0, 24.0)
    with SequenceWriter(tmp_path / "m.mcap") as writer:
        for k in range(3):
            writer.image("/camera/color/image_raw", 10**9 + k, np.zeros((48, 64, 3), np.uint8), "camera_optical_frame")
            writer.camera_info("/camera/color/camera_info", 10**9 + k, camera)
    assert cli.main(["plan", str(tmp_path / "m.mcap"), "--goal", "recon"]) == 0
    assert "tracking -> depth:slam -> recon" in capsys.readouterr().out
    said = refused(capsys, "run", str(tmp_path / "m.mcap"), "--goal", "recon", "--out", str(tmp_path / "o"))
    assert "none of the frames" in said and "could be tracked" in said and "--poses" in said


@pytest.mark.parametrize("broken", ["size", "empty", "backwards", "zero"])
def test_broken_messages_are_dropped_with_a_reason(broken: str, rgbd: Path, tmp_path: Path) -> None:
    bag, out = tmp_path / "b.mcap", tmp_path / "out"
    camera = Camera(320, 240, 240.0, 240.0, 160.0, 120.0)
    with BagReader(rgbd) as reader, SequenceWriter(bag) as writer:
        late = False
        for count, raw in enumerate(reader.messages()):
            writer.bag.write(raw.topic, raw.type, raw.stamp_ns, raw.data)
            stamp = raw.stamp_ns
            if count == 30 and broken == "size":
                writer.image(
                    "/camera/color/image_raw", stamp + 1, np.zeros((7, 9, 3), np.uint8), "camera_optical_frame"
                )
            if count == 30 and broken == "empty":
                writer.depth(
                    "/camera/depth/image_raw", stamp + 1, DepthMap(np.full((240, 320), np.nan)), camera.frame_id
                )
            if broken in ("backwards", "zero") and raw.topic == "/camera/color/image_raw" and count > 30 and not late:
                late = True
                wrong = 0 if broken == "zero" else stamp - 200_000_000
                header = struct.pack("<iI", *divmod(wrong, 10**9))
                writer.bag.write(raw.topic, raw.type, stamp + 1, raw.data[:4] + header + raw.data[12:])
    assert run(str(bag), "--goal", "tracking", "--out", str(out)) == 0
    s = summary(out)
    assert s["trajectory"]["pairs"] >= SMALL["frames"] - 4
    if broken in ("size", "backwards", "zero"):
        assert s["dropped"]
