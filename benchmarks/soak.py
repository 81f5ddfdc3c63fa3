"""A live RGB-D line for a while: memory, drops and rates, as the nodes report them and as they are.

    python benchmarks/soak.py [--seconds 120] [--rate 15] [--frames 100] [--width 640] [--kill-every 20] [--out FILE]

A driver process publishes a simulated walk there and back again, with sensor-data QoS; ``sf up`` builds the line.
With --kill-every a node gets SIGKILL each so many seconds, tracking and recon in turn, and the pause until it publishes
again is measured. Prints a table and writes JSON. Exit code 1: a keyframe was lost, or a node died unasked.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

SAMPLE_S, WARM_S, SAVE_S, SETTLE_S = 5.0, 30.0, 60.0, 20.0
FAST = ["--set", "recon.iterations=4"]


def render(width: int, count: int, path: Path) -> None:
    """Colour, millimetres and intrinsics of a walk of ``count`` frames."""
    from sf_bringup.simulate import SimulationSpec, Simulator

    height, focal = width * 3 // 4, width * 0.75
    spec = SimulationSpec(
        "lounge", frames=count, fps=15.0, depth="exact", width=width, height=height, focal=focal, supersampling=1
    )
    simulator = Simulator(spec)
    frames = [simulator.frame(i) for i in range(count)]
    camera = spec.camera
    np.savez(
        path,
        rgb=np.array([f[0] for f in frames]),
        mm=np.array([np.nan_to_num(f[1] * 1000) for f in frames]).astype(np.uint16),
        k=np.array([camera.fx, camera.fy, camera.cx - 0.5, camera.cy - 0.5]),
    )


def publish(path: Path, rate: float) -> None:
    """The driver: plain rclpy until it is killed."""
    import array

    import rclpy
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import CameraInfo, Image

    with np.load(path, allow_pickle=False) as stored:
        data = dict(stored)
    rclpy.init()
    node = rclpy.create_node("soak_driver")
    color = node.create_publisher(Image, "/soak/color/image_raw", qos_profile_sensor_data)
    depth = node.create_publisher(Image, "/soak/depth/image_raw", qos_profile_sensor_data)
    info = node.create_publisher(CameraInfo, "/soak/color/camera_info", qos_profile_sensor_data)
    k, count, begin, i = data["k"], len(data["rgb"]), time.monotonic(), 0
    images = [(color, "rgb8", data["rgb"]), (depth, "16UC1", data["mm"])]
    while True:
        index = i % (2 * count - 2)
        index = index if index < count else 2 * count - 2 - index
        calibration = CameraInfo(height=data["rgb"].shape[1], width=data["rgb"].shape[2], distortion_model="plumb_bob")
        calibration.k = [k[0], 0.0, k[2], 0.0, k[1], k[3], 0.0, 0.0, 1.0]
        calibration.header.stamp = node.get_clock().now().to_msg()
        calibration.header.frame_id = "soak_optical"
        for publisher, encoding, frames in images:
            pixels = frames[index]
            msg = Image(height=pixels.shape[0], width=pixels.shape[1], encoding=encoding, step=pixels.strides[0])
            msg.header, msg.data = calibration.header, array.array("B", pixels.tobytes())
            publisher.publish(msg)
        info.publish(calibration)
        i += 1
        time.sleep(max(0.0, begin + i / rate - time.monotonic()))


class Watch:
    """Listens to /diagnostics and the stream states, and reads the nodes' memory."""

    def __init__(self, out: Path) -> None:
        import rclpy
        from diagnostic_msgs.msg import DiagnosticArray
        from geometry_msgs.msg import PoseStamped
        from sensor_msgs.msg import PointCloud2

        rclpy.init()
        self._rclpy, self._out = rclpy, out
        self._node = rclpy.create_node("soak_watch")
        self.values: dict[str, dict[str, str]] = {}
        self.memory: dict[str, list[tuple[float, float]]] = defaultdict(list)  # node -> (s, MB)
        self.poses, self.first_pose = 0, 0.0
        self.outages: list[tuple[str, float]] = []  # node that was killed, s until it published again
        self._killed: tuple[str, float] | None = None
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self._report, 100)
        self._node.create_subscription(PoseStamped, "/sf/tracking/pose", self._pose, 1000)
        self._node.create_subscription(PointCloud2, "/sf/recon/surface", lambda _: self._back("recon"), 10)

    def _report(self, msg: Any) -> None:
        for status in msg.status:
            self.values[status.name.rsplit("/", 1)[-1]] = {v.key: v.value for v in status.values}

    def _pose(self, _: Any) -> None:
        self.first_pose = self.first_pose or time.monotonic()
        self.poses += 1
        self._back("tracking")

    def _back(self, name: str) -> None:
        if self._killed is not None and self._killed[0] == name:
            self.outages.append((name, time.monotonic() - self._killed[1]))
            self._killed = None

    def run(self, seconds: float, begin: float, kill_every: float = 0.0) -> None:
        """Listen, look at the memory now and then, and kill a node every so many seconds (0: never)."""
        due, end = time.monotonic(), time.monotonic() + seconds
        kill = time.monotonic() + kill_every if kill_every else end
        while time.monotonic() < end:
            self._rclpy.spin_once(self._node, timeout_sec=0.2)
            if time.monotonic() >= due:
                due += SAMPLE_S
                for name, _, megabytes in self._resident():
                    self.memory[name].append((time.monotonic() - begin, megabytes))
            if time.monotonic() >= kill and kill < end - kill_every:
                kill += kill_every
                self._kill(("tracking", "recon")[len(self.outages) % 2])

    def settle(self) -> None:
        """Listen until two reports in turn say that recon took all that tracking sent: nodes report once a second."""
        end, still = time.monotonic() + SETTLE_S, 0
        while time.monotonic() < end and still < 2:
            before, began = self._keyframes(), time.monotonic()
            while time.monotonic() < began + 1.5:
                self._rclpy.spin_once(self._node, timeout_sec=0.2)
            sent, taken = self._keyframes()
            still = still + 1 if sent == taken and before == (sent, taken) else 0

    def _keyframes(self) -> tuple[str, str]:
        """As reported: what tracking sent, what recon took."""
        sent, taken = (self.values.get(node, {}).get("keyframes", "0") for node in ("tracking", "recon"))
        return sent, taken

    def _kill(self, name: str) -> None:
        for found, process, _ in self._resident():
            if found == name:
                self._killed = (name, time.monotonic())
                os.kill(process, signal.SIGKILL)

    def _resident(self) -> list[tuple[str, int, float]]:
        """Node, process and MB of each of the line's processes."""
        found = []
        for entry in Path("/proc").iterdir():
            try:
                words = (entry / "cmdline").read_bytes().split(b"\0") if entry.name.isdigit() else []
                if str(self._out).encode() in b" ".join(words) and b"--params-file" in words:
                    pages = int((entry / "statm").read_text().split()[1])
                    module = words[words.index(b"-m") + 1].decode()
                    name = module.split(".")[0].removeprefix("sf_")
                    found.append((name, int(entry.name), pages * 4096 / 1e6))
            except (OSError, ValueError):
                continue
        return found


