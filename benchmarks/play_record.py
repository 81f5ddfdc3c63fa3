"""Throughput of player -> recorder in separate processes: VGA colour and depth at a multiple of 30 Hz.

The images are crops of a smooth random texture with sensor noise, so they compress about as camera images
do. A rate counts as sustained when no message is lost, the recording took no longer than it should, and little
waited for the disk at its end.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import argparse
import json
import os
import platform
import signal
import subprocess
import sys
import tempfile
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sf_bringup.launcher_env import node_environment
from sf_interfaces.io.bag import BagReader
from sf_interfaces.io.sequence_writer import SequenceWriter
from sf_interfaces.types import DepthMap

_DRAIN_S = 1.5  # closing the nodes takes 0.5 s; longer means that the writer lagged behind the topics
_START = 1_700_000_000_000_000_000
_TOPICS = ("/camera/color/image_raw", "/camera/depth/image_raw")


def write_input(path: Path, frames: int) -> None:
    """A bag of VGA images, uncompressed, so that reading it costs little."""
    rng = np.random.default_rng(0)
    texture = np.zeros((560, 720, 3))
    for scale in (4, 16, 64, 256):
        grid = rng.random((560 // scale + 2, 720 // scale + 2, 3))
        texture += cv2.resize(grid, (720, 560), interpolation=cv2.INTER_CUBIC) * scale**0.6
    texture = 255 * (texture - texture.min()) / np.ptp(texture)
    with SequenceWriter(path, compression="") as writer:
        for i in range(frames):
            stamp, x, y = _START + i * 33_333_333, i % 80, i % 60
            crop = texture[y : y + 480, x : x + 640]
            noisy = np.clip(crop + rng.normal(0, 2, crop.shape), 0, 255).astype(np.uint8)
            z = 1 + crop[..., 0] / 100
            depth = DepthMap(z + rng.normal(0, 1, z.shape) * 0.0015 * z**2)
            writer.image(_TOPICS[0], stamp, noisy, "cam")
            writer.depth(_TOPICS[1], stamp, depth, "cam")


def measure(bag: Path, rate: float, compression: str, domain: int) -> dict[str, Any]:
    """Play at a rate into a recorder; what was lost and how long it took."""
    environment = node_environment(domain) | {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    out = bag.with_name("out.mcap")
    record = [sys.executable, "-m", "sf_bringup.recorder", str(out), "--json", "--compression", compression]
    recorder = subprocess.Popen(
        [*record, "--topics", *_TOPICS], env=environment, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    )
    command = [sys.executable, "-m", "sf_bringup.player", str(bag), "--rate", str(rate)]
    try:
        subprocess.run(command, env=environment, check=True, stdout=subprocess.DEVNULL)
        time.sleep(1.0)
        stopped = time.monotonic()
        recorder.send_signal(signal.SIGINT)
        output = recorder.communicate(timeout=120)[0]
        drain = time.monotonic() - stopped
    finally:
        recorder.kill()
    result: dict[str, Any] = json.loads(output)
    with BagReader(bag) as source:
        sent = {t: source.topics[t].count for t in _TOPICS}
        expected = (source.end_ns - source.start_ns) / 1e9 / rate
    got = {t: result["topics"].get(t, {}).get("count", 0) for t in _TOPICS}
    size = sum(s["bytes"] for s in result["topics"].values())
    lost = sum(sent.values()) - sum(got.values())
    seconds = result["seconds"]
    return {
        "rate": rate, "compression": compression, "sent": sum(sent.values()), "lost": lost,
        "MB_per_s": size / 1e6 / seconds, "seconds": seconds, "expected_seconds": expected,
        "drain_seconds": drain, "ratio": size / result["file_bytes"],
        "sustained": lost == 0 and seconds < 1.05 * expected + 0.1 and drain < _DRAIN_S,
    }  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--rates", type=float, nargs="+", default=[1, 3, 4, 5, 6])
    parser.add_argument("--out", type=Path, default=Path("play_record.json"))
    given = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "in.mcap"
        write_input(bag, given.frames)
        for compression in ("none", "zstd"):
            for rate in given.rates:
                rows.append(measure(bag, rate, compression, 100 + len(rows)))
                print({k: round(v, 2) if isinstance(v, float) else v for k, v in rows[-1].items()}, flush=True)
                if not rows[-1]["sustained"]:
                    break
    report = {
        "machine": {"cpus": os.cpu_count(), "cpu": platform.processor(), "python": platform.python_version()},
        "versions": {name: version(name) for name in ("ros-rclpy", "ros-fastrtps", "rosbags", "mcap", "zstandard")},
        "results": rows,
    }
    given.out.write_text(json.dumps(report, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
