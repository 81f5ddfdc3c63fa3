"""Time per frame and accuracy of tracking and of fusion, beside other programs on the same frames.

    python benchmarks/speed.py [--frames 40] [--factor 0.5] [--scene room] [--out bench]

Every program gets the frames one by one from memory; the time is wall clock around its call.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import importlib.util
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import open3d as o3d
from common import Benchmark, load_frames, print_rows, shrunk, simulated
from peers import MAPPING, ODOMETRY, PeerMissing, load
from peers.orb_vocabulary import train

from sf_bringup.eval_files import read_surface
from sf_bringup.evaluation import Samples, psnr, ssim, surface_error, trajectory_error
from sf_bringup.pipeline import make_part
from sf_bringup.simulate import PRESETS
from sf_interfaces.config import ConfigFile
from sf_interfaces.errors import SceneFactoryError
from sf_interfaces.types import Float64, Frame, Keyframe, Trajectory


class OurTracker:
    """The tracking block behind the peers' protocol: poses as they are known when a frame arrives.

    Args:
        readout_s: of a rolling shutter.
    """

    def __init__(self, readout_s: float = 0.0) -> None:
        self._tracker = make_part("tracking", ConfigFile({"tracking": {"readout_s": readout_s}}))

    def track(self, frame: Frame) -> Float64 | None:
        return self._tracker.track(replace(frame, T_map_camera=None)).T_map_camera


class OurSurface:
    """The reconstruction block behind the peers' protocol."""

    def __init__(self) -> None:
        self._recon = make_part("recon", ConfigFile({}))

    def add(self, frame: Frame) -> None:
        self._recon.add(Keyframe(frame.stamp_ns, frame.camera, frame.image, frame.T_map_camera, frame.depth))

    def surface(self) -> Samples:
        self._recon.finish()
        return Samples(np.asarray(self._recon.surface().points, np.float64), np.zeros((0, 3), np.int64))

    def render(self, camera: Any, T: Float64) -> tuple[Any, Any]:
        view = self._recon.render(camera, T)
        return view.image, view.depth.valid


def measure_tracker(make: Callable[[], Any], frames: Sequence[Frame]) -> dict[str, Any]:
    """ATE after SE3 alignment of the poses given frame by frame, and the time of each call."""
    tracker, pairs, seconds = make(), [], []
    for frame in frames:
        start = time.perf_counter()
        T = tracker.track(frame)
        seconds.append(time.perf_counter() - start)
        if T is not None:
            pairs.append((frame.stamp_ns, np.array(T)))
    truth = Trajectory.from_pairs([(f.stamp_ns, f.T_map_camera) for f in frames])
    row = {"median ms": 1e3 * float(np.median(seconds)), "p95 ms": 1e3 * float(np.percentile(seconds, 95))}
    try:
        error = trajectory_error(Trajectory.from_pairs(pairs), truth)
        row |= {"ATE cm": 100 * error.rmse, "RPE mm": 1e3 * error.rpe_rmse, "RPE deg": error.rpe_rotation_rmse}
    except SceneFactoryError as error:
        row["remark"] = str(error)
    return {**row, "tracked": f"{len(pairs)}/{len(frames)}"}


def measure_mapper(make: Callable[[], Any], frames: Sequence[Frame], truth: Samples) -> dict[str, Any]:
    """Fuse every fourth frame at true poses; score the surface, and views in the middle between."""
    mapper, seconds = make(), []
    for frame in frames[::4]:
        start = time.perf_counter()
        mapper.add(frame)
        seconds.append(time.perf_counter() - start)
    camera, poses = frames[0].camera, np.array([f.T_map_camera for f in frames])
    surface = surface_error(mapper.surface(), truth, (camera, poses))
    scores, drawn = [], []
    for frame in frames[2::4][:10]:
        start = time.perf_counter()
        image, hit = mapper.render(camera, frame.T_map_camera)
        drawn.append(time.perf_counter() - start)
        scores.append((psnr(image, frame.image, hit), psnr(image, frame.image), ssim(image, frame.image)))
    on_surface, whole, similar = np.median(scores, axis=0)
    return {
        "median ms": 1e3 * float(np.median(seconds)), "render ms": 1e3 * float(np.median(drawn)),
        "acc cm": surface.accuracy, "comp cm": surface.completion, "ratio %": surface.completion_ratio,
        "PSNR surface": float(on_surface), "PSNR": float(whole), "SSIM": float(similar),
    }  # fmt: skip


def side_by_side(ours: Callable[[], Any], modules: tuple[str, ...], frames: Sequence[Frame],
                 measure: Callable[[Callable[[], Any]], dict[str, Any]]) -> list[dict[str, Any]]:  # fmt: skip
    """One row for this project and for each peer that can run here; the others say why not."""
    found, missing = load(modules, frames[0].camera)
    rows: list[dict[str, Any]] = []
    for name, make in {"this project": ours, **found}.items():
        try:
            rows.append({"system": name, **measure(make)})
        except PeerMissing as reason:
            rows.append({"system": name, "remark": str(reason)})
        except (RuntimeError, cv2.error, ValueError) as error:  # what another program raises costs its own row alone
            if make is ours:
                raise
            rows.append({"system": name, "remark": f"failed: {' '.join(str(error).split())[:120]}"})
        print_rows(rows[-1:])
    return rows + [{"system": name, "remark": reason} for name, reason in missing.items()]


def provide_vocabulary(bench: Benchmark, out: Path) -> None:
    """Where ORB-SLAM3 is installed without its words, give it those of a scene that is not measured."""
    if not importlib.util.find_spec("pyorbslam3") or "ORB_VOCABULARY" in os.environ:
        return
    path = out / "data" / "orb_vocabulary.txt"
    if not path.is_file():
        bag, _ = simulated(replace(shrunk(PRESETS["hall"], 16, 60, 0.5), depth="exact"), out)
        train([frame.image for frame in load_frames(bag)], path)
    os.environ["ORB_VOCABULARY"] = str(path)
    bench.note("ORB-SLAM3 uses a small vocabulary trained on another scene; ORB_VOCABULARY names another.")


def main() -> None:
    bench = Benchmark("speed", __doc__.splitlines()[0])
    bench.parser.add_argument("--scene", default="room", choices=sorted(PRESETS))
    bench.parser.add_argument("--frames", type=int, default=40)
    bench.parser.add_argument("--stride", type=int, default=2)
    bench.parser.add_argument("--factor", type=float, default=0.5)
    bench.parser.add_argument("--skip-fusion", action="store_true")
    args = bench.parse()
    o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Error)
    spec = replace(shrunk(PRESETS[args.scene], args.frames, args.stride, args.factor), depth="tof")
    bag, mesh = simulated(spec, args.out)
    frames = load_frames(bag)
    provide_vocabulary(bench, args.out)
    bench.note(f"{len(frames)} RGB-D frames of '{args.scene}' at {spec.width}x{spec.height}, time-of-flight noise.")
    tables = {"tracking": side_by_side(OurTracker, ODOMETRY, frames, lambda make: measure_tracker(make, frames))}
    if not args.skip_fusion:
        truth = read_surface(mesh)
        fusion = side_by_side(OurSurface, MAPPING, frames, lambda make: measure_mapper(make, frames, truth))
        tables["fusion at true poses"] = fusion
    bench.write("Speed and accuracy beside other programs, same frames", tables)


if __name__ == "__main__":
    main()
