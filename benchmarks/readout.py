"""Readout of a rolling shutter: with which one the patches of the tracker agree best, from the images themselves.

python benchmarks/readout.py RECORDING [--parts 0:100 100:200] [--values 0 0.008 0.016 0.024 0.032] [--out bench]

A recording is a data set of `sf convert` or a bag that it made. Each part is tracked with each readout, with the depth
of the recording and without; by how much patches err more than their alignment claims is the table. The minimum of
the parabola through it is the readout. Parts should agree; where the camera hardly moves they cannot.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import Benchmark, load_frames, print_rows

from sf_bringup.inputs import convert
from sf_interfaces.io.bag import is_bag
from sf_interfaces.io.datasets import ReadOptions
from sf_interfaces.types import Frame
from sf_tracking.config import TrackingConfig
from sf_tracking.core.session import TrackingSession

VALUES = (0.0, 0.008, 0.016, 0.024, 0.032)  # s


def excess(frames: Sequence[Frame], readout: float, measured: bool) -> float:
    """Mean logarithm, over the frames, of what squared errors exceed their variance by."""
    session, found = TrackingSession(TrackingConfig(readout_s=readout)), []
    for frame in frames:
        update = session.track(replace(frame, depth=frame.depth if measured else None, T_map_camera=None))
        found += [np.log(update.excess)] if update.edges else []
    return float(np.mean(found))


def main() -> None:
    bench = Benchmark("readout", __doc__.splitlines()[0])
    bench.parser.add_argument("recording", type=Path)
    bench.parser.add_argument("--parts", nargs="+", default=["0:100", "100:200"], help="frames, first:last")
    bench.parser.add_argument("--values", nargs="+", type=float, default=list(VALUES), help="s, three or more")
    args = bench.parse()
    bag = args.recording
    if not is_bag(bag):
        bag = args.out / "readout.mcap"
        convert(args.recording, bag, ReadOptions())
    frames, rows = load_frames(bag), []
    for part in args.parts:
        first, last = map(int, part.split(":"))
        for measured in (True, False):
            costs = [excess(frames[first:last], value, measured) for value in args.values]
            square, line, _ = np.polyfit(args.values, costs, 2)
            rows.append(
                {"frames": part, "depth": measured, "best ms": -1e3 * line / (2 * square) if square > 0 else None}
            )
            rows[-1] |= {f"at {1e3 * v:g} ms": round(c, 3) for v, c in zip(args.values, costs, strict=True)}
            print_rows(rows[-1:])
    bench.write("Readout of a rolling shutter", {"readout": rows})


if __name__ == "__main__":
    main()
