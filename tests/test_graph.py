"""The whole graph as processes: equal to the in-process line, complete, live without loss, and never left behind."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from sf_bringup.simulate import SimulationSpec, simulate
from sf_interfaces.io.bag import BagReader
from sf_interfaces.io.sequence_writer import SequenceWriter
from sf_interfaces.io.trajectory import read_tum
from sf_interfaces.ros.messages import decode_depth, to_ns
from tests.bringup.test_photo_set import photos
from tests.depth.views import Views, room
from tests.tracking.box_room import CAMERA, BoxRoom, circle, warming_up

pytestmark = [pytest.mark.graph, pytest.mark.timeout(900)]
FAST = ["--set", "recon.iterations=8", "--set", "recon.final_iterations=8", "--set", "recon.pixels=1024"]
SIZE = {"width": 320, "height": 240, "focal": 240.0, "supersampling": 1}
COARSE = [f"--set={option}" for option in (
    "recon.iterations=1", "recon.final_iterations=1", "recon.pixels=256", "recon.resolution=0.2", "recon.merge_gap=0",
    "recon.mesh=none", "tracking.window=4", "tracking.patches=120",
)]  # fmt: skip
_domains = iter(range(40, 90))


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("graph") / "rgbl.mcap"
    simulate(SimulationSpec("lounge", frames=16, fps=10.0, lidar="spinning64", **SIZE), path)
    return path


@pytest.fixture
def environment() -> dict[str, str]:
    own = {"ROS_DOMAIN_ID": str(next(_domains)), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    return {**os.environ, **own}


def sf(environment: dict[str, str], *args: str, timeout: float = 600) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "sf_bringup.cli", *args]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=timeout)


def ours(marker: str) -> list[int]:
    """Processes whose command line mentions ``marker``."""
    found = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            if marker.encode() in (entry / "cmdline").read_bytes() and int(entry.name) != os.getpid():
                found.append(int(entry.name))
        except OSError:
            continue
    return found


def gone(marker: str, seconds: float) -> bool:
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if not ours(marker):
            return True
        time.sleep(0.05)
    return not ours(marker)


def wait_for(condition: object, seconds: float = 60.0) -> bool:
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if condition():  # type: ignore[operator]
            return True
        time.sleep(0.1)
    return False


def test_lossless_graph_equals_the_process_and_itself(bag: Path, environment: dict[str, str], tmp_path: Path) -> None:
    outs = [tmp_path / name for name in ("inproc", "ros1", "ros2")]
    first = sf(environment, "run", str(bag), "--goal", "tracking", "--out", str(outs[0]))
    assert first.returncode == 0, first.stderr
    for out in outs[1:]:
        done = sf(environment, "run", str(bag), "--goal", "tracking", "--engine", "ros", "--out", str(out))
        assert done.returncode == 0, done.stderr
    files = [(out / "trajectory.tum").read_bytes() for out in outs]
    assert files[1] == files[2], "two lossless replays give the same trajectory byte for byte"
    inproc, ros = read_tum(outs[0] / "trajectory.tum"), read_tum(outs[1] / "trajectory.tum")
    np.testing.assert_array_equal(inproc.stamps_ns, ros.stamps_ns)
    np.testing.assert_allclose(inproc.poses, ros.poses, atol=1e-6)


@pytest.fixture(scope="module")
def loop(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A walk back to where it began, with depth that makes the tracker drift."""
    path = tmp_path_factory.mktemp("graph") / "loop.mcap"
    room, poses = BoxRoom(3), circle(64, 48, 1.2)
    frames = warming_up([room.frame(i, T, "dense") for i, T in enumerate(poses)], 12, 36)
    with SequenceWriter(path) as writer:
        for frame in frames:
            assert frame.image is not None and frame.depth is not None
            writer.image("/camera/color/image_raw", frame.stamp_ns, frame.image, CAMERA.frame_id)
            writer.camera_info("/camera/color/camera_info", frame.stamp_ns, CAMERA)
            writer.depth("/camera/depth/image_raw", frame.stamp_ns, frame.depth, CAMERA.frame_id, "32FC1")
    return path


@pytest.mark.slow
def test_a_loop_corrects_the_map_alike_in_both_engines(loop: Path, environment: dict[str, str], tmp_path: Path) -> None:
    outs = [tmp_path / name for name in ("inproc", "ros")]
    for out in outs:
        args = ("--goal", "recon", "--engine", out.name, "--out", str(out), *COARSE)
        done = sf(environment, "run", str(loop), *args)
        assert done.returncode == 0, done.stderr
    corrected = [_corrections(out) for out in outs]
    assert corrected[0] and corrected[0] == corrected[1], "(stamp of the keyframe, number of poses) of each correction"
    for name in ("trajectory.tum", "keyframes.tum"):
        inproc, ros = (read_tum(out / name) for out in outs)
        np.testing.assert_array_equal(inproc.stamps_ns, ros.stamps_ns)
        np.testing.assert_allclose(inproc.poses, ros.poses, atol=1e-6)
    maps = [SavedPoses(out / "map.sfmap") for out in outs]
    np.testing.assert_allclose(maps[0].poses, maps[1].poses, atol=1e-6)
    np.testing.assert_allclose(maps[0].points, maps[1].points, atol=1e-4)
    final = read_tum(outs[0] / "keyframes.tum")
    np.testing.assert_allclose(maps[0].poses, final.poses, atol=1e-6, err_msg="the map has followed the keyframes")