def summarise(watch: Watch, begin: float, seconds: float) -> dict[str, Any]:
    """Figures of the whole soak."""
    nodes = {}
    for name, samples in watch.memory.items():
        t, mb = np.array([s for s in samples if s[0] > WARM_S] or samples).T
        slope = float(np.polyfit(t, mb, 1)[0] * 3600) if len(t) > 2 else float("nan")
        nodes[name] = {"start_mb": float(mb[0]), "end_mb": float(mb[-1]), "mb_per_hour": slope}
    drops = {
        node: {k.removeprefix("dropped: "): int(v) for k, v in values.items() if k.startswith("dropped: ")}
        for node, values in watch.values.items()
    }
    tracking, recon = watch.values.get("tracking", {}), watch.values.get("recon", {})
    return {
        "seconds": seconds,
        "first_pose_s": watch.first_pose - begin if watch.first_pose else None,
        "poses_heard": watch.poses,
        "poses_per_s": watch.poses / max(begin + seconds - watch.first_pose, 1e-9) if watch.first_pose else 0.0,
        "frames_tracked": int(tracking.get("frames tracked", 0)),
        "images_received": int(tracking.get("image received", 0)),
        "keyframes_sent": int(tracking.get("keyframes", 0)),
        "keyframes_taken": int(recon.get("keyframes", 0)),
        "keyframe_queue": int(recon.get("queue", 0)),
        "points": int(recon.get("points", 0)),
        "outages": [{"killed": name, "seconds": seconds} for name, seconds in watch.outages],
        "memory": nodes,
        "drops": drops,
    }


