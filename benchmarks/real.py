"""Every real recording of a folder: what the line makes of it, against the reference it brings.

    python benchmarks/real.py --data FOLDER [--frames 40] [--out bench]

From 7-Scenes every fifth frame (``--full``: every one, too) also goes to other programs, and a flight through its map
is drawn for the report. Besides recordings, trajectories of other systems (``trajectories_evo``) are measured against
their ground truth, a textured Gazebo world (``mesh_small_house``) is rendered as RGB-D and RGB-L, and COLMAP, where
installed, gets the photo set with ground-truth cameras.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
from common import Benchmark, load_frames, print_rows, run_line, simulated
from peers import ODOMETRY, PHOTO_SETS, SWEEPS, PeerMissing, load
from speed import OurTracker, measure_tracker, provide_vocabulary, side_by_side

from sf_bringup import measures
from sf_bringup.bench_report import FLIGHT
from sf_bringup.eval_files import read_trajectory
from sf_bringup.evaluation import align_trajectories, trajectory_error
from sf_bringup.flythrough import fly
from sf_bringup.inputs import readout_of
from sf_bringup.preflight import static_frames
from sf_bringup.run_folder import RunFolder
from sf_bringup.simulate import SimulationSpec
from sf_interfaces.errors import SceneFactoryError
from sf_interfaces.geometry import se3
from sf_interfaces.io import datasets
from sf_interfaces.io.bag import BagReader
from sf_interfaces.io.datasets import ReadOptions
from sf_interfaces.io.datasets.dataset import LIDAR
from sf_interfaces.ros.clouds import decode_cloud
from sf_interfaces.types import Float64, Frame, Scale, Trajectory

# Recording -> goal; what else lies in the folder is tried with the goal that suits it.
KITCHEN = "rgbd_7scenes_redkitchen_000_199"
STREET = "rgbl_kitti_odometry04_000_017"
GOALS = {KITCHEN: "recon", STREET: "recon"}
FRAMES = {KITCHEN: 200}  # at least
TRAJECTORIES = (
    ("freiburg1_xyz-groundtruth.txt", "freiburg1_xyz-rgbdslam.txt", "se3"),
    ("freiburg1_xyz-groundtruth.txt", "freiburg1_xyz-rgbdslam_drift.txt", "se3"),
    ("freiburg1_xyz-groundtruth.txt", "freiburg1_xyz-ORB_kf_mono.txt", "sim3"),
    ("KITTI_00_gt.txt", "KITTI_00_ORB.txt", "sim3"),
)


def score(run: RunFolder) -> dict[str, Any]:
    """Every measure that the recording has a reference for; the others are left out."""
    cells: dict[str, Any] = {"line": " -> ".join(run.info()["line"])}
    parts: tuple[Callable[[], dict[str, Any]], ...] = (
        lambda: _trajectory(run),
        lambda: _depth(run),
        lambda: {"held-out MAE m": measures.measure_completion(run, 0.5).mae},
        lambda: {"PSNR surface": measures.render_scores(measures.render_held_out(run))["psnr_surface"]},
    )
    for part in parts:
        try:
            cells |= part()
        except SceneFactoryError:
            continue  # the report of the run says why
    return {**cells, "seconds": run.info()["seconds"]}


def _trajectory(run: RunFolder) -> dict[str, Any]:
    error = measures.measure_trajectory(run)
    return {
        "ATE cm": 100 * error.rmse,
        "RPE deg": error.rpe_rotation_rmse,
        "frames": error.pairs,
        "path m": error.path_length,
    }


def _depth(run: RunFolder) -> dict[str, Any]:
    error = measures.measure_depth(run)
    return {"depth rel %": error.absrel, "tau %": error.inlier, "depth MAE m": error.mae}


def recordings(data: Path) -> list[Path]:
    """Folders that are a data set."""
    found = []
    for folder in sorted(p for p in data.iterdir() if p.is_dir()):
        try:
            datasets.recognise(folder)
            found.append(folder)
        except SceneFactoryError:
            continue
    return found


def other_systems(folder: Path) -> list[dict[str, Any]]:
    """Published trajectories of other systems against their ground truth."""
    rows = []
    for truth, estimate, alignment in TRAJECTORIES:
        error = trajectory_error(
            read_trajectory(folder / estimate), read_trajectory(folder / truth), alignment=alignment
        )
        rows.append({"estimate": estimate, "align": alignment, "ATE m": error.rmse, "RPE m": error.rpe_rmse,
                     "RPE deg": error.rpe_rotation_rmse, "poses": error.pairs})  # fmt: skip
    return rows


def colmap_rows(data: Path, out: Path) -> list[dict[str, Any]]:
    """COLMAP on the photo set with ground-truth cameras, beside this project's goal mvd on it."""
    folder = data / "mvs_strecha_fountain_P11"
    rows: list[dict[str, Any]] = []
    made, missing = load(PHOTO_SETS)
    rows += [{"system": name, "remark": why} for name, why in missing.items()]
    for name, make in made.items():
        try:
            poses, focal = make().solve(folder / "images")
        except PeerMissing as reason:
            rows.append({"system": name, "remark": str(reason)})
            continue
        names = sorted(p.name for p in (folder / "images").iterdir())
        stamps = {n: (k + 1) * 1_000_000_000 for k, n in enumerate(names)}
        found = Trajectory.from_pairs([(stamps[n], T) for n, T in poses.items()], Scale.ARBITRARY)
        truth = Trajectory.from_pairs([(stamps[n], _strecha(folder, n)) for n in names])
        errors = align_trajectories(found, truth).errors
        rows.append({"system": name, "photos": f"{len(poses)}/{len(names)}", "focal px": focal,
                     "position error cm": 100 * float(np.sqrt((errors**2).mean()))})  # fmt: skip
    return rows