def _corrections(out: Path) -> list[tuple[int, int]]:
    with BagReader(out / "result.mcap") as result:
        states = [(raw.stamp_ns, result.decode(raw)) for raw in result.messages(["/sf/tracking/keyframe/state"])]
    return [(to_ns(msg.header.stamp), len(msg.corrected)) for _, msg in states if len(msg.corrected)]


class SavedPoses:
    """Keyframe poses and finest points of a map file."""

    def __init__(self, path: Path) -> None:
        with np.load(path, allow_pickle=False) as file:
            order = np.argsort(file["keyframe.stamps"])
            self.poses = file["keyframe.poses"][order]
            self.points = file["level0.points"]


def test_an_image_set_gives_the_same_in_the_graph(environment: dict[str, str], tmp_path: Path) -> None:
    views, outs = room(3), [tmp_path / name for name in ("inproc", "ros")]
    bag = photos(tmp_path / "photos.mcap", views)
    for out in outs:
        done = sf(environment, "run", str(bag), "--goal", "mvd", "--engine", out.name, f"--out={out}")
        assert done.returncode == 0, done.stderr
    for name in ("trajectory.tum", "keyframes.tum", "camera.yaml", "surface.ply", "contact_sheet.png"):
        assert len({(out / name).read_bytes() for out in outs}) == 1, name
    for topic in ("/sf/depth/dense/image", "/sf/depth/dense/variance", "/sf/tracking/keyframe/depth"):
        recorded = [payloads(out / "result.mcap", topic) for out in outs]
        assert len(recorded[0]) == 3 and recorded[0] == recorded[1], topic
    photos(tmp_path / "one.mcap", Views(views.camera, views.images[:1], [], []))
    alone = sf(
        environment, "run", str(tmp_path / "one.mcap"), "--goal", "mvd", "--engine", "ros", f"--out={tmp_path}/1"
    )
    assert alone.returncode == 2 and "at least 2 images" in alone.stderr


def payloads(bag: Path, topic: str) -> list[bytes]:
    """The images of a topic, pixel for pixel."""
    with BagReader(bag) as reader:
        return [bytes(reader.decode(raw).data) for raw in reader.messages([topic])]


def test_rgbl_graph_records_everything_for_every_keyframe(
    bag: Path, environment: dict[str, str], tmp_path: Path
) -> None:
    done = sf(environment, "run", str(bag), "--engine", "ros", "--out", str(tmp_path), *FAST)
    assert done.returncode == 0, done.stderr
    keyframes = len((tmp_path / "keyframes.tum").read_text().splitlines())
    with BagReader(tmp_path / "result.mcap") as result:
        for part in ("image", "variance", "pose", "camera_info"):
            assert result.topics[f"/sf/depth/dense/{part}"].count == keyframes
        for part in ("image", "camera_info", "pose", "depth", "landmarks"):
            assert result.topics[f"/sf/tracking/keyframe/{part}"].count == keyframes
        assert result.topics["/sf/recon/surface"].count >= keyframes
        assert result.topics["/sf/tracking/pose"].count == 16
        assert result.topics["/sf/tracking/path"].count >= 1
        assert result.topics["/tf"].count == 16 and result.topics["/tf_static"].count >= 1
    with (tmp_path / "result.mcap").open("rb") as file:
        reader = make_reader(file)
        assert {m.name for m in reader.iter_metadata()} >= {"scenefactory", "calibration"}
        assert {a.name for a in reader.iter_attachments()} >= {"trajectory.tum", "config.yaml"}
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["trajectory"]["rmse"] < 0.03 and summary["depth"]["absrel"] < 8
    assert gone(str(tmp_path), 3.0)


@pytest.mark.parametrize("words", [["--use-poses", "--goal", "recon"], ["--goal", "completion"]])
def test_lines_without_a_tracker_are_equal_too(words: list[str], environment: dict[str, str], tmp_path: Path) -> None:
    dense, bag = [], tmp_path / "short.mcap"
    simulate(SimulationSpec("lounge", frames=5, fps=10.0, lidar="spinning64", **SIZE), bag)
    for engine in ("inproc", "ros"):
        out = tmp_path / engine
        done = sf(environment, "run", str(bag), *words, "--engine", engine, "--out", str(out), *FAST)
        assert done.returncode == 0, done.stderr
        with BagReader(out / "result.mcap") as result:
            kinds = [f"/sf/depth/dense/{part}" for part in ("image", "variance")]
            found = [(raw.topic, result.decode(raw)) for raw in result.messages(kinds)]
            dense.append({(topic, to_ns(msg.header.stamp)): decode_depth(msg).z for topic, msg in found})
            kept = [kind for kind in ("image", "camera_info", "pose", "depth") if kind != "pose" or "recon" in words]
            assert {f"/sf/tracking/keyframe/{kind}" for kind in kept} <= result.topics.keys()
            assert ("/sf/depth/dense/pose" in result.topics) == ("pose" in kept)
    assert dense[0].keys() == dense[1].keys() and len(dense[0]) == 2 * 5
    for key, z in dense[0].items():
        np.testing.assert_allclose(dense[1][key], z, rtol=1e-5)