def soak(args: argparse.Namespace) -> dict[str, Any]:
    """Start the driver and the line, watch, end both."""
    from sf_bringup.launcher_env import node_environment

    # The driver too has the transports of docs/live.md: by default Fast DDS loses images of this size.
    environment = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", **node_environment()}
    os.environ.update(environment)
    with tempfile.TemporaryDirectory() as folder:
        frames, out = Path(folder) / "frames.npz", Path(folder) / "run"
        render(args.width, args.frames, frames)
        driver = [sys.executable, __file__, "--publish", str(frames), "--rate", str(args.rate)]
        goal = ["--goal", "recon", "--out", str(out), "--save-s", str(SAVE_S), *FAST]
        line = [sys.executable, "-m", "sf_bringup.cli", "up", *goal]
        children = [subprocess.Popen(driver, env=environment)]
        try:
            watch = Watch(out)
            watch.run(2.0, time.monotonic())
            begin = time.monotonic()
            children.append(subprocess.Popen(line, env=environment))
            watch.run(args.seconds, begin, args.kill_every)
            children[0].kill()  # what is on its way arrives before anything is counted
            watch.settle()
            result = summarise(watch, begin, args.seconds)
            children[1].send_signal(signal.SIGINT)
            result["exit_code"] = children[1].wait(timeout=2 * SAVE_S)
            stored = out / "trajectory.tum"
            result["poses_in_trajectory"] = len(stored.read_text().splitlines()) if stored.is_file() else 0
            result["map_mb"] = (out / "map.sfmap").stat().st_size / 1e6 if (out / "map.sfmap").is_file() else 0.0
        finally:
            for child in children:
                child.kill()
    return result


def main() -> int:
    """Soak, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--rate", type=float, default=15.0)
    parser.add_argument("--frames", type=int, default=100, help="of the walk, which is gone there and back again")
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--kill-every", type=float, default=0.0, metavar="S", help="SIGKILL a node each S seconds")
    parser.add_argument("--out", type=Path, default=Path("soak.json"))
    parser.add_argument("--publish", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.publish:
        publish(args.publish, args.rate)
    result = soak(args)
    args.out.write_text(json.dumps(result, indent=2))
    for key, value in result.items():
        if key not in ("memory", "drops", "outages"):
            print(f"{key:18} {value}")
    for outage in result["outages"]:
        print(f"killed {outage['killed']:11} back after {outage['seconds']:.1f} s")
    for name, m in result["memory"].items():
        print(f"memory {name:11} {m['start_mb']:7.0f} -> {m['end_mb']:7.0f} MB ({m['mb_per_hour']:+.0f} MB/h)")
    for node, reasons in result["drops"].items():
        for reason, count in reasons.items():
            print(f"drops {node:12} {count}x {reason}")
    lost = [r for r in result["drops"].get("recon", {}) if "keyframe dropped" in r or "never received" in r]
    return 1 if lost or result["exit_code"] else 0


if __name__ == "__main__":
    sys.exit(main())
