"""Readout of a rolling shutter: with which one the patches of the tracker agree best, from the images themselves.

python benchmarks/readout.py [RECORDING] [--parts 0:100 100:200] [--values 0 0.008 0.016 0.024 0.032] [--out bench]

A recording is a data set of `sf convert` or a bag that it made; without one, a simulated walk with a shaking camera
whose readout is 20 ms is measured, and how much it matters. Each part is tracked with each readout, with the depth of
the recording and without; by how much patches err more than their alignment claims is the table. The minimum of the
parabola through it is the readout. Parts should agree; where the camera hardly moves, or evenly, they cannot.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from common import Benchmark, load_frames, print_rows

from sf_bringup.evaluation import trajectory_error
from sf_bringup.inputs import resolve
from sf_bringup.simulate import SimulationSpec, Simulator
from sf_bringup.simulate.trajectories import CameraPath
from sf_interfaces.geometry import se3
from sf_interfaces.io.datasets import ReadOptions
from sf_interfaces.types import DepthMap, Float64, Frame, Trajectory
from sf_tracking.config import TrackingConfig
from sf_tracking.core.session import TrackingSession

VALUES = (0.0, 0.008, 0.016, 0.024, 0.032)  # s
SIMULATED, FRAMES = 0.02, 60  # s, and how many
# Of the simulated hand: deg and Hz about x, y and z of the camera.
SHAKE_DEG, SHAKE_HZ = np.array([2.0, 3.0, 2.0]), np.array([1.7, 1.3, 1.1])


class Shaken:
    """A path whose camera shakes."""

    def __init__(self, path: CameraPath) -> None:
        self._path = path

    def pose(self, t: float | Float64) -> Float64:
        """As that of the path, [...] s -> [..., 4, 4]."""
        t = np.asarray(t, dtype=np.float64)
        turn = np.radians(SHAKE_DEG) * np.sin(2 * np.pi * SHAKE_HZ * t[..., None] + np.arange(3))
        return self._path.pose(t) @ se3.exp(np.concatenate([np.zeros_like(turn), turn], axis=-1))


def shaken() -> list[Frame]:
    """A simulated walk, with exact depth."""
    spec = SimulationSpec("lounge", width=320, height=240, focal=240.0, supersampling=1, readout=SIMULATED)
    simulator = Simulator(spec)
    simulator.path = Shaken(simulator.path)  # type: ignore[assignment]
    frames = []
    for k in range(FRAMES):
        image, z, T = simulator.frame(k)
        frames.append(Frame(1_000_000_000 + round(1e9 * k / spec.fps), spec.camera, image, DepthMap(z), None, T))
    return frames


def tracked(frames: Sequence[Frame], readout: float, measured: bool) -> tuple[float, float]:
    """Mean logarithm, over the frames, of what squared errors exceed their variance by; and the ATE, m."""
    session, found = TrackingSession(TrackingConfig(readout_s=readout)), []
    for frame in frames:
        update = session.track(replace(frame, depth=frame.depth if measured else None, T_map_camera=None))
        found += [np.log(update.excess)] if update.edges else []
    session.finish()
    truth = Trajectory.from_pairs([(f.stamp_ns, f.T_map_camera) for f in frames if f.T_map_camera is not None])
    error = trajectory_error(session.trajectory(), truth, alignment="se3" if measured else "sim3")
    return float(np.mean(found)), error.rmse


def row(frames: Sequence[Frame], part: str, measured: bool, values: Sequence[float]) -> dict[str, Any]:
    """What one part says."""
    first, last = map(int, part.split(":"))
    costs, errors = zip(*(tracked(frames[first:last], value, measured) for value in values), strict=True)
    square, line, _ = np.polyfit(values, costs, 2)
    cells: dict[str, Any] = {"frames": part, "depth": measured}
    cells["best ms"] = -1e3 * line / (2 * square) if square > 0 else None
    for value, cost, error in zip(values, costs, errors, strict=True):
        cells |= {f"at {1e3 * value:g} ms": round(cost, 3), f"ATE cm at {1e3 * value:g} ms": round(100 * error, 2)}
    return cells


def main() -> None:
    bench = Benchmark("readout", __doc__.splitlines()[0])
    bench.parser.add_argument("recording", type=Path, nargs="?")
    bench.parser.add_argument("--parts", nargs="+", help="frames, first:last")
    bench.parser.add_argument("--values", nargs="+", type=float, default=list(VALUES), help="s, three or more")
    args = bench.parse()
    if args.recording is None:
        frames, parts = shaken(), [f"0:{FRAMES}"]
    else:
        frames, parts = load_frames(resolve((args.recording,), args.out, ReadOptions()).bag), ["0:100", "100:200"]
    rows = []
    for part in args.parts or parts:
        for measured in (True, False):
            rows.append(row(frames, part, measured, args.values))
            print_rows(rows[-1:])
    bench.write("Readout of a rolling shutter", {"readout": rows})


if __name__ == "__main__":
    main()
