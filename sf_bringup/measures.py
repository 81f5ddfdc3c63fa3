"""``sf eval``: the measures of a finished run against the references its input carries."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from sf_bringup.discovery import DENSE_FRACTION
from sf_bringup.evaluation import (
    DepthError,
    TrajectoryError,
    depth_error,
    mean_depth_error,
    psnr,
    trajectory_error,
)
from sf_bringup.run_folder import RunFolder
from sf_interfaces import topics
from sf_interfaces.errors import FormatError
from sf_interfaces.io.bag import BagReader
from sf_interfaces.io.trajectory import read_tum
from sf_interfaces.ros.messages import decode_depth, decode_image, decode_pose, to_ns
from sf_interfaces.types import DepthMap, Trajectory, UInt8

GROUND_TRUTH_POSE = topics.GROUND_TRUTH_PREFIX + "pose"
GROUND_TRUTH_DEPTH = topics.GROUND_TRUTH_PREFIX + "depth/image"
HELD_OUT_VIEWS = 10  # views rendered per run: enough for a stable median, seconds to compute


def reference_trajectory(bag: Path) -> Trajectory | None:
    """The poses under /ground_truth/pose of a bag, or None where it has none."""
    with BagReader(bag) as reader:
        if GROUND_TRUTH_POSE not in reader.topics:
            return None
        pairs = {}
        for raw in reader.messages([GROUND_TRUTH_POSE]):
            stamp, _, T = decode_pose(reader.decode(raw))
            pairs[stamp] = T
    return Trajectory.from_pairs(list(pairs.items()))


def decoded(bag: Path, topic: str, decode: Callable[[Any], Any], stamps: set[int]) -> Iterator[tuple[int, Any]]:
    """(stamp, decoded message) of one topic, only for header stamps in ``stamps``."""
    with BagReader(bag) as reader:
        if topic not in reader.topics:
            return
        for raw in reader.messages([topic]):
            message = reader.decode(raw)
            stamp = to_ns(message.header.stamp)
            if stamp in stamps:
                yield stamp, decode(message)


def input_bag(run: RunFolder) -> Path:
    """The bag a run was made from.

    Raises:
        FormatError: it has been moved or deleted.
    """
    bag = Path(run.info()["bag"])
    if not bag.exists():
        raise FormatError(f"the input of this run, {bag}, is gone; put it back or pass --reference")
    return bag


def measure_trajectory(run: RunFolder, reference: Path | None = None) -> TrajectoryError:
    """ATE of the final poses of all frames.

    Raises:
        FormatError: there is no reference.
    """
    truth = read_tum(reference) if reference else reference_trajectory(input_bag(run))
    if truth is None:
        raise FormatError(f"the input has no {GROUND_TRUTH_POSE}; pass --reference traj.tum")
    return trajectory_error(run.trajectory(), truth)


def measure_depth(run: RunFolder) -> DepthError:
    """Keyframe depth against /ground_truth/depth/image of the input, mean over keyframes."""
    maps = dict(run.depth_maps())
    truth = decoded(input_bag(run), GROUND_TRUTH_DEPTH, decode_depth, set(maps))
    errors = [depth_error(maps[stamp], reference) for stamp, reference in truth]
    if not errors:
        raise FormatError(f"the input has no {GROUND_TRUTH_DEPTH} for the keyframes of this run")
    return mean_depth_error(errors)


def measure_completion(run: RunFolder, holdout: float, seed: int = 0) -> DepthError:
    """Predict LiDAR points that were taken away from each recorded keyframe, with the run's own settings.

    Args:
        holdout: fraction of the keyframe's LiDAR pixels that is dropped and then predicted.

    Raises:
        FormatError: the run has no sparse keyframe depth.
    """
    from sf_bringup.pipeline import make_completer
    from sf_interfaces.config import ConfigFile
    from sf_interfaces.types import Keyframe

    if not 0.0 < holdout < 1.0:
        raise FormatError(f"--holdout must lie strictly between 0 and 1, got {holdout}")
    completer = make_completer(ConfigFile.load(run.path / "config.yaml"))
    camera, poses = run.camera(), run.keyframes()
    stamps = {int(s) for s in poses.stamps_ns}
    images = dict(decoded(run.result, topics.KEYFRAME_IMAGE.name, decode_image, stamps))
    rng = np.random.default_rng(seed)
    errors = []
    for stamp, depth in decoded(run.result, topics.KEYFRAME_DEPTH.name, decode_depth, stamps):
        if depth.density > DENSE_FRACTION:
            break
        row, col = np.nonzero(depth.valid)
        dropped = rng.permutation(len(row))[: int(holdout * len(row))]
        kept, target = np.array(depth.z), np.full_like(depth.z, np.nan)
        target[row[dropped], col[dropped]] = kept[row[dropped], col[dropped]]
        kept[row[dropped], col[dropped]] = np.nan
        keyframe = Keyframe(stamp, camera, images[stamp], np.eye(4), DepthMap(kept))
        completed = completer.complete(keyframe).depth
        if completed is not None and len(dropped):
            errors.append(depth_error(completed, DepthMap(target)))
    if not errors:
        raise FormatError(f"{run.result} holds no sparse keyframe depth; completion needs an RGB-L run")
    return mean_depth_error(errors)


def held_out_stamps(run: RunFolder) -> list[int]:
    """Evenly spread frames that are not keyframes: the colour field has never seen them."""
    known = {int(s) for s in run.keyframes().stamps_ns}
    first, last = (min(known), max(known)) if known else (0, 0)
    free = [int(s) for s in run.trajectory().stamps_ns if int(s) not in known and first < int(s) < last]
    step = max(1, len(free) // HELD_OUT_VIEWS)
    return free[::step][:HELD_OUT_VIEWS]


def render_held_out(run: RunFolder) -> list[tuple[int, UInt8, UInt8, np.ndarray]]:
    """(stamp, rendered, real, surface mask) of the held-out views at their estimated poses."""
    from sf_bringup.pipeline import load_map

    stamps = held_out_stamps(run)
    trajectory = run.trajectory()
    pose_of = dict(zip(trajectory.stamps_ns.tolist(), trajectory.poses, strict=True))
    topic = run.info()["topics"].get("rgb")
    if not stamps or topic is None or not run.map.is_file():
        return []
    field, camera, out = load_map(run.map), run.camera(), []
    for stamp, image in decoded(input_bag(run), topic, decode_image, set(stamps)):
        view = field.render(camera, pose_of[stamp])
        out.append((stamp, view.image, image, view.depth.valid))
    return out


def render_scores(views: list[tuple[int, UInt8, UInt8, np.ndarray]]) -> dict[str, float]:
    """Median PSNR over the surface and over the whole image, and the fraction of pixels with a surface."""
    if not views:
        raise FormatError("no held-out frame to render: the run has no colour field or every frame is a keyframe")
    real = [r if r.ndim == 3 else np.repeat(r[..., None], 3, axis=2) for _, _, r, _ in views]
    surface = [psnr(v[1], r, v[3]) for v, r in zip(views, real, strict=True) if v[3].any()]
    return {
        "psnr_surface": float(np.median(surface)) if surface else float("nan"),
        "psnr_full": float(np.median([psnr(v[1], r) for v, r in zip(views, real, strict=True)])),
        "covered": 100 * float(np.mean([v[3].mean() for v in views])),
        "views": float(len(views)),
    }


MEASURES: dict[str, Callable[[argparse.Namespace], dict[str, float]]] = {
    "traj": lambda a: measure_trajectory(RunFolder.open(a.run), a.reference).as_dict(),
    "depth": lambda a: measure_depth(RunFolder.open(a.run)).as_dict(),
    "completion": lambda a: measure_completion(RunFolder.open(a.run), a.holdout).as_dict(),
    "render": lambda a: render_scores(render_held_out(RunFolder.open(a.run))),
}
