"""Rooms like Replica's, RGB-D and mono: tracking, surface and views off and on the path, beside the paper's rows.

    python benchmarks/rooms.py [--rooms room0 office0] [--frames 40] [--stride 3] [--factor 0.25] [--out bench]

The surface is scored where a view saw it, from samples to triangles, and between samples by NICE's protocol (culled
by frusta) and NICER's (not culled). Our rooms have furniture with hidden insides, which a frustum does not leave out
and Replica's scans do not have: the first is what compares with the paper's columns. Depth alone (flexion) is tracked
beside RGB-D.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import paper
from common import DEPTH, Benchmark, mean_row, print_rows, run_line, shrunk, simulated, without
from lines import LINES, derive
from paper import PAPER

from sf_bringup import measures
from sf_bringup.evaluation.image import Lpips
from sf_bringup.run_folder import RunFolder
from sf_bringup.simulate import PRESETS
from sf_interfaces.errors import SceneFactoryError


def score(run: RunFolder, mesh: Path) -> dict[str, Any]:
    """The table's cells of one run; what cannot be measured says why."""
    cells: dict[str, Any] = {}
    try:
        cells["ATE cm"] = 100 * measures.measure_trajectory(run).rmse
        errors = measures.measure_mesh(run, mesh)
        for name, suffix in _SURFACES.items():
            found = errors[name]
            cells |= {f"acc cm{suffix}": found.accuracy, f"comp cm{suffix}": found.completion}
            cells[f"ratio %{suffix}"] = found.completion_ratio
        views = measures.measure_render(run)
        cells |= {"PSNR": views["psnr_full"], "SSIM": views["ssim"], "LPIPS": _number(views["lpips_alex"])}
        cells["PSNR surface"] = views["psnr_surface"]
        if isinstance(views["extrapolated"], dict):
            cells |= {f"{name} off path": views["extrapolated"][key] for name, key in _OFF_PATH.items()}
    except SceneFactoryError as error:
        cells["remark"] = str(error)
    return cells


def _number(value: float | str) -> float | str:
    """A number, or a dash for what the note above the table says is missing."""
    return value if isinstance(value, float) else "-"


_SURFACES = {"seen": "", "nice_culled": " NICE", "nicer_unculled": " NICER"}
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


def depth_alone(bag: Path, out: Path) -> float:
    """ATE in cm of the same walk tracked by its depth images alone."""
    line = next(line for line in LINES if line.name == "depth-only SLAM")
    run = run_line(derive(bag, line, bag.with_name(f"{bag.stem}-depth.mcap")), out, "tracking")
    return 100 * measures.measure_trajectory(run).rmse


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
    try:
        Lpips.find()
    except SceneFactoryError as error:
        bench.note(f"No LPIPS: {error}.")
    rows: list[dict[str, Any]] = []
    alone: list[dict[str, Any]] = []
    for room in args.rooms:
        spec = replace(shrunk(PRESETS[room], args.frames, args.stride, args.factor), depth="exact", novel_views=8)
        bag, mesh = simulated(spec, args.out)
        for kind in args.inputs:
            given = bag if kind == "rgbd" else without(bag, [DEPTH], "mono")
            cells = run_room(given, mesh, args.out / "rooms" / f"{room}-{kind}")
            rows.append({"room": room, "input": kind, "system": "this run", **cells})
            rows.append(paper.room_row(room, kind))
            print_rows(rows[-2:])
            if kind == "rgbd":
                ate = depth_alone(bag, args.out / "rooms" / f"{room}-depth")
                alone.append({"room": room, "RGB-D ATE cm": cells["ATE cm"], "depth alone ATE cm": ate})
    means = [
        mean_row([r for r in rows if (r["system"], r["input"]) == (system, kind)], system=system, input=kind)
        for kind in args.inputs
        for system in ("this run", PAPER)
    ]
    columns = [row for kind in args.inputs for row in paper.columns(*(m for m in means if m["input"] == kind))]
    print_rows(columns)
    tables = {"this run | paper": columns, "per room": rows, "means": [*means, *paper.other_rows()]}
    if alone:
        tables["depth alone"] = [*alone, mean_row(alone, room="mean")]
    bench.write("Rooms like Replica's", tables)


if __name__ == "__main__":
    main()
