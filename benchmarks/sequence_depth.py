"""Dense depth of mono SLAM against a depth camera: what keyframes confirm, and what is filled in between.

python benchmarks/sequence_depth.py RECORDING [--readouts 0 0.024] [--out bench]

A recording is a data set of ``sf convert`` or a bag that it made; its colour images alone are tracked, with their
intrinsics, and its depth images are the reference. Images alone have no scale: ``kept`` and ``filled`` are measured
after the median ratio of each keyframe's kept depth, ``one scale`` after one for all.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from common import Benchmark, load_frames, print_rows

from sf_bringup.inputs import readout_of, resolve
from sf_depth.config import DepthConfig
from sf_depth.core.filling import Filler
from sf_depth.core.sequence import SequenceDepth, SlamSetting
from sf_interfaces.io.datasets import ReadOptions
from sf_interfaces.types import DepthMap, Float64, Frame, Keyframe
from sf_tracking.config import TrackingConfig
from sf_tracking.core.session import TrackingSession


class Remembered(Filler):
    """A filler that also keeps what it was given."""

    def __init__(self, config: DepthConfig) -> None:
        super().__init__(config)
        self.seen: list[Keyframe] = []

    def fill(self, keyframe: Keyframe) -> Keyframe:
        """As the filler does."""
        full = super().fill(keyframe)
        self.seen.append(keyframe)
        return full


def dense_keyframes(frames: Sequence[Frame], readout: float) -> list[tuple[DepthMap, DepthMap, DepthMap]]:
    """Of every keyframe with depth: that of the recording, what was confirmed, and all of it."""
    session = TrackingSession(TrackingConfig(readout_s=readout))
    config = DepthConfig(mode="slam")
    depth, filler = SequenceDepth(config, SlamSetting()), Remembered(config)
    depth._filler = filler  # the only place that sees depth before and after it is filled
    tracked = [session.track(replace(frame, depth=None, T_map_camera=None)) for frame in frames]
    sent = [keyframe for update in (*tracked, session.finish()) for keyframe in update.keyframes]
    full = [dense for keyframe in sent for dense in depth.add(keyframe)] + depth.finish()
    truth = {frame.stamp_ns: frame.depth for frame in frames}
    found = []
    for seen, dense in zip(filler.seen, full, strict=True):
        true = truth[dense.stamp_ns]
        assert true is not None and seen.depth is not None and dense.depth is not None
        found.append((true, seen.depth, dense.depth))
    return found


def errors(true: DepthMap, depth: DepthMap, scale: float, where: np.ndarray) -> tuple[Float64, Float64]:
    """Relative errors of some pixels, and the same in deviations."""
    assert depth.variance is not None
    z, sigma = scale * depth.z[where], scale * np.sqrt(depth.variance[where])
    off = np.abs(z - true.z[where]).astype(np.float64)
    return off / true.z[where], off / sigma


def measure(frames: Sequence[Frame], readout: float) -> dict[str, Any]:
    """One row."""
    kept, filled, scales = [], [], []
    found = dense_keyframes(frames, readout)
    for true, seen, full in found:
        known = true.valid & seen.valid
        scales.append(float(np.median(true.z[known] / seen.z[known])))
        kept.append(errors(true, seen, scales[-1], known))
        filled.append(errors(true, full, scales[-1], true.valid & ~seen.valid))
    one = float(np.median(scales))
    whole = [errors(true, seen, one, true.valid & seen.valid)[0] for true, seen, _ in found]
    cells: dict[str, Any] = {"readout ms": 1e3 * readout, "keyframes": len(found)}
    cells |= {"density %": 100 * float(np.mean([seen.density for _, seen, _ in found]))}
    for name, parts in (("kept", kept), ("filled", filled)):
        off, pull = (np.concatenate(column) for column in zip(*parts, strict=True))
        cells |= {f"{name} median rel %": 100 * float(np.median(off)), f"{name} rel %": 100 * float(off.mean())}
        cells |= {f"{name} {n} sigma %": 100 * float((pull < n).mean()) for n in (1, 2)}
    both = np.concatenate([off for off, _ in (*kept, *filled)])
    cells |= {"all median rel %": 100 * float(np.median(both)), "all rel %": 100 * float(both.mean())}
    cells |= {"one scale, kept median rel %": 100 * float(np.median(np.concatenate(whole)))}
    return cells | {"scales differ %": 100 * float(np.std(scales) / one)}


def main() -> None:
    bench = Benchmark("sequence_depth", __doc__.splitlines()[0])
    bench.parser.add_argument("recording", type=Path)
    bench.parser.add_argument("--readouts", nargs="+", type=float, help="s; without: as the bag says, and none")
    args = bench.parse()
    bag = resolve((args.recording,), args.out, ReadOptions()).bag
    frames = load_frames(bag)
    rows = []
    for readout in args.readouts or sorted({0.0, readout_of(bag)}):
        rows.append(measure(frames, readout))
        print_rows(rows[-1:])
    bench.write("Dense depth of mono SLAM", {"depth": rows})


if __name__ == "__main__":
    main()
