"""Poses in rooms with structured-light depth and motion blur, beside other programs on the same frames.

    python benchmarks/noise.py [--rooms room1 office4] [--frames 25] [--stride 2] [--factor 0.4] [--blur 0.01]

The noise of the depth is one of disparity, so at a smaller image it is larger in metres.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import open3d as o3d
import paper
from common import Benchmark, load_frames, print_rows, shrunk, simulated
from peers import ODOMETRY
from speed import OurTracker, measure_tracker, provide_vocabulary, side_by_side

from sf_bringup.simulate import PRESETS

OURS = "this project"
_PEERS = tuple(name for name in ODOMETRY if name != "kiss_icp_map")  # made for LiDAR; seconds a frame on such depth
_TRACKED = 0.9  # share of the frames that a peer has to track to be compared with


def against_best(room: str, rows: Sequence[Mapping[str, Any]], frames: int) -> dict[str, Any]:
    """This project's error in a room and that of the best peer which did not lose the camera."""
    scores = {
        str(row["system"]): float(row["ATE cm"])
        for row in rows
        if "ATE cm" in row and int(str(row["tracked"]).split("/")[0]) >= _TRACKED * frames
    }
    row: dict[str, Any] = {"room": room, "ATE cm": scores.pop(OURS, float("nan"))}
    if not scores:
        return {**row, "best peer": "none ran"}
    best = min(scores, key=lambda name: scores[name])
    return {**row, "best peer": best, "its ATE cm": scores[best], "ratio": row["ATE cm"] / scores[best]}


def main() -> None:
    bench = Benchmark("noise", __doc__.splitlines()[0])
    bench.parser.add_argument("--rooms", nargs="+", default=["room1", "office4"], choices=paper.ROOMS)
    bench.parser.add_argument("--frames", type=int, default=25)
    bench.parser.add_argument("--stride", type=int, default=2, help="take every n-th frame of 30 a second")
    bench.parser.add_argument("--factor", type=float, default=0.4, help="of Replica's 1200x680 pixels")
    bench.parser.add_argument("--blur", type=float, default=0.01, help="exposure, s")
    args = bench.parse()
    o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Error)
    provide_vocabulary(bench, args.out)
    bench.note(
        f"{args.frames} frames, every {args.stride}. of 30 a second, at {args.factor} of 1200x680 pixels, exposed for "
        f"{1e3 * args.blur:g} ms, with structured-light depth. Poses as they are known when a frame arrives."
    )
    rows, best = [], []
    for room in args.rooms:
        spec = shrunk(PRESETS[room], args.frames, args.stride, args.factor)
        frames = load_frames(simulated(replace(spec, depth="structured_light", blur=args.blur), args.out)[0])
        print(f" {room}", flush=True)
        found = side_by_side(OurTracker, _PEERS, frames, lambda make, frames=frames: measure_tracker(make, frames))
        rows += [{"room": room, **row} for row in found]
        best.append(against_best(room, found, len(frames)))
        print_rows(best[-1:])
    bench.write("Rooms with noise and blur, beside other programs", {"against the best peer": best, "all": rows})


if __name__ == "__main__":
    main()
