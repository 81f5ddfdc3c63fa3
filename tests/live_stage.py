"""What tests of live lines share: drivers that know nothing of this project, ``sf up``, and patience."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from sf_bringup.simulate import SimulationSpec, simulate
from sf_interfaces.geometry import se3
from sf_interfaces.geometry.align import align
from sf_interfaces.io.bag import BagReader
from sf_interfaces.ros.messages import decode_depth, decode_image, decode_pose
from sf_interfaces.types import Trajectory

DRIVER = Path(__file__).parent / "live_camera.py"
# The walk is short and gone again and again: what was seen a second ago makes keyframes anew.
FAST = ["--set", "recon.iterations=4", "--set", "recon.final_iterations=4", "--set", "tracking.renew_s=1"]
PATIENCE_S = 150.0  # on a machine that does other things too


def make_frames(folder: Path, count: int = 24) -> Path:
    """Colour, millimetres, calibration and true poses of a short walk."""
    bag = folder / "rgbd.mcap"
    size = {"width": 320, "height": 240, "focal": 240.0, "supersampling": 1}
    simulate(SimulationSpec("lounge", frames=count, fps=10.0, depth="exact", **size), bag)
    rgb, mm, poses = [], [], []
    with BagReader(bag) as reader:
        for raw in reader.messages(["/camera/color/image_raw"]):
            rgb.append(decode_image(reader.decode(raw)))
        for raw in reader.messages(["/camera/depth/image_raw"]):
            z = decode_depth(reader.decode(raw)).z
            mm.append(np.nan_to_num(z * 1000).astype(np.uint16))
        for raw in reader.messages(["/ground_truth/pose"]):
            poses.append(decode_pose(reader.decode(raw))[2])
        info = reader.decode(next(iter(reader.messages(["/camera/color/camera_info"]))))
    k = np.array(info.k)[[0, 4, 2, 5]]
    np.savez(folder / "frames.npz", rgb=np.array(rgb), mm=np.array(mm), k=k, poses=np.array(poses))
    return folder / "frames.npz"


class Stage:
    """Drivers and one ``sf up`` in a domain of their own; its log tells what happens.

    Args:
        prefix: words before each command, such as those that enter a network namespace.
    """

    def __init__(self, frames: Path, out: Path, domain: int, prefix: Sequence[str] = (), reach: str = "LOCALHOST"):
        self.frames, self.out, self.prefix = frames, out, list(prefix)
        own = {"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": reach}
        self.environment = {**os.environ, **own}
        self.children: list[subprocess.Popen[bytes]] = []
        self.stamps = str(out / "stamps.txt")
        out.mkdir(parents=True, exist_ok=True)

    def spawn(self, *command: str) -> subprocess.Popen[bytes]:
        with (self.out / "up.log").open("ab") as log:
            words = [*self.prefix, sys.executable, *command]
            child = subprocess.Popen(words, env=self.environment, stdout=log, stderr=log)
        self.children.append(child)
        return child

    def camera(self, namespace: str, *more: str) -> subprocess.Popen[bytes]:
        return self.spawn(str(DRIVER), str(self.frames), namespace, "--rate", "8", "--log", self.stamps, *more)

    def up(self, *more: str) -> subprocess.Popen[bytes]:
        return self.spawn("-m", "sf_bringup.cli", "up", "--out", str(self.out), "--save-s", "60", *FAST, *more)

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

    def errors(self, trajectory: Trajectory) -> np.ndarray:
        """Distances to the true positions after alignment, m."""
        index = dict(np.loadtxt(self.stamps, dtype=np.int64).tolist())
        truth = np.load(self.frames)["poses"]
        truth = np.array([truth[index[stamp]][:3, 3] for stamp in trajectory.stamps_ns.tolist()])
        _, T = align(trajectory.positions, truth)
        return np.linalg.norm(se3.transform(T, trajectory.positions) - truth, axis=1)

    def poses_saved(self) -> int:
        """Poses in the tracker's last snapshot."""
        path = self.out / "state" / "tracking.npz"
        if not path.is_file():
            return 0
        with np.load(path, allow_pickle=False) as snapshot:
            return len(snapshot["stamps"])

    def end(self) -> None:
        """Ask everything to end, the way Ctrl-C does, and wait."""
        for child in reversed(self.children):
            if child.poll() is None:
                child.send_signal(signal.SIGINT)
        for child in self.children:
            child.wait(timeout=100)

    def destroy(self) -> None:
        """End at once what is left."""
        for child in self.children:
            child.kill()
            child.wait()
