"""Rooms like Replica's, RGB-D and mono: tracking, surface and views off and on the path, beside the paper's rows.

    python benchmarks/rooms.py [--rooms room0 office0] [--frames 40] [--stride 3] [--factor 0.25] [--out bench]

The surface is scored with NICE culling (frusta) and, as NICER does, without.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import paper
from common import DEPTH, Benchmark, mean_row, print_rows, run_line, shrunk, simulated, without

from sf_bringup import measures
from sf_bringup.run_folder import RunFolder
from sf_bringup.simulate import PRESETS
from sf_interfaces.errors import SceneFactoryError


def score(run: RunFolder, mesh: Path) -> dict[str, Any]:
    """The table's cells of one run; what cannot be measured says why."""
    cells: dict[str, Any] = {}
    try:
        cells["ATE cm"] = 100 * measures.measure_trajectory(run).rmse
        errors = measures.measure_mesh(run, mesh)
        culled, unculled = errors["nice_culled"], errors["nicer_unculled"]
        cells |= {"acc cm": culled.accuracy, "comp cm": culled.completion, "ratio %": culled.completion_ratio}
        cells |= {"comp cm unculled": unculled.completion, "ratio % unculled": unculled.completion_ratio}
        views = measures.measure_render(run)
        cells |= {"PSNR": views["psnr_full"], "SSIM": views["ssim"], "LPIPS": views["lpips_alex"]}
        cells["PSNR surface"] = views["psnr_surface"]
        if isinstance(views["extrapolated"], dict):
            cells |= {f"{name} off path": views["extrapolated"][key] for name, key in _OFF_PATH.items()}
    except SceneFactoryError as error:
        cells["remark"] = str(error)
    return cells


_OFF_PATH = {"PSNR": "psnr_full", "SSIM": "ssim", "PSNR surface": "psnr_surface"}


def run_room(bag: Path, mesh: Path, out: Path) -> dict[str, Any]:
    """Reconstruct; where no line reaches that goal, track."""
    remark = {}
    try:
        run = run_line(bag, out, "recon")
    except SceneFactoryError as error:
        remark = {"remark": f"line not available: {error}"}
        try:
            run = run_line(bag, out, "tracking")
        except SceneFactoryError as worse:
            return {"remark": f"line not available: {worse}"}
    cells = score(run, mesh) | remark
    times = run.timing() or {"frame": {}}
    return {**cells, "ms / frame": times["frame"].get("median_ms", ""), "seconds": run.info()["seconds"]}


def main() -> None:
    bench = Benchmark("rooms", __doc__.splitlines()[0])
    bench.parser.add_argument("--rooms", nargs="+", default=["room0", "office0"], choices=paper.ROOMS)
    bench.parser.add_argument("--inputs", nargs="+", default=["rgbd", "mono"], choices=("rgbd", "mono"))
    bench.parser.add_argument("--frames", type=int, default=40)
    bench.parser.add_argument("--stride", type=int, default=3, help="take every n-th frame of 30 a second")
    bench.parser.add_argument("--factor", type=float, default=0.25, help="of Replica's 1200x680 pixels")
    args = bench.parse()
    bench.note(
        f"{args.frames} frames, every {args.stride}., at {args.factor} of 1200x680: simulated rooms with exact depth. "
        "Paper rows are for Replica's scans at full length and size on a GPU."
    )
    rows = []
    for room in args.rooms:
        spec = replace(shrunk(PRESETS[room], args.frames, args.stride, args.factor), depth="exact", novel_views=8)
        bag, mesh = simulated(spec, args.out)
        for kind in args.inputs:
            given = bag if kind == "rgbd" else without(bag, [DEPTH], "mono")
            cells = run_room(given, mesh, args.out / "rooms" / f"{room}-{kind}")
            rows.append({"room": room, "input": kind, "system": "this run", **cells})
            rows.append(paper.room_row(room, kind))
            print_rows(rows[-2:])
    ours = [row for row in rows if row["system"] == "this run"]
    means = []
    for kind in args.inputs:
        means.append(mean_row([r for r in ours if r["input"] == kind], system="this run", input=kind))
    bench.write("Rooms like Replica's", {"per room": rows, "means": [*means, *paper.other_rows()]})


if __name__ == "__main__":
    main()
