"""Multi-view depth of image sets in the paper's settings: c posed, d unposed, e unposed and uncalibrated.

    python benchmarks/depth.py [--scenes room0 office1] [--views 6] [--factor 0.4] [--oracle] [--out bench]

Errors are RobustMVD's (absrel, tau at 1.03), of each view with all the others as sources; c without alignment, d and e
after the median. --oracle adds the benchmark's choice of sources by their ground-truth error, for the first view.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import paper
from common import INFO, Benchmark, mean_row, print_rows, run_line, shrunk, simulated, thinned, without

from sf_bringup import measures
from sf_bringup.evaluation.robust_mvd import oracle_view_choice
from sf_bringup.run_folder import RunFolder
from sf_bringup.simulate import PRESETS
from sf_interfaces.errors import SceneFactoryError
from sf_interfaces.io.bag import BagReader
from sf_interfaces.io.datasets import ReadOptions
from sf_interfaces.types import Float64

SETTINGS = {"c": "none", "d": "median", "e": "median"}  # and their alignment


def run_setting(bag: Path, setting: str, out: Path) -> RunFolder:
    """The image set with as much knowledge as the setting allows."""
    given = without(bag, [INFO], "uncalibrated") if setting == "e" else bag
    return run_line(given, out, "mvd", reading=ReadOptions(use_poses=setting == "c"))


def score(run: RunFolder, alignment: str) -> dict[str, Any]:
    """RobustMVD with all views, and what else the depth block says about itself."""
    mvd = measures.measure_mvd(run, alignment=alignment)
    error = measures.measure_depth(run, alignment=alignment)
    return {
        "rel %": mvd["absrel"], "tau %": mvd["inlier"], "density %": mvd["density"], "rel % where dense": error.absrel,
        "within 1 sigma %": error.within_1_sigma, "ause": error.ause, "seconds": run.info()["seconds"],
    }  # fmt: skip


def oracle(bag: Path, setting: str, out: Path, count: int) -> dict[str, Any]:
    """The first view with the sources that its ground truth chooses."""
    key = _stamps(bag)[0]
    truth = next(measures.decoded(bag, measures.GROUND_TRUTH_DEPTH, measures.decode_depth, {key}))[1]

    def predict(sources: Sequence[int]) -> Float64:
        name = "".join(map(str, sources))
        run = run_setting(thinned(bag, [0, *sources], name), setting, out / name)
        return np.nan_to_num(dict(run.depth_maps())[key].z)

    best = oracle_view_choice(predict, range(1, count), np.nan_to_num(truth.z), SETTINGS[setting])
    return {"rel % oracle, first view": best.absrel, "tau % oracle": best.inlier, "sources": len(best.views)}


def _stamps(bag: Path) -> list[int]:
    with BagReader(bag) as reader:
        return [raw.stamp_ns for raw in reader.messages([measures.GROUND_TRUTH_POSE])]


def main() -> None:
    bench = Benchmark("depth", __doc__.splitlines()[0])
    bench.parser.add_argument("--scenes", nargs="+", default=["room0", "office1"], choices=sorted(PRESETS))
    bench.parser.add_argument("--views", type=int, default=6)
    bench.parser.add_argument("--stride", type=int, default=12, help="frames of 30 a second between two views")
    bench.parser.add_argument("--factor", type=float, default=0.4)
    bench.parser.add_argument("--oracle", action="store_true")
    args = bench.parse()
    bench.note("Simulated image sets; paper rows are on other data, with the oracle's choice of source views.")
    rows: list[dict[str, Any]] = []
    for scene in args.scenes:
        spec = shrunk(PRESETS[scene], args.views, args.stride, args.factor)
        bag, _ = simulated(replace(spec, depth="none", lidar="none", ground_truth_depth=True), args.out)
        for setting, alignment in SETTINGS.items():
            out = args.out / "depth" / f"{scene}-{setting}"
            cells: dict[str, Any]
            try:
                cells = score(run_setting(bag, setting, out), alignment)
                if args.oracle:
                    cells |= oracle(bag, setting, out / "oracle", args.views)
            except SceneFactoryError as error:
                cells = {"remark": f"line not available: {error}"}
            rows.append({"scene": scene, "setting": setting, "align": alignment, **cells})
            print_rows(rows[-1:])
    means = [mean_row([r for r in rows if r["setting"] == s], setting=s) for s in SETTINGS]
    bench.write("Multi-view depth", {"per scene": rows, "means": means, "paper": paper.mvd_rows()})


if __name__ == "__main__":
    main()
