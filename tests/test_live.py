"""``sf up`` on the topics of an independent driver: found, followed, and held through the death of every node."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from sf_bringup.shared_memory import orphaned_segments
from sf_bringup.simulate import SimulationSpec, simulate
from sf_interfaces.io.bag import BagReader
from sf_interfaces.io.trajectory import read_tum
from sf_interfaces.ros.messages import decode_depth, decode_image

pytestmark = [pytest.mark.graph, pytest.mark.slow, pytest.mark.timeout(600)]
DRIVER = Path(__file__).parent / "live_camera.py"
FAST = ["--set", "recon.iterations=4", "--set", "recon.final_iterations=4", "--set", "recon.keyframe_pixels=8192"]
PATIENCE_S = 120.0  # on a machine that does other things too


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Colour, millimetres and calibration of a short walk, for a driver that knows nothing of this project."""
    folder = tmp_path_factory.mktemp("frames")
    bag = folder / "rgbd.mcap"
    size = {"width": 320, "height": 240, "focal": 240.0, "supersampling": 1}
    simulate(SimulationSpec("lounge", frames=24, fps=10.0, depth="exact", **size), bag)
    rgb, mm = [], []
    with BagReader(bag) as reader:
        for raw in reader.messages(["/camera/color/image_raw"]):
            rgb.append(decode_image(reader.decode(raw)))
        for raw in reader.messages(["/camera/depth/image_raw"]):
            z = decode_depth(reader.decode(raw)).z
            mm.append(np.nan_to_num(z * 1000).astype(np.uint16))
        info = reader.decode(next(reader.messages(["/camera/color/camera_info"])))
    k = np.array(info.k)[[0, 4, 2, 5]]
    np.savez(folder / "frames.npz", rgb=np.array(rgb), mm=np.array(mm), k=k)
    return folder / "frames.npz"


class Stage:
    """A domain with drivers and one ``sf up``; its log tells what happens."""

    def __init__(self, frames: Path, out: Path, domain: int) -> None:
        self.frames, self.out = frames, out
        own = {"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
        self.environment = {**os.environ, **own}
        self.children: list[subprocess.Popen[bytes]] = []
        out.mkdir(parents=True, exist_ok=True)

    def spawn(self, *command: str) -> subprocess.Popen[bytes]:
        with (self.out / "up.log").open("ab") as log:
            child = subprocess.Popen([sys.executable, *command], env=self.environment, stdout=log, stderr=log)
        self.children.append(child)
        return child

    def camera(self, namespace: str, *more: str) -> subprocess.Popen[bytes]:
        return self.spawn(str(DRIVER), str(self.frames), namespace, "--rate", "8", *more)

    def up(self, *more: str) -> subprocess.Popen[bytes]:
        return self.spawn("-m", "sf_bringup.cli", "up", "--out", str(self.out), *FAST, *more)

    @property
    def log(self) -> str:
        return (self.out / "up.log").read_text(errors="replace")

    def says(self, words: str, times: int = 1) -> None:
        self.until(lambda: self.log.count(words) >= times, f"'{words}' {times}x")

    def until(self, condition: Callable[[], bool], what: str) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < deadline, f"waited for {what}:\n{self.log[-6000:]}"
            time.sleep(0.1)

    def process(self, module: str) -> int:
        """The process that runs a module for this stage."""
        for entry in Path("/proc").iterdir():
            try:
                words = (entry / "cmdline").read_bytes()
            except OSError:
                continue
            if entry.name.isdigit() and module.encode() in words and str(self.out).encode() in words:
                return int(entry.name)
        raise AssertionError(f"no process of {module}")

    def kill(self, module: str) -> None:
        os.kill(self.process(module), signal.SIGKILL)

    def end(self) -> None:
        for child in reversed(self.children):
            if child.poll() is None:
                child.send_signal(signal.SIGINT)
        for child in self.children:
            child.wait(timeout=30)


@pytest.fixture
def stage(frames: Path, tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Stage]:
    made = Stage(frames, tmp_path / "run", 100 + os.getpid() % 100)
    yield made
    for child in made.children:
        child.kill()
        child.wait()


def poses_saved(stage: Stage) -> int:
    """Poses in the tracker's last snapshot."""
    path = stage.out / "state" / "tracking.npz"
    if not path.is_file():
        return 0
    with np.load(path, allow_pickle=False) as snapshot:
        return len(snapshot["stamps"])


def test_map_and_trajectory_outlive_the_nodes(stage: Stage) -> None:
    pytest.importorskip("rclpy")
    stage.up()
    stage.says("no line")  # nothing is there yet
    stage.camera("/robot1/front", "--compressed")
    stage.says("started tracking, recon")
    assert "rgb from /robot1/front/color/image_raw/compressed, a colour image, compressed" in stage.log
    stage.until(lambda: poses_saved(stage) > 10, "a snapshot of the tracker")
    before = poses_saved(stage)
    recon = stage.process("sf_recon.node")
    stage.kill("sf_tracking.node")
    stage.says("node tracking was killed by SIGKILL")
    stage.says("node tracking restarted")
    assert stage.process("sf_recon.node") == recon
    stage.until(lambda: poses_saved(stage) > before + 10, "a snapshot after the restart")
    stage.until(lambda: (stage.out / "state" / "recon.sfmap").is_file(), "a snapshot of the map")
    stage.kill("sf_recon.node")
    stage.says("node recon restarted")
    tracking = stage.process("sf_tracking.node")
    # A driver that restarts keeps the line as it is.
    camera = stage.children[1]
    camera.send_signal(signal.SIGINT)
    camera.wait(timeout=20)
    stage.says("is gone; the line waits")
    count = poses_saved(stage)
    stage.camera("/robot1/front", "--compressed")
    stage.until(lambda: poses_saved(stage) > count, "poses of the camera that came back")
    assert stage.process("sf_tracking.node") == tracking
    saved = poses_saved(stage)
    stage.end()
    trajectory = read_tum(stage.out / "trajectory.tum")
    assert len(trajectory) >= saved
    steps = np.linalg.norm(np.diff(trajectory.positions, axis=0), axis=1)
    assert steps.max() < 0.8, "the restarted tracker found its place in the map"
    assert (stage.out / "map.sfmap").stat().st_size > 0 and (stage.out / "surface.ply").is_file()
    assert not orphaned_segments(), "shared memory of killed processes is removed"


def test_a_node_that_keeps_dying_is_given_up_and_the_line_goes_on(stage: Stage) -> None:
    pytest.importorskip("rclpy")
    stage.camera("/cam")
    stage.up()
    stage.says("started tracking, recon")
    for time_ in range(1, 5):
        stage.kill("sf_recon.node")
        stage.says(
            "node recon was killed" if time_ < 4 else "the line goes on without recon", time_ if time_ < 4 else 1
        )
        if time_ < 4:
            stage.says("node recon restarted", time_)
    count = poses_saved(stage)
    stage.until(lambda: poses_saved(stage) > count, "more poses")
    stage.end()
    assert stage.children[1].returncode == 0
