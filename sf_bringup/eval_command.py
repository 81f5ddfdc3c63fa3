"""``sf eval``: one measure of a run or of plain files, as a table or as JSON."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from sf_interfaces.errors import ConfigError

_HELP = {
    "traj": "ATE and RPE of a run or a trajectory file",
    "depth": "errors and variance calibration of a run's depth or of depth files",
    "completion": "predict held-out LiDAR points of an RGB-L run",
    "mesh": "accuracy, completion and F-score of a run's surface or of a mesh file",
    "render": "PSNR, SSIM and LPIPS of held-out views of a run, or of image files",
}
_UNITS = {
    "rmse": "m", "mean": "m", "median": "m", "max": "m", "mae": "m", "path_length": "m",
    "rpe_rmse": "m", "rpe_median": "m", "rpe_rotation_rmse": "deg", "rpe_rotation_median": "deg",
    "absrel": "%", "inlier": "%", "delta1": "%", "density": "%", "within_1_sigma": "%", "within_2_sigma": "%",
    "accuracy": "cm", "completion": "cm", "completion_ratio": "%", "precision": "%", "f_score": "%",
    "psnr_surface": "dB", "psnr_full": "dB", "covered": "%",
}  # fmt: skip


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """One sub-parser for each measure."""
    measures = parser.add_subparsers(dest="measure", required=True)
    for name, help in _HELP.items():
        p = measures.add_parser(name, help=help, description=help)
        p.add_argument("run", type=Path, help="folder of a run" + ("" if name == "completion" else ", or a file"))
        p.add_argument("--json", action="store_true", help="print one JSON object")
        if name != "completion":
            p.add_argument("--reference", type=Path, help="file or folder (default: what the input of the run carries)")
        if name == "traj":
            p.add_argument("--align", choices=("se3", "sim3", "none"), help="default: sim3 for runs without scale")
            p.add_argument("--delta", type=int, default=1, help="frames between the two poses of RPE")
        elif name == "depth":
            p.add_argument("--align", choices=("none", "median", "lstsq"), help="default: median without scale")
        elif name == "completion":
            p.add_argument("--holdout", type=float, default=0.5, help="fraction of LiDAR points to predict")
        elif name == "mesh":
            p.add_argument("--icp", action="store_true", help="align by ICP before measuring (within 0.1 m)")
            p.add_argument("--poses", type=Path, help="views that cull a mesh file, TUM format")
            p.add_argument("--calibration", type=Path, help="camera of those views, camera.yaml")


def eval_command(args: argparse.Namespace) -> int:
    """Measure and print.

    Raises:
        SceneFactoryError: nothing to measure, or no reference.
    """
    values = _MEASURES[args.measure](args)
    print(json.dumps(values, default=str) if args.json else "\n".join(_table(values)))
    return 0


def _table(values: Mapping[str, Any], indent: str = "") -> Iterator[str]:
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield f"{indent}{key}"
            yield from _table(value, indent + "  ")
        else:
            number = f"{value:12.4f}" if isinstance(value, float) else f"{value!s:>12}"
            yield f"{indent}{key:22}{number} {_UNITS.get(key, '')}".rstrip()


def _is_run(path: Path) -> bool:
    return (path / "run.json").is_file()


def _reference(args: argparse.Namespace) -> Path:
    if args.reference is None:
        raise ConfigError(f"{args.run} is not the output of a run (no run.json); pass --reference to measure a file")
    return Path(args.reference)


def _traj(args: argparse.Namespace) -> dict[str, Any]:
    from sf_bringup.eval_files import read_trajectory
    from sf_bringup.evaluation import trajectory_error
    from sf_bringup.measures import measure_trajectory
    from sf_bringup.run_folder import RunFolder

    if _is_run(args.run):
        return measure_trajectory(RunFolder(args.run), args.reference, args.align, args.delta).as_dict()
    found, truth = read_trajectory(args.run), read_trajectory(_reference(args))
    return trajectory_error(found, truth, alignment=args.align, delta=args.delta).as_dict()


def _depth(args: argparse.Namespace) -> dict[str, Any]:
    from sf_bringup import measures
    from sf_bringup.eval_files import DEPTH_SUFFIXES, paired, read_depth
    from sf_bringup.evaluation import depth_error, mean_depth_error
    from sf_bringup.run_folder import RunFolder

    if _is_run(args.run):
        run = RunFolder(args.run)
        error = measures.measure_depth(run, args.reference, args.align).as_dict()
        return {**error, "robust_mvd_all_views": measures.measure_mvd(run, args.reference, args.align)}
    pairs = paired(args.run, _reference(args), DEPTH_SUFFIXES)
    errors = [depth_error(read_depth(a), read_depth(b), args.align or "none") for a, b in pairs]
    return {**mean_depth_error(errors).as_dict(), "images": len(errors)}


def _completion(args: argparse.Namespace) -> dict[str, Any]:
    from sf_bringup.measures import measure_completion
    from sf_bringup.run_folder import RunFolder

    return measure_completion(RunFolder.open(args.run), args.holdout).as_dict()


def _mesh(args: argparse.Namespace) -> dict[str, Any]:
    from sf_bringup.eval_files import read_surface, read_trajectory
    from sf_bringup.evaluation.mesh import icp
    from sf_bringup.measures import measure_mesh, surface_errors
    from sf_bringup.run_folder import RunFolder
    from sf_interfaces.io.calibration import read_camera

    if (args.poses is None) != (args.calibration is None):
        raise ConfigError("culling needs both --poses and --calibration: the views and their camera")
    if _is_run(args.run):
        if args.reference is None:
            raise ConfigError("pass --reference MESH: a run carries no true surface ('sf simulate --mesh' writes one)")
        errors = measure_mesh(RunFolder(args.run), args.reference, args.icp)
        return {name: error.as_dict() for name, error in errors.items()}
    found, truth = read_surface(args.run), read_surface(_reference(args))
    if args.icp:
        found = found.moved(icp(found, truth))
    views = None
    if args.poses is not None:
        views = (read_camera(args.calibration)[0], read_trajectory(args.poses).poses)
    return {name: error.as_dict() for name, error in surface_errors(found, truth, views).items()}


def _render(args: argparse.Namespace) -> dict[str, Any]:
    from sf_bringup import measures
    from sf_bringup.eval_files import IMAGE_SUFFIXES, paired, read_image
    from sf_bringup.run_folder import RunFolder

    if _is_run(args.run):
        return measures.measure_render(RunFolder(args.run))
    pairs = paired(args.run, _reference(args), IMAGE_SUFFIXES)
    images = [(read_image(a), read_image(b)) for a, b in pairs]
    return {**measures.image_scores(images), "views": len(images)}


_MEASURES = {"traj": _traj, "depth": _depth, "completion": _completion, "mesh": _mesh, "render": _render}