def test_ctrl_c_ends_everything_and_keeps_the_recording(bag: Path, environment: dict[str, str], tmp_path: Path) -> None:
    check_end(signal.SIGINT, bag, environment, tmp_path)


def test_a_killed_parent_leaves_nothing_behind(bag: Path, environment: dict[str, str], tmp_path: Path) -> None:
    check_end(signal.SIGKILL, bag, environment, tmp_path)


def check_end(number: signal.Signals, bag: Path, environment: dict[str, str], out: Path) -> None:
    command = [
        sys.executable,
        "-m",
        "sf_bringup.cli",
        "run",
        str(bag),
        "--engine",
        "ros",
        "--out",
        str(out),
        "--rate",
        "0.5",
    ]
    parent = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        assert wait_for(lambda: (out / "log" / "player.log").is_file() and len(ours(str(out))) >= 5)
        time.sleep(3.0)  # in the middle of playing
        parent.send_signal(number)
        assert gone(str(out), 3.0), f"left behind: {ours(str(out))}"
    finally:
        parent.kill()
        parent.wait()
    with BagReader(out / "result.mcap") as result:
        assert sum(info.count for info in result.topics.values()) > 0


def test_live_play_loses_nothing_between_player_and_tracker(
    bag: Path, environment: dict[str, str], tmp_path: Path
) -> None:
    args = ("run", str(bag), "--goal", "tracking", "--engine", "ros", "--rate", "1", "--out", str(tmp_path))
    done = sf(environment, *args)
    assert done.returncode == 0, done.stderr
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert not any(summary["dropped"].values()), summary["dropped"]
    assert summary["trajectory"]["pairs"] == 16


def test_a_refused_setting_ends_the_run_with_its_sentence(
    bag: Path, environment: dict[str, str], tmp_path: Path
) -> None:
    args = ("run", str(bag), "--engine", "ros", "--out", str(tmp_path), "--set", "tracking.patches=1")
    done = sf(environment, *args)
    assert done.returncode == 2 and "patches" in done.stderr and "Traceback" not in done.stderr
    assert gone(str(tmp_path), 3.0)


@pytest.fixture
def live(bag: Path, environment: dict[str, str], tmp_path: Path) -> Iterator[Path]:
    """A line brought up by the orchestrator on topics that a looping player publishes."""
    play = ["-m", "sf_bringup.cli", "play", str(bag), "--loop", "--wait", "0.5"]
    up = ["-m", "sf_bringup.cli", "up", "--out", str(tmp_path / "up")]
    log = (tmp_path / "up.log").open("wb")
    children = [
        subprocess.Popen([sys.executable, *args], env=environment, stdout=log, stderr=log) for args in (play, up)
    ]
    try:
        yield tmp_path
    finally:
        for child in reversed(children):
            child.send_signal(signal.SIGINT)
        for child in children:
            child.wait(timeout=10)


def test_the_orchestrator_builds_the_line_from_live_topics(live: Path, environment: dict[str, str]) -> None:
    log = live / "up.log"
    assert wait_for(lambda: b"started tracking, depth, recon" in log.read_bytes(), 90), log.read_text()
    text = log.read_text()
    assert "tracking, because POSE is missing and recon needs it" in text
    found: dict[str, Any] = {}

    def seen() -> bool:  # what a busy machine has not discovered in one look it has in the next
        table = subprocess.run(
            [sys.executable, "-m", "sf_bringup.graph_table", "--json"],
            env=environment, capture_output=True, text=True, timeout=60,
        )  # fmt: skip
        assert table.returncode == 0, table.stdout + table.stderr
        found.update(json.loads(table.stdout))
        return {"/sf/tracking", "/sf/depth", "/sf/recon", "/sf_orchestrator"} <= set(found["nodes"])

    assert wait_for(seen, 60), found
    for topic in ("/sf/tracking/pose", "/sf/depth/dense/variance", "/sf/recon/surface", "/sf/line", "/diagnostics"):
        assert topic in found["topics"]
    # A node that dies comes back, and the others stay.
    (victim,) = [p for p in ours("sf_depth.node") if str(live).encode() in Path(f"/proc/{p}/cmdline").read_bytes()]
    others = set(ours("sf_tracking.node"))
    os.kill(victim, signal.SIGKILL)
    assert wait_for(lambda: b"node depth restarted" in log.read_bytes(), 60), log.read_text()
    assert set(ours("sf_tracking.node")) == others
