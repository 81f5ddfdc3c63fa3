"""The measures of a finished run against the references its input carries, or against given files."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sf_bringup.discovery import DENSE_FRACTION
from sf_bringup.eval_files import DEPTH_SUFFIXES, files_by_name, read_depth, read_surface, read_trajectory
from sf_bringup.evaluation import (
    DepthError,
    Samples,
    SurfaceError,
    TrajectoryError,
    align_trajectories,
    depth_error,
    mean_depth_error,
    psnr,
    ssim,
    surface_error,
    trajectory_error,
)
from sf_bringup.evaluation.lpips import Lpips
from sf_bringup.evaluation.mesh import icp
from sf_bringup.evaluation.robust_mvd import mvd_error
from sf_bringup.evaluation.seen_surface import seen_surface_error
from sf_bringup.lenses import depth_decoder, image_decoder
from sf_bringup.run_folder import RunFolder
from sf_bringup.shutters import Unroller
from sf_interfaces import topics
from sf_interfaces.errors import FormatError
from sf_interfaces.geometry import se3
from sf_interfaces.io.bag import BagReader
from sf_interfaces.ros.messages import decode_depth, decode_image, decode_pose, to_ns
from sf_interfaces.types import Camera, DepthMap, Float64, Scale, Trajectory, UInt8

GROUND_TRUTH_POSE = topics.GROUND_TRUTH_PREFIX + "pose"
GROUND_TRUTH_DEPTH = topics.GROUND_TRUTH_PREFIX + "depth/image"
NOVEL_POSE = topics.GROUND_TRUTH_PREFIX + "novel/pose"  # views off the path, which only a simulation has
NOVEL_IMAGE = topics.GROUND_TRUTH_PREFIX + "novel/image"
HELD_OUT_VIEWS = 10  # views rendered per run: enough for a stable median, seconds to compute


@dataclass(frozen=True, slots=True)
class HeldOutView:
    """A view that the map was not made from."""

    stamp_ns: int
    rendered: UInt8  # [H, W, 3]
    real: UInt8  # [H, W, 3]
    surface: np.ndarray  # [H, W] where the map has a surface


def _poses(bag: Path, topic: str) -> Trajectory | None:
    """The poses of one topic, or None where the bag does not have it."""
    with BagReader(bag) as reader:
        if topic not in reader.topics:
            return None
        pairs = {}
        for raw in reader.messages([topic]):
            stamp, _, T = decode_pose(reader.decode(raw))
            pairs[stamp] = T
    return Trajectory.from_pairs(list(pairs.items()))


def reference_trajectory(bag: Path) -> Trajectory | None:
    """The poses under /ground_truth/pose of a bag, or None where it has none."""
    return _poses(bag, GROUND_TRUTH_POSE)


def decoded(
    bag: Path, topic: str, decode: Callable[[Any], Any], stamps: set[int] | None = None
) -> Iterator[tuple[int, Any]]:
    """(stamp, decoded message) of one topic; with ``stamps`` only for those header stamps."""
    with BagReader(bag) as reader:
        if topic not in reader.topics:
            return
        for raw in reader.messages([topic]):
            message = reader.decode(raw)
            stamp = to_ns(message.header.stamp)
            if stamps is None or stamp in stamps:
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


def truth_of(run: RunFolder, reference: Path | None = None) -> Trajectory:
    """The reference trajectory: a file, or the poses of the input.

    Raises:
        FormatError: there is none.
    """
    truth = read_trajectory(reference) if reference else reference_trajectory(input_bag(run))
    if truth is None:
        raise FormatError(f"the input has no {GROUND_TRUTH_POSE}; pass --reference traj.tum")
    return truth


def _into_truth(run: RunFolder, truth: Trajectory) -> tuple[float, Float64]:
    """Scale and motion from the run's map into that of the truth; where poses were given the two are one."""
    if not (run.path / "trajectory.tum").is_file():
        return 1.0, np.eye(4)
    aligned = align_trajectories(run.trajectory(), truth)
    return aligned.scale, aligned.T_reference_estimate


def measure_trajectory(
    run: RunFolder, reference: Path | None = None, alignment: str | None = None, delta: int = 1
) -> TrajectoryError:
    """ATE and RPE of the final poses of all frames.

    Raises:
        FormatError: there is no reference.
    """
    return trajectory_error(run.trajectory(), truth_of(run, reference), alignment=alignment, delta=delta)


def depth_pairs(run: RunFolder, reference: Path | None = None) -> Iterator[tuple[int, DepthMap, DepthMap]]:
    """(stamp, estimated, true depth) of keyframes that have both; ``reference``: a folder of <stamp>.npz or .png."""
    maps = dict(run.depth_maps())
    if reference is None:
        bag = input_bag(run)
        truth = decoded(bag, GROUND_TRUTH_DEPTH, depth_decoder(run, bag), set(maps))
    else:
        files = files_by_name(reference, DEPTH_SUFFIXES)
        named = {int(name): path for name, path in files.items() if name.isdigit()}
        truth = ((stamp, read_depth(named[stamp])) for stamp in sorted(maps) if stamp in named)
    for stamp, known in truth:
        yield stamp, maps[stamp], known


