"""A map of half a million points that is looked at while it learns: steps, frames a second, time to a PSNR, memory.

    python benchmarks/live_map.py --data FOLDER [--resolution 0.006] [--seconds 4] [--device cuda]

FOLDER holds ``rgbd_7scenes_*``. All keyframes but the last are placed and trained as a line does it. Then: optimiser
steps a second of the trainer alone; frames a second at 640x480 from the poses of held-out frames, with the JPEG of
the viewer, while the map rests and while it learns; and how long the last keyframes take from their arrival until
their view is drawn with 25 dB, and until the colour network alone, without the keyframes' images, has learnt that.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from itertools import cycle
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from colour import load
from common import Benchmark, print_rows

from sf_bringup.evaluation import psnr
from sf_interfaces.types import Keyframe
from sf_recon.config import ReconConfig
from sf_recon.core.device import DEVICES
from sf_recon.core.learner import FairLock, Learner
from sf_recon.core.memory import points_bytes
from sf_recon.core.reconstruction import Reconstruction

LAST = 5  # keyframes whose time to the goal is measured
PATIENCE = 10.0  # s


def per_second(call: Callable[[], Any], seconds: float) -> float:
    """Calls a second, after one that warms up."""
    call()
    started, count = time.perf_counter(), 0
    while time.perf_counter() - started < seconds:
        call()
        count += 1
    return count / (time.perf_counter() - started)


def drawing(built: Reconstruction, held: list[Keyframe], lock: AbstractContextManager[Any]) -> Callable[[], None]:
    """Draws the next held-out view as the viewer does it."""
    views = cycle(held)

    def draw() -> None:
        frame = next(views)
        with lock:
            image = built.render(frame.camera, frame.T_map_camera).image
        cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 85])

    return draw


def to_goal(
    built: Reconstruction, keys: list[Keyframe], lock: FairLock, patience: float
) -> tuple[list[float], list[float]]:
    """Seconds from the arrival of keyframes that come one after another until their view is drawn, and until the
    colour network alone shows them, with the PSNR of the goal; inf where patience ends before."""
    learner, drawn = Learner(built, lock), []
    for key in keys:
        came = time.monotonic()
        with lock:
            built.place(key)
        learner.arrived(key.stamp_ns, came)
        drawn.append(float("inf"))
        while time.monotonic() - came < patience and np.isinf(drawn[-1]):
            with lock:
                image = built.render(key.camera, key.T_map_camera).image
            if psnr(image, key.image) >= built.config.psnr_goal:
                drawn[-1] = time.monotonic() - came
        while key.stamp_ns not in learner.reached and time.monotonic() - came < patience:
            time.sleep(0.01)
    learner.stop()
    return drawn, [learner.reached.get(key.stamp_ns, float("inf")) for key in keys]


def main() -> None:
    """One row."""
    bench = Benchmark("live_map", __doc__ or "")
    bench.parser.add_argument("--data", type=Path, required=True, help="folder of real recordings")
    bench.parser.add_argument("--resolution", type=float, default=0.0055, help="m")
    bench.parser.add_argument("--frames", type=int, default=200)
    bench.parser.add_argument("--step", type=int, default=8, help="every n-th frame is a keyframe")
    bench.parser.add_argument("--seconds", type=float, default=4.0, help="of each measurement")
    bench.parser.add_argument("--device", default="cpu", choices=DEVICES, help="where the map is drawn and learnt")
    args = bench.parse()
    recording = next(iter(sorted(args.data.glob("rgbd_7scenes_*"))), None)
    if recording is None:
        bench.parser.error(f"{args.data} holds no rgbd_7scenes_* folder")
    keys, held = load(recording, args.frames, args.step)
    built = Reconstruction(ReconConfig(resolution=args.resolution, iterations=10, device=args.device))
    for key in keys[:-LAST]:
        built.add(key)
    assert built.points is not None
    resting = drawing(built, held, nullcontext())
    steps, paused = per_second(built.learn, args.seconds), per_second(resting, args.seconds)
    lock = FairLock()
    drawn, learnt = to_goal(built, keys[-LAST:], lock, PATIENCE)
    learner = Learner(built, lock)
    learner.arrived(0)
    learning = per_second(drawing(built, held, lock), args.seconds)
    learner.stop()
    finest = len(built.points.levels[0])
    row = {
        "device": torch.cuda.get_device_name() if args.device == "cuda" else "CPU",
        "points": finest,
        "steps / s": steps,
        "frames / s, map rests": paused,
        "frames / s, map learns": learning,
        "steps / s beside drawing": learner.timing()["iterations_per_s"],
        "s to 25 dB drawn, median": float(np.median(drawn)),
        "worst": max(drawn),
        "s to 25 dB by the network alone, median": float(np.median(learnt)),
        "worst ": max(learnt),
        "bytes / finest point": points_bytes(built.points, built._field, built._trainer) / finest,
    }
    print_rows([row])
    bench.write("A map that is looked at while it learns", {f"{len(keys)} keyframes": [row]})


if __name__ == "__main__":
    main()
