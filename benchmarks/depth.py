"""Multi-view depth in the paper's settings: c posed, d unposed, e unposed and uncalibrated; simulated and real sets.

    python benchmarks/depth.py [--data FOLDER] [--only room fountain] [--all] [--oracle] [--line room0] [--out bench]

Each set is one reference with all other views as sources. ``seen`` is the depth before completion, the rest after it.
Errors are RobustMVD's (absrel, tau at 1.03); c without alignment, d and e after the median. ``--oracle`` adds that
benchmark's choice of sources by their ground-truth error; ``--line`` runs ``sf run --goal mvd`` on a path.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import image_sets
import numpy as np
import paper
from common import INFO, Benchmark, mean_row, print_rows, run_line, shrunk, simulated, without
from image_sets import ImageSet

from sf_bringup import measures
from sf_bringup.evaluation import depth_error
from sf_bringup.evaluation.robust_mvd import oracle_view_choice
from sf_bringup.simulate import PRESETS
from sf_depth.config import DepthConfig
from sf_depth.core import dense_ba, dense_ba_reference, pinhole
from sf_depth.core.dense_ba import Estimate, Observations
from sf_depth.core.filling import Filler
from sf_depth.core.matching import pixel_grid
from sf_depth.core.mvd import MultiViewDepth, Recovered
from sf_interfaces.errors import SceneFactoryError
from sf_interfaces.geometry import se3
from sf_interfaces.types import DepthMap, Float64, Keyframe

SETTINGS = {"c": "none", "d": "median", "e": "median"}  # and their alignment


def recover(images: ImageSet, setting: str) -> Recovered:
    """Depth of the reference with as much knowledge as the setting allows."""
    camera = None if setting == "e" else images.camera
    T = images.T_source_reference if setting == "c" else None
    return MultiViewDepth(DepthConfig(), lens=True).recover(images.images[0], images.images[1:], camera, T)


def measure(images: ImageSet, setting: str) -> dict[str, Any]:
    """One set in one setting: cameras, depth before and after completion, time."""
    begun = time.perf_counter()
    found = recover(images, setting)
    recovered = time.perf_counter()
    keyframe = Keyframe(0, found.camera, images.images[0], images.poses[0], found.depth)
    full = Filler(DepthConfig()).fill(keyframe).depth
    done = time.perf_counter()
    cells: dict[str, Any] = {"density %": 100 * found.depth.density}
    if images.truth is not None:
        cells |= _errors(found.depth, images.truth, setting, " seen")
        cells |= _errors(full, images.truth, setting)
    cells |= cameras(found, images) | ({"poses": "contradicted"} if found.contradicted else {})
    return cells | {"s depth": recovered - begun, "s complete": done - recovered}


def _errors(depth: DepthMap, truth: DepthMap, setting: str, suffix: str = "") -> dict[str, float]:
    """RobustMVD's errors; median error and shares within sigma after the median of ratios, as the scale is free."""
    alignment = SETTINGS[setting]
    error = depth_error(depth, truth, alignment)
    both = depth.valid & truth.valid
    ratio = (depth.z[both] / truth.z[both]).astype(np.float64)
    off = np.abs(ratio / (np.median(ratio) if alignment == "median" else 1.0) - 1.0)
    assert depth.variance is not None
    pull = off / (np.sqrt(depth.variance[both]) / depth.z[both])
    return {
        f"rel %{suffix}": error.absrel, f"median rel %{suffix}": 100 * float(np.median(off)),
        f"tau %{suffix}": error.inlier, f"1 sigma %{suffix}": 100 * float((pull < 1).mean()),
        f"2 sigma %{suffix}": 100 * float((pull < 2).mean()),
    }  # fmt: skip


def cameras(found: Recovered, images: ImageSet) -> dict[str, Any]:
    """Focal length and relative poses against the reference ones; the unit of length is brought to theirs."""
    truth = images.T_source_reference
    off = se3.log(found.T_source_reference @ se3.inverse(truth))[:, 3:]
    own, true = found.T_source_reference[:, :3, 3], truth[:, :3, 3]
    scale = float((own * true).sum() / (own * own).sum())
    length = np.linalg.norm(true, axis=1)
    return {
        "focal %": 100 * (found.camera.fx / images.camera.fx - 1),
        "focal sigma %": 100 * found.focal_sigma,
        "rotation deg": float(np.degrees(np.linalg.norm(off, axis=1)).max()),
        "translation %": 100 * float((np.linalg.norm(scale * own - true, axis=1) / length).max()),
        "registered": f"{int(found.registered.sum())}/{len(truth)}",
    }


def oracle(images: ImageSet, setting: str) -> dict[str, Any]:
    """The reference with the sources that its ground truth chooses."""
    assert images.truth is not None

    def predict(sources: Sequence[int]) -> Float64:
        return np.nan_to_num(recover(images.only(list(sources)), setting).depth.z)

    truth = np.nan_to_num(images.truth.z)
    best = oracle_view_choice(predict, range(1, len(images.images)), truth, SETTINGS[setting])
    return {"rel % oracle": best.absrel, "tau % oracle": best.inlier, "sources": len(best.views)}