def measure_depth(run: RunFolder, reference: Path | None = None, alignment: str | None = None) -> DepthError:
    """Keyframe depth against its reference, mean over keyframes.

    Args:
        alignment: see :func:`sf_bringup.evaluation.depth.align_depth`; None: median where the run's scale is
            arbitrary, else none.
    """
    alignment = alignment or default_depth_alignment(run)
    errors = [depth_error(found, truth, alignment) for _, found, truth in depth_pairs(run, reference)]
    if not errors:
        raise FormatError(f"the input has no {GROUND_TRUTH_DEPTH} for the keyframes of this run")
    return mean_depth_error(errors)


def measure_mvd(run: RunFolder, reference: Path | None = None, alignment: str | None = None) -> dict[str, float]:
    """RobustMVD's numbers of the run's depth with all the views it used, mean over keyframes."""
    alignment = alignment or default_depth_alignment(run)
    errors = [
        mvd_error(np.where(found.valid, found.z, 0.0), np.where(truth.valid, truth.z, 0.0), alignment)
        for _, found, truth in depth_pairs(run, reference)
    ]
    return {name: float(np.mean([getattr(e, name) for e in errors])) for name in ("absrel", "inlier", "density")}


def default_depth_alignment(run: RunFolder) -> str:
    """``median`` for depth in arbitrary units, ``none`` for metres."""
    return "median" if run.scale is Scale.ARBITRARY else "none"


def measure_completion(run: RunFolder, holdout: float, seed: int = 0) -> DepthError:
    """Predict LiDAR points that were taken away from each recorded keyframe, with the run's own settings.

    Args:
        holdout: fraction of the keyframe's LiDAR pixels that is dropped and then predicted.

    Raises:
        FormatError: the run has no sparse keyframe depth.
    """
    from sf_bringup.pipeline import make_part
    from sf_interfaces.config import ConfigFile
    from sf_interfaces.types import Keyframe

    if not 0.0 < holdout < 1.0:
        raise FormatError(f"--holdout must lie strictly between 0 and 1, got {holdout}")
    completer = make_part("depth:complete", ConfigFile.load(run.path / "config.yaml")).completer
    camera = run.camera()
    images = dict(decoded(run.result, topics.KEYFRAME_IMAGE.name, decode_image))
    rng = np.random.default_rng(seed)
    errors = []
    for stamp, depth in decoded(run.result, topics.KEYFRAME_DEPTH.name, decode_depth):
        if depth.density > DENSE_FRACTION:
            break
        if not depth.valid.any():
            continue  # between two sweeps
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


def measure_mesh(run: RunFolder, reference: Path, with_icp: bool = False) -> dict[str, SurfaceError]:
    """The run's mesh, or its surface points where it has none, against a reference mesh in the map of the truth.

    The reconstruction is brought into that map by the alignment of the trajectories (with scale where the
    run's is arbitrary), then by ICP if wanted.

    Returns:
        ``seen``: what the views of the true trajectory see, from samples to triangles; ``nice_culled``: within
        their frusta, between samples; ``nicer_unculled``: all of both surfaces, between samples.
    """
    file = next((p for p in (run.path / "mesh.ply", run.path / "surface.ply") if p.is_file()), None)
    if file is None:
        raise FormatError(f"{run.path} holds neither mesh.ply nor surface.ply; run with --goal recon")
    truth, given = truth_of(run), read_surface(reference)
    scale, T_truth_map = _into_truth(run, truth)
    surface = read_surface(file).moved(T_truth_map, scale)
    if with_icp:
        surface = surface.moved(icp(surface, given))
    return surface_errors(surface, given, (run.camera(), truth.poses))


def surface_errors(surface: Samples, given: Samples, views: tuple[Camera, Float64] | None) -> dict[str, SurfaceError]:
    """All surface measures of two surfaces in one frame; without ``views`` (camera, T_map_camera) nothing is culled."""
    errors = {"nicer_unculled": surface_error(surface, given)}
    if views is not None:
        errors = {"nice_culled": surface_error(surface, given, views), **errors}
        if len(given.triangles):
            errors = {"seen": seen_surface_error(surface, given, *views), **errors}
    return errors


