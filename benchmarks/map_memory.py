"""What the map of a palace and of a campus weighs: exact depth and poses of keyframes spread over the whole path.

    python benchmarks/map_memory.py [--scenes palace campus] [--keyframes 40] [--assumed 300]

Each keyframe gets one training step, so that the optimiser's moments are there. Keyframes come in an order in which
each lies half-way between earlier ones. So the growth over the last half is that of a keyframe put between others,
and extrapolating by it to ``--assumed`` keyframes on the same path is too much rather than too little. Exact depth
without a variance is the heaviest case, an uncertain one places fewer points.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import Any

from common import Benchmark, print_rows

from sf_bringup.simulate import PRESETS
from sf_bringup.simulate.simulator import Simulator
from sf_interfaces.types import DepthMap, Keyframe
from sf_recon.config import ReconConfig
from sf_recon.core.reconstruction import Reconstruction


def spread(frames: int, count: int) -> list[int]:
    """``count`` frame numbers over the whole path, each half-way between earlier ones (van der Corput's sequence)."""
    fractions = [sum((k >> bit & 1) / 2 ** (bit + 1) for bit in range(k.bit_length())) for k in range(count)]
    return [int(fraction * frames) for fraction in fractions]


def grown(scene: str, count: int) -> tuple[Reconstruction, list[int]]:
    """The map of ``count`` keyframes and its weight in bytes after each."""
    spec = PRESETS[scene]
    simulator, built, weights = Simulator(spec), Reconstruction(ReconConfig()), []
    for index in spread(spec.frames, count):
        image, z, T = simulator.frame(index)
        built.place(Keyframe(index, spec.camera, image, T, DepthMap(z)))
        built.learn()
        weights.append(built.nbytes)
    return built, weights


def main() -> None:
    """One row per scene."""
    bench = Benchmark("map_memory", __doc__ or "")
    bench.parser.add_argument("--scenes", nargs="+", default=["palace", "campus"], choices=sorted(PRESETS))
    bench.parser.add_argument("--keyframes", type=int, default=40)
    bench.parser.add_argument("--assumed", type=int, default=300, help="keyframes to extrapolate to")
    args = bench.parse()
    rows: list[dict[str, Any]] = []
    for scene in args.scenes:
        built, weights = grown(scene, args.keyframes)
        assert built.points is not None
        images = sum(view.nbytes for view in built.views)
        half = len(weights) // 2
        growth = (weights[-1] - weights[half]) / (len(weights) - 1 - half)
        levels = [len(level) for level in built.points.levels]
        rows.append({
            "scene": scene,
            "keyframes": args.keyframes,
            "resolution m": built.resolution,
            "points by level": " / ".join(map(str, levels)),
            "points MB": (weights[-1] - images) / 1e6,
            "bytes / finest point": (weights[-1] - images) / levels[0],
            "keyframes MB": images / 1e6,
            "MB / further keyframe": growth / 1e6,
            f"MB at {args.assumed}, extrapolated": (weights[-1] + growth * (args.assumed - args.keyframes)) / 1e6,
        })  # fmt: skip
        print_rows(rows[-1:])
    bench.write("Weight of large maps", {"per scene": rows})


if __name__ == "__main__":
    main()
