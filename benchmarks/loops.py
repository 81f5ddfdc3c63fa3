"""Loops: the end point of walks that come back, with and without closing them; a lost camera; memory over a long walk.

python benchmarks/loops.py [--walks room-rgbd hall-mono palace-rgbl garden-sweeps ...] [--seed 0] [--lost] [--memory N]

The walks are rendered frame by frame. ``rgbl``: depth at every second pixel with 1.5 cm of noise; ``sweeps``: those of
a spinning LiDAR with 64 lines, de-skewed by the motion tracked so far as ``sf run`` does it.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import resource
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from common import Benchmark, print_rows

from sf_bringup.simulate import PRESETS, SimulationSpec, Simulator
from sf_bringup.simulate.sensors import SWEEP_PHASE
from sf_bringup.simulate.simulator import T_CAMERA_LIDAR
from sf_interfaces.geometry import se3
from sf_interfaces.geometry.align import align
from sf_interfaces.geometry.lidar import deskew, project_sweep
from sf_interfaces.types import DepthMap, Float64, Frame, Scale, SparseDepth
from sf_tracking.config import TrackingConfig
from sf_tracking.core.session import TrackingSession

WALKS = {  # frames per s
    "room-rgbd": 10.0,
    "room-mono": 10.0,
    "hall-mono": 10.0,
    "palace-rgbl": 5.0,
    "garden-sweeps": 10.0,
}
AHEAD_DEG = 110.0  # what is made of a sweep: all that the camera can see
AGAIN_S = 6.0  # how long the walk goes on after the lap


class Walk:
    """A lap and a little more of a preset, rendered on demand."""

    def __init__(self, name: str, factor: float, seed: int | None = None) -> None:
        scene, self.kind = name.split("-")
        base, self.fps = PRESETS[scene], WALKS[name]
        size = {"width": round(base.width * factor), "height": round(base.height * factor)}
        self.spec: SimulationSpec = replace(
            base,
            fps=self.fps,
            focal=base.focal * factor,
            supersampling=1,
            lidar_hz=self.fps,
            lidar_fov_deg=AHEAD_DEG,
            seed=base.seed if seed is None else seed,
            **size,
        )
        self.simulator = Simulator(self.spec)
        lap_s = next(t for t in np.arange(5.0, 1e4, 0.05) if self._back(t))
        self.count = int((lap_s + AGAIN_S) * self.fps)
        self._rng = np.random.default_rng(0)

    def _back(self, t: float) -> bool:
        T = se3.inverse(self.simulator.path.pose(0.0)) @ self.simulator.path.pose(t)
        return bool(np.linalg.norm(T[:3, 3]) < 0.1 and np.trace(T[:3, :3]) > 2.99)

    def poses(self) -> Float64:
        """True T_map_camera of every frame."""
        return self.simulator.path.pose(np.arange(self.count) / self.fps)

    def frame(self, index: int, twist: Float64 | None = None) -> tuple[Frame, Float64]:
        """Frame number ``index`` and its true pose.

        Args:
            twist: [6] of the camera as tracked so far, by which a sweep is de-skewed.
        """
        image, z, T = self.simulator.frame(index)
        frame = Frame(round((index + 1) * 1e9 / self.fps), self.spec.camera, image)
        if self.kind == "rgbd":
            return replace(frame, depth=DepthMap(self.simulator.sensor_depth(index, z))), T
        if self.kind == "rgbl":
            grid = self.spec.camera.pixel_grid()[::2, ::2].reshape(-1, 2)
            far = z[::2, ::2].ravel().astype(np.float64)
            seen = np.isfinite(far) & (far > 0)
            noisy = far[seen] + self._rng.normal(0, 0.015, int(seen.sum()))
            return replace(frame, sparse_depth=SparseDepth(grid[seen], noisy)), T
        if self.kind == "sweeps":
            return replace(frame, sparse_depth=self._sweep(index, twist)), T
        return frame, T

    def _sweep(self, index: int, twist: Float64 | None) -> SparseDepth:
        cloud, _ = self.simulator.sweep(index)
        assert cloud.time_offset_ns is not None
        points = cloud.points.astype(np.float64)
        if twist is not None:
            after_ns = cloud.time_offset_ns - round(SWEEP_PHASE * 1e9 / self.fps)
            points = deskew(points, after_ns, se3.adjoint(se3.inverse(T_CAMERA_LIDAR)) @ twist)
        return project_sweep(points, self.spec.camera, T_CAMERA_LIDAR)


def end_point(stamps: Any, poses: Float64, truth: dict[int, Float64], scale: Scale) -> tuple[float, float]:
    """Error of the last pose, m, with the first tenth of the way laid on the truth; and the length of the way."""
    true = np.array([truth[t] for t in stamps])
    head = max(3, len(true) // 10)
    s, T = align(poses[:head, :3, 3], true[:head, :3, 3], scale is Scale.ARBITRARY)
    last = s * T[:3, :3] @ poses[-1, :3, 3] + T[:3, 3]
    way = np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1).sum()
    return float(np.linalg.norm(last - true[-1, :3, 3])), float(way)


def close(name: str, factor: float, seed: int | None = None) -> dict[str, Any]:
    """One walk, with and without loops."""
    walk = Walk(name, factor, seed)
    truth: dict[int, Float64] = {}
    sessions = {loops: TrackingSession(TrackingConfig(loops=loops)) for loops in (False, True)}
    closed, lost, each = 0, 0, []
    recent: list[tuple[int, Float64]] = []  # the last two stamps and poses without loops
    for index in range(walk.count):
        twist = se3.twist_between(*recent[0], *recent[1]) if len(recent) == 2 else None
        frame, truth[frame.stamp_ns] = walk.frame(index, twist)
        plain = sessions[False].track(frame).T_map_camera
        recent = [] if plain is None else [*recent, (frame.stamp_ns, plain)][-2:]
        begin = time.perf_counter()
        update = sessions[True].track(frame)
        each.append(1000 * (time.perf_counter() - begin))
        closed += update.correction is not None
        lost += update.T_map_camera is None
    row: dict[str, Any] = {
        "walk": name,
        "seed": walk.spec.seed,
        "frames": walk.count,
        "without pose": lost,
        "loops closed": closed,
    }
    for loops, session in sessions.items():
        session.finish()
        trajectory = session.trajectory()
        error, way = end_point(trajectory.stamps_ns.tolist(), trajectory.poses, truth, trajectory.scale)
        word = "with" if loops else "without"
        row |= {"path m": way, f"end {word} m": error, f"end {word} %": 100 * error / way}
    return row | {"median ms": float(np.median(each)), "p95 ms": float(np.percentile(each, 95))}


def lost(factor: float) -> dict[str, Any]:
    """Three seconds of black, after which the camera is where it was long ago."""
    walk, session = Walk("room-rgbd", factor), TrackingSession(TrackingConfig())
    count, dark = int(12 * walk.fps), int(3 * walk.fps)
    frames = [walk.frame(k)[0] for k in range(count)]
    for frame in frames:
        session.track(frame)
    shift, black = round((count + dark) * 1e9 / walk.fps), np.zeros_like(frames[0].image)
    for k in range(dark):
        stamp = frames[-1].stamp_ns + round((k + 1) * 1e9 / walk.fps)
        session.track(Frame(stamp, walk.spec.camera, black))
    again = [replace(f, stamp_ns=f.stamp_ns + shift) for f in frames[20:60]]
    poses = [session.track(frame).T_map_camera for frame in again]
    known = dict(zip((t := session.trajectory()).stamps_ns.tolist(), t.poses, strict=True))
    first = next((k for k, T in enumerate(poses) if T is not None), None)
    if first is None:
        return {"found after s": float("inf")}
    error = np.linalg.norm(
        [T[:3, 3] - known[f.stamp_ns][:3, 3] for T, f in zip(poses[first:], frames[20 + first :])], axis=1
    )
    return {"found after s": first / walk.fps, "mean error cm": 100 * float(error.mean())}


def memory(count: int) -> Iterator[dict[str, Any]]:
    """Resident memory while a camera walks rounds in a room, against the keyframes that are kept."""
    walk = Walk("room-rgbd", 0.25)
    lap = [walk.frame(k)[0] for k in range(walk.count - int(AGAIN_S * walk.fps))]
    session = TrackingSession(TrackingConfig(patches=60, window=4))
    for k in range(count):
        stamp = round((k + 1) * 1e9 / walk.fps)
        session.track(replace(lap[k % len(lap)], stamp_ns=stamp))
        if k % max(1, count // 10) == 0 or k == count - 1:
            resident = int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 1e6
            yield {"frames": k + 1, "keyframes": len(session.keyframe_trajectory()), "MB": resident}


def main() -> None:
    bench = Benchmark("loops", __doc__.splitlines()[0])
    bench.parser.add_argument("--walks", nargs="*", default=list(WALKS), choices=list(WALKS))
    bench.parser.add_argument("--factor", type=float, default=0.5, help="of the preset's image size")
    bench.parser.add_argument("--seed", type=int, help="of the walks and worlds; the preset's otherwise")
    bench.parser.add_argument("--lost", action="store_true", help="also a camera that sees nothing for three seconds")
    bench.parser.add_argument("--memory", type=int, default=0, help="also so many frames of rounds in a room")
    args = bench.parse()
    tables: dict[str, list[dict[str, Any]]] = {"walks": [], "lost": [], "memory": []}
    for name in args.walks:
        tables["walks"].append(close(name, args.factor, args.seed))
        print_rows(tables["walks"][-1:])
    if args.lost:
        tables["lost"].append(lost(args.factor))
        print_rows(tables["lost"])
    for row in memory(args.memory) if args.memory else ():
        tables["memory"].append(row)
        print_rows([row])
    bench.write("Loops", {k: rows for k, rows in tables.items() if rows})


if __name__ == "__main__":
    main()
