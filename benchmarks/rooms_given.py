"""Rooms like Replica's with poses and depth given: the surface, and views on and off the path that were not used.

    python benchmarks/rooms_given.py [--rooms room0 ...] [--frames 100] [--stride 5] [--factor 0.5] [--every 2]

Every ``--every``-th frame is a keyframe; frames half-way between are rendered and compared. The surface is scored
where it was seen, from samples to triangles, and by NICE's protocol, whose floor (the reference against itself)
stands beside it.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import paper
from common import Benchmark, mean_row, print_rows, run_line, shrunk, simulated, thinned

from sf_bringup import measures
from sf_bringup.eval_files import read_surface
from sf_bringup.evaluation import surface_error
from sf_bringup.evaluation.lpips import Lpips
from sf_bringup.run_folder import RunFolder
from sf_bringup.simulate import PRESETS
from sf_interfaces.errors import SceneFactoryError
from sf_interfaces.io.trajectory import write_tum
from sf_interfaces.types import Trajectory

VIEWS = 24  # held-out views rendered per room


def score(run: RunFolder, bag: Path, mesh: Path, truth: Trajectory, every: int) -> dict[str, Any]:
    """The table's cells of one run."""
    camera, reference = run.camera(), read_surface(mesh)
    given = truth.poses[::every]
    errors = measures.surface_errors(read_surface(run.path / "mesh.ply"), reference, (camera, given))
    seen, nice = errors["seen"], errors["nice_culled"]
    floor = surface_error(reference, reference, (camera, given))
    between = np.arange(every // 2, len(truth.stamps_ns) - every // 2, every)
    held = between[:: max(1, len(between) // VIEWS)]
    pose_of = {int(truth.stamps_ns[k]): truth.poses[k] for k in held}
    on_path = measures.render_scores(measures.render_at(run, bag, "/camera/color/image_raw", pose_of))
    off_path = measures.render_scores(measures.render_novel(run, bag))
    return {
        "acc cm": seen.accuracy,
        "comp cm": seen.completion,
        "ratio %": seen.completion_ratio,
        "acc / comp cm, NICE": f"{nice.accuracy:.2f} / {nice.completion:.2f}",
        "floor": f"{floor.accuracy:.2f} / {floor.completion:.2f}",
        "ratio %, NICE": nice.completion_ratio,
        **{name: on_path[key] for name, key in _COLUMNS.items() if isinstance(on_path[key], float)},
        **{f"{name} off path": off_path[key] for name, key in _COLUMNS.items() if isinstance(off_path[key], float)},
        "covered %": on_path["covered"],
    }


_COLUMNS = {"PSNR": "psnr_full", "SSIM": "ssim", "LPIPS": "lpips_alex", "PSNR surface": "psnr_surface"}


def main() -> None:
    """One row per room, then the mean."""
    bench = Benchmark("rooms_given", __doc__.splitlines()[0])
    bench.parser.add_argument("--rooms", nargs="+", default=["room0", "office0"], choices=paper.ROOMS)
    bench.parser.add_argument("--frames", type=int, default=100)
    bench.parser.add_argument("--stride", type=int, default=5, help="take every n-th frame of 30 a second")
    bench.parser.add_argument("--factor", type=float, default=0.5, help="of Replica's 1200x680 pixels")
    bench.parser.add_argument("--every", type=int, default=2, help="every n-th frame taken is a keyframe")
    bench.parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="of section recon")
    args = bench.parse()
    overrides = {f"recon.{key}": value for key, value in (pair.split("=", 1) for pair in args.set)}
    rows = []
    for room in args.rooms:
        spec = replace(shrunk(PRESETS[room], args.frames, args.stride, args.factor), depth="exact", novel_views=8)
        bag, mesh = simulated(spec, args.out)
        truth = measures.reference_trajectory(bag)
        assert truth is not None
        keyframes = thinned(bag, range(0, args.frames, args.every), f"every{args.every}")
        out = args.out / "rooms_given" / room
        out.mkdir(parents=True, exist_ok=True)
        write_tum(out / "given.tum", truth)
        run = run_line(keyframes, out, "recon", poses=out / "given.tum", overrides=overrides)
        rows.append({"room": room, **score(run, bag, mesh, truth, args.every), "seconds": run.info()["seconds"]})
        print_rows(rows[-1:])
    bench.note(
        f"{args.frames} frames, every {args.stride}., at {args.factor} of 1200x680, every {args.every}. a keyframe: "
        "simulated rooms with exact poses and depth."
    )
    try:
        Lpips.find()
    except SceneFactoryError as error:
        bench.note(f"No LPIPS: {error}.")
    bench.write(
        "Rooms like Replica's, poses and depth given", {"per room": rows, "mean": [mean_row(rows, room="mean")]}
    )


if __name__ == "__main__":
    main()
