"""Rooms like Replica's, RGB-D and mono: tracking, surface and views off and on the path, beside the paper's rows.

    python benchmarks/rooms.py [--rooms room0 office0] [--frames 40] [--stride 3] [--factor 0.25] [--out bench]
    python benchmarks/rooms.py --tracking --rooms ... --frames 400 --stride 5 --factor 0.5: whole walks, poses alone

The surface is scored where a view saw it, from samples to triangles, and between samples by NICE's protocol (culled
by frusta) and NICER's (not culled). Our rooms have furniture with hidden insides, which a frustum does not leave out
and Replica's scans do not have: the first is what compares with the paper's columns. Depth alone (flexion) is tracked
beside RGB-D.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import paper
from common import DEPTH, Benchmark, mean_row, print_rows, run_line, shrunk, simulated, without
from lines import LINES, derive
from paper import PAPER

from sf_bringup import measures
from sf_bringup.evaluation import trajectory_error
from sf_bringup.evaluation.lpips import Lpips
from sf_bringup.run_folder import RunFolder
from sf_bringup.simulate import PRESETS, SimulationSpec, Simulator
from sf_interfaces.errors import SceneFactoryError
from sf_interfaces.types import DepthMap, Float64, Frame, Trajectory
from sf_tracking.config import TrackingConfig
from sf_tracking.core.session import TrackingSession


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


def track(spec: SimulationSpec, kinds: Sequence[str]) -> dict[str, Any]:
    """ATE in cm of a walk that is tracked while it is rendered, and keeps no image."""
    simulator = Simulator(spec)
    sessions = {kind: TrackingSession(TrackingConfig()) for kind in kinds}
    true: list[tuple[int, Float64]] = []
    for index in range(spec.frames):
        image, z, T = simulator.frame(index)
        true.append((round((index + 1) * 1e9 / spec.fps), T))
        for kind, session in sessions.items():
            depth = DepthMap(z) if kind == "rgbd" else None
            session.track(Frame(true[-1][0], spec.camera, image, depth))
    cells: dict[str, Any] = {}
    for kind, session in sessions.items():
        session.finish()
        error = trajectory_error(
            session.trajectory(), Trajectory.from_pairs(true), alignment="se3" if kind == "rgbd" else "sim3"
        )
        cells |= {f"{kind} ATE cm": 100 * error.rmse, f"{kind} RPE mm": 1e3 * error.rpe_rmse}
        cells[f"{kind} tracked"] = f"{error.pairs}/{spec.frames}"
    return {**cells, "path m": error.path_length}


def track_all(bench: Benchmark, specs: dict[str, SimulationSpec], kinds: Sequence[str]) -> None:
    """Whole walks beside the paper's trajectories."""
    rows: list[dict[str, Any]] = []
    for room, spec in specs.items():
        rows.append({"room": room, **track(spec, kinds)})
        print_rows(rows[-1:])
    rows.append(mean_row(rows, room="mean"))
    print_rows(rows[-1:])
    bench.write("Walks through rooms like Replica's, tracked", {"walks": rows})


def main() -> None:
    bench = Benchmark("rooms", __doc__.splitlines()[0])
    bench.parser.add_argument("--rooms", nargs="+", default=["room0", "office0"], choices=paper.ROOMS)
    bench.parser.add_argument("--inputs", nargs="+", default=["rgbd", "mono"], choices=("rgbd", "mono"))
    bench.parser.add_argument("--frames", type=int, default=40)
    bench.parser.add_argument("--stride", type=int, default=3, help="take every n-th frame of 30 a second")
    bench.parser.add_argument("--factor", type=float, default=0.25, help="of Replica's 1200x680 pixels")
    bench.parser.add_argument("--tracking", action="store_true", help="poses alone, frame by frame")
    args = bench.parse()
    specs = {
        room: replace(shrunk(PRESETS[room], args.frames, args.stride, args.factor), depth="exact", novel_views=8)
        for room in args.rooms
    }
    bench.note(
        f"{args.frames} frames, every {args.stride}., at {args.factor} of 1200x680: simulated rooms with exact depth. "
        "Paper rows are for Replica's scans at full length and size on a GPU."
    )
    if args.tracking:
        return track_all(bench, specs, args.inputs)
    try:
        Lpips.find()
    except SceneFactoryError as error:
        bench.note(f"No LPIPS: {error}.")
    rows: list[dict[str, Any]] = []
    alone: list[dict[str, Any]] = []
    for room, spec in specs.items():
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
    return bench.write("Rooms like Replica's", tables)


if __name__ == "__main__":
    main()