def _strecha(folder: Path, name: str) -> np.ndarray:
    values = np.array((folder / "gt_dense_cameras" / f"{name}.camera").read_text().split(), float)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = values[12:21].reshape(3, 3), values[21:24]
    return T


def beside_peers(frames: list[Frame], readout: float, strides: Sequence[int]) -> dict[str, list[dict[str, Any]]]:
    """Tracking of the same RGB-D frames by this project, which knows the readout, and by other programs."""
    tables, ours = {}, partial(OurTracker, readout)
    for stride in strides:
        some = frames[::stride]
        rows = side_by_side(ours, ODOMETRY, some, lambda make, some=some: measure_tracker(make, some))
        tables[f"7-Scenes beside other programs, {len(some)} frames, every {stride}. one"] = rows
    return tables


def street_end(run: RunFolder) -> list[dict[str, Any]]:
    """How far the end of a street lies from where it should, seen from its beginning, beside LiDAR odometry."""
    bag, truth, own = Path(run.info()["bag"]), measures.truth_of(run), run.trajectory()
    poses = dict(zip(own.stamps_ns.tolist(), own.poses, strict=True))
    rows = [_end_row("this project", [(stamp, poses[stamp]) for stamp in sorted(poses)], truth)]
    made, missing = load(SWEEPS)
    for name, make in made.items():
        odometry, found = make(), []
        with BagReader(bag) as reader:
            mount = static_frames(reader).lookup(run.camera().frame_id, LIDAR)
            sweeps = (decode_cloud(reader.decode(raw)) for raw in reader.messages(["/lidar/points"]))
            for sweep in sweeps:
                found.append((sweep.stamp_ns, mount @ odometry.track(sweep) @ se3.inverse(mount)))
        rows.append(_end_row(name, found, truth))
    return rows + [{"system": name, "remark": why} for name, why in missing.items()]


def _end_row(system: str, poses: Sequence[tuple[int, Float64]], truth: Trajectory) -> dict[str, Any]:
    """The error of the last pose [4, 4] seen from the first."""
    true = dict(zip(truth.stamps_ns.tolist(), truth.poses, strict=True))
    known = [(true[stamp], T) for stamp, T in poses if stamp in true]
    (G0, E0), (G1, E1) = known[0], known[-1]
    off = se3.inverse(se3.inverse(G0) @ G1) @ (se3.inverse(E0) @ E1)
    way = float(np.linalg.norm(np.diff([G[:3, 3] for G, _ in known], axis=0), axis=1).sum())
    error = float(np.linalg.norm(off[:3, 3]))
    return {"system": system, "frames": len(known), "path m": way, "end off by cm": 100 * error,
            "off by deg": float(np.degrees(np.linalg.norm(se3.log(off)[3:])))}  # fmt: skip


def small_house(world: Path, frames: int, out: Path) -> list[tuple[str, Path]]:
    """The Gazebo world rendered twice, exact ground truth included."""
    size = {"frames": frames, "fps": 10.0, "width": 320, "height": 240, "focal": 240.0}
    return [
        ("small house, RGB-D", simulated(SimulationSpec(str(world), depth="tof", **size), out)[0]),
        ("small house, RGB-L", simulated(SimulationSpec(str(world), lidar="spinning64", **size), out)[0]),
    ]


def main() -> None:
    bench = Benchmark("real", __doc__.splitlines()[0])
    bench.parser.add_argument("--data", type=Path, required=True, help="folder that holds the recordings")
    bench.parser.add_argument("--frames", type=int, default=30, help="of each recording, from its start")
    bench.parser.add_argument("--full", action="store_true", help="also other programs on every frame of 7-Scenes")
    args = bench.parse()
    bench.note(
        f"The first {args.frames} frames of each recording, 200 of 7-Scenes, whose camera hardly moves at first."
    )
    o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Error)
    inputs = [(folder.name, folder) for folder in recordings(args.data)]
    world = args.data / "mesh_small_house" / "worlds" / "small_house.world"
    if world.is_file():
        inputs += small_house(world, args.frames, args.out)
    rows: list[dict[str, Any]] = []
    for name, source in inputs:
        out = args.out / "real" / name.replace(", ", "-").replace(" ", "_")
        try:
            limit = max(args.frames, FRAMES.get(name, 0))
            cells = score(run_line(source, out, GOALS.get(name, "auto"), reading=ReadOptions(limit=limit)))
        except SceneFactoryError as error:
            cells = {"remark": str(error)}
        rows.append({"recording": name, **cells})
        print_rows(rows[-1:])
    tables: dict[str, list[dict[str, Any]]] = {"recordings": rows}
    if (kitchen := args.out / "real" / KITCHEN / "input.mcap").is_file():
        fly(kitchen.parent, 60, kitchen.with_name(FLIGHT))
        provide_vocabulary(bench, args.out)
        tables |= beside_peers(load_frames(kitchen), readout_of(kitchen), (5, 1) if args.full else (5,))
    if (args.out / "real" / STREET / "run.json").is_file():
        tables["the end of a street, LiDAR odometry beside it"] = street_end(RunFolder.open(args.out / "real" / STREET))
    if (args.data / "trajectories_evo").is_dir():
        tables["trajectories of other systems, as evo measures them"] = other_systems(args.data / "trajectories_evo")
    if (args.data / "mvs_strecha_fountain_P11").is_dir():
        tables["fountain-P11 without calibration"] = colmap_rows(args.data, args.out)
    bench.write("Real recordings", tables)


if __name__ == "__main__":
    main()