def held_out_poses(run: RunFolder) -> dict[int, Float64]:
    """T_map_camera, by stamp, of evenly spread frames that are not keyframes: the colour field has never seen them."""
    poses = frame_poses(run)
    known = {int(s) for s in run.keyframe_poses().stamps_ns}
    first, last = (min(known), max(known)) if known else (0, 0)
    pairs = zip(poses.stamps_ns.tolist(), poses.poses, strict=True)
    free = [(stamp, T) for stamp, T in pairs if stamp not in known and first < stamp < last]
    step = max(1, len(free) // HELD_OUT_VIEWS)
    return dict(free[::step][:HELD_OUT_VIEWS])


def frame_poses(run: RunFolder) -> Trajectory:
    """T_map_camera of every frame, estimated or given.

    Raises:
        FormatError: neither, or the given poses are of another frame than the camera's.
    """
    topic = run.info()["topics"].get("pose")
    if (run.path / "trajectory.tum").is_file() or topic is None:
        return run.trajectory()
    given, known = _poses(input_bag(run), topic), run.keyframe_poses()
    at = {} if given is None else dict(zip(given.stamps_ns.tolist(), given.poses, strict=True))
    if given is None or any(
        not np.allclose(at.get(stamp, T), T, atol=1e-6)
        for stamp, T in zip(known.stamps_ns.tolist(), known.poses, strict=True)
    ):
        raise FormatError(f"{topic} does not give the poses of the camera itself; frames cannot be drawn there")
    return given


def render_held_out(run: RunFolder) -> list[HeldOutView]:
    """Interpolated views: frames between keyframes, drawn at their estimated or given poses."""
    topic, pose_of = run.info()["topics"].get("rgb"), held_out_poses(run)
    return render_at(run, input_bag(run), topic, pose_of, Unroller(run)) if pose_of and topic is not None else []


def render_novel(run: RunFolder, bag: Path | None = None) -> list[HeldOutView]:
    """Extrapolated views: true views off the path, brought into the run's map by the trajectories' alignment.

    Args:
        bag: what holds them; None: the input of the run.

    Raises:
        FormatError: the bag has no such views.
    """
    bag = input_bag(run) if bag is None else bag
    novel, truth = _poses(bag, NOVEL_POSE), reference_trajectory(bag)
    if novel is None or truth is None:
        raise FormatError(f"the input has no {NOVEL_IMAGE}; only a simulation with --novel-views has it")
    scale, T_truth_map = _into_truth(run, truth)
    poses = se3.inverse(T_truth_map) @ novel.poses
    poses[:, :3, 3] /= scale
    return render_at(run, bag, NOVEL_IMAGE, dict(zip(novel.stamps_ns.tolist(), poses, strict=True)))


def render_at(
    run: RunFolder, bag: Path, topic: str, pose_of: Mapping[int, Float64], unroll: Unroller | None = None
) -> list[HeldOutView]:
    """Views drawn at T_map_camera by stamp, beside the images of ``topic`` of a bag with these stamps."""
    from sf_bringup.pipeline import load_map

    if not run.map.is_file():
        return []
    field, camera, out = load_map(run.map), run.camera(), []
    for stamp, image in decoded(bag, topic, image_decoder(run, bag), set(pose_of)):
        view = field.render(camera, pose_of[stamp])
        image = image if unroll is None else unroll(stamp, image, view.depth)
        real = image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)
        out.append(HeldOutView(stamp, view.image, real, view.depth.valid))
    return out


def render_scores(views: list[HeldOutView]) -> dict[str, Any]:
    """Medians over views of PSNR (surface, whole image), SSIM and LPIPS (whole image), and the surface's share."""
    if not views:
        raise FormatError("no held-out frame to render: the run has no colour field or every frame is a keyframe")
    surface = [psnr(v.rendered, v.real, v.surface) for v in views if v.surface.any()]
    return {
        "psnr_surface": float(np.median(surface)) if surface else float("nan"),
        **image_scores([(v.rendered, v.real) for v in views]),
        "covered": 100 * float(np.mean([v.surface.mean() for v in views])),
        "views": len(views),
    }


def image_scores(pairs: list[tuple[UInt8, UInt8]]) -> dict[str, Any]:
    """Medians of PSNR, SSIM and LPIPS (in words why not, where its weights are missing)."""
    parts = (("psnr_full", psnr), ("ssim", ssim))
    scores: dict[str, Any] = {name: float(np.median([score(a, b) for a, b in pairs])) for name, score in parts}
    try:
        lpips = Lpips.find()
        scores["lpips_alex"] = float(np.median([lpips(a, b) for a, b in pairs]))
    except FormatError as error:
        scores["lpips_alex"] = f"not measured: {error}"
    return scores


def measure_render(run: RunFolder) -> dict[str, Any]:
    """Scores of interpolated views, and of extrapolated ones (or why there are none)."""
    try:
        extrapolated: Any = render_scores(render_novel(run))
    except FormatError as error:
        extrapolated = f"not measured: {error}"
    return {**render_scores(render_held_out(run)), "extrapolated": extrapolated}