def adjustment(images: ImageSet, intrinsics: str) -> dict[str, Any]:
    """Dense BA on correspondences of every fourth pixel with noise of 0.3 px, from depth and a focal length far off."""
    assert images.truth is not None
    rng, theta = np.random.default_rng(0), pinhole.theta_of(images.camera)
    uv = pixel_grid(images.truth.z.shape)[2::4, 2::4].reshape(-1, 2).T.astype(np.float64)
    z = images.truth.z[2::4, 2::4].reshape(-1).astype(np.float64)
    uv, z = uv[:, np.isfinite(z)], z[np.isfinite(z)]
    truth = Estimate(theta, images.T_source_reference, 1.0 / z)
    nothing = Observations(uv, np.zeros((len(truth.T), *uv.shape)), np.ones((len(truth.T), len(z))))
    target = -dense_ba_reference.residuals(nothing, truth)
    weight = np.isfinite(target[:, 0]).astype(np.float64)
    seen = Observations(uv, np.nan_to_num(target) + rng.normal(0, 0.3, target.shape), weight)
    off = np.exp(rng.normal(0, 0.1, len(z)))
    at = Estimate(theta * [1.2, 1.2, 1, 1, 0] if intrinsics == "f" else theta, truth.T, off * truth.inverse_depth)
    begun = time.perf_counter()
    found = dense_ba.optimum(seen, at, intrinsics=intrinsics)
    seconds, count = time.perf_counter() - begun, 2 * int(weight.sum())
    return {
        "set": images.name, "free": f"poses, {intrinsics}", "residuals": count, "iterations": found.iterations,
        "ms / iteration / 100k residuals": 1e3 * seconds / found.iterations / count * 1e5,
        "focal %": 100 * (found.estimate.theta[0] / theta[0] - 1),
    }  # fmt: skip


def line(scene: str, views: int, stride: int, factor: float, args: argparse.Namespace) -> dict[str, Any]:
    """Every view of a path as a reference, through ``sf run --goal mvd`` with nothing known."""
    spec = shrunk(PRESETS[scene], views, stride, factor)
    bag, _ = simulated(replace(spec, depth="none", lidar="none", ground_truth_depth=True), args.out)
    run = run_line(without(bag, [INFO], "uncalibrated"), args.out / "depth" / scene, "mvd")
    error = measures.measure_depth(run, alignment="median")
    return {
        "scene": scene, "views": views, "rel %": error.absrel, "tau %": error.inlier,
        "1 sigma %": error.within_1_sigma, "2 sigma %": error.within_2_sigma, "seconds": run.info()["seconds"],
    }  # fmt: skip


def attempt(name: str, *measures_of: Any) -> dict[str, Any]:
    """A row of measures; what the depth block refuses is said in its words."""
    cells: dict[str, Any] = {}
    try:
        for part in measures_of:
            cells |= part()
    except SceneFactoryError as error:
        cells["remark"] = f"{name}: {error}"
    return cells


def main() -> None:
    bench = Benchmark("depth", __doc__.splitlines()[0])
    bench.parser.add_argument("--data", type=Path, help="folder of real recordings; without it none")
    bench.parser.add_argument("--only", nargs="+", help="sets whose name begins with one of these words")
    bench.parser.add_argument("--all", action="store_true", help="all sets, not only those that minutes allow")
    bench.parser.add_argument("--oracle", action="store_true", help="sources chosen by ground truth, too")
    bench.parser.add_argument("--line", nargs="*", default=[], choices=sorted(PRESETS), help="paths to run whole")
    args = bench.parse()
    bench.note("One reference a set, all other views as sources; paper rows are on other data, with chosen sources.")
    bench.note("7-Scenes, frames 100-199: its depth is the reference, its poses are good to a degree or two only.")
    groups: dict[str, Iterator[ImageSet]] = {
        "simulated": image_sets.simulated(args.all),
        "unseen": image_sets.unseen(args.all),
    }
    if args.data is not None:
        groups["real"] = image_sets.real(args.data, args.all)
    rows: list[dict[str, Any]] = []
    adjusted: list[dict[str, Any]] = []
    for group, images in chain.from_iterable(((g, s) for s in sets) for g, sets in groups.items()):
        if args.only and not any(images.name.startswith(word) for word in args.only):
            continue
        for setting in SETTINGS:
            parts = [lambda s=setting, i=images: measure(i, s)]
            if args.oracle and images.truth is not None:
                parts.append(lambda s=setting, i=images: oracle(i, s))
            rows.append({"set": images.name, "kind": group, "setting": setting, **attempt(images.name, *parts)})
            print_rows(rows[-1:])
        if group != "real":
            adjusted += [adjustment(images, free) for free in ("none", "f")]
    means = [
        mean_row([r for r in rows if (r["kind"], r["setting"]) == (g, s)], kind=g, setting=s)
        for g in groups
        for s in SETTINGS
    ]
    print_rows(means)
    print_rows(adjusted)
    paths = [attempt(scene, lambda scene=scene: line(scene, 6, 12, 0.4, args)) for scene in args.line]
    print_rows(paths)
    tables = {
        "sets": rows,
        "means": means,
        "dense bundle adjustment": adjusted,
        "paths, whole line, nothing known": paths,
        "paper": paper.mvd_rows(),
    }
    bench.write("Multi-view depth", tables)


if __name__ == "__main__":
    main()
