"""The table, the picture and the page of a finished run, from what lies in its folder and in its input."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from matplotlib.figure import Figure

from sf_bringup import figures, measures
from sf_bringup.evaluation.trajectory import AlignedTrajectories, align_trajectories
from sf_bringup.report import Page, Row, add_figures
from sf_bringup.run_folder import RunFolder
from sf_interfaces import topics
from sf_interfaces.errors import SceneFactoryError
from sf_interfaces.io.bag import BagReader
from sf_interfaces.ros.messages import decode_depth, decode_image, to_ns
from sf_interfaces.types import DepthMap, Float64

V = TypeVar("V")


@dataclass(frozen=True, slots=True)
class Summary:
    """All numbers of a run, as plain values and as lines of text."""

    run: RunFolder
    values: dict[str, Any]

    def rows(self) -> list[Row]:
        """The table, most important line first; what could not be measured says why."""
        v = self.values
        rows = [Row("line", " -> ".join(v["line"])), Row("time", _time_text(v))]
        for topic, count in v["topics_in"].items():
            rows.append(Row(f"in   {topic}", f"{count['count']} messages, {count['rate']:.1f} Hz"))
        for topic, count in v["topics_out"].items():
            rows.append(Row(f"out  {topic}", f"{count['count']} messages"))
        dropped = {k: n for k, n in v["dropped"].items() if n}
        rows.append(Row("dropped", json.dumps(dropped) if dropped else "nothing"))
        for name, text in _MEASURE_TEXT.items():
            if name in v:
                rows.append(Row(name, v[name] if isinstance(v[name], str) else text(v[name])))
        return rows

    def text(self) -> str:
        """The table for a terminal."""
        rows = self.rows()
        width = max(len(r.name) for r in rows)
        return "\n".join(f"{r.name:<{width}}  {r.value}" for r in rows)


def _time_text(v: Mapping[str, Any]) -> str:
    return f"{v['seconds']:.1f} s for {v['input_seconds']:.1f} s of input ({v['engine']})"


_MEASURE_TEXT: dict[str, Callable[[dict[str, float]], str]] = {
    "trajectory": lambda m: (
        f"ATE RMSE {100 * m['rmse']:.2f} cm, max {100 * m['max']:.2f} cm over {m['pairs']:.0f} frames, "
        f"RPE {1000 * m['rpe_rmse']:.1f} mm, {m['rpe_rotation_rmse']:.2f} deg per frame, path {m['path_length']:.2f} m"
    ),
    "depth": lambda m: (
        f"absrel {m['absrel']:.2f} %, inliers 1.03 {m['inlier']:.1f} %, RMSE {m['rmse']:.3f} m, "
        f"density {m['density']:.1f} %, within 1/2 sigma {m['within_1_sigma']:.0f}/{m['within_2_sigma']:.0f} %"
    ),
    "completion": lambda m: (
        f"held-out LiDAR points: MAE {m['mae']:.3f} m, RMSE {m['rmse']:.3f} m, absrel {m['absrel']:.2f} %, "
        f"within 1/2 sigma {m['within_1_sigma']:.0f}/{m['within_2_sigma']:.0f} %"
    ),
    "render": lambda m: (
        f"held-out views: PSNR {m['psnr_surface']:.2f} dB on the surface ({m['covered']:.0f} % of pixels), "
        f"{m['psnr_full']:.2f} dB and SSIM {m['ssim']:.3f} on the whole image, {m['views']:.0f} views; "
        f"off the path: {_novel_text(m['extrapolated'])}"
    ),
}


def _novel_text(scores: dict[str, float] | str) -> str:
    if isinstance(scores, str):
        return scores
    return f"PSNR {scores['psnr_surface']:.2f} dB on the surface, {scores['views']:.0f} views"


def _or_reason(measure: Callable[[], V]) -> V | str:
    """The measure, or in words why it cannot be taken: a report is never lost for want of a reference."""
    try:
        return measure()
    except SceneFactoryError as error:
        return f"not measured: {error}"


def _counts(reader: BagReader, prefix: str = "") -> dict[str, dict[str, float]]:
    seconds = max(1e-9, (reader.end_ns - reader.start_ns) * 1e-9)
    return {
        name: {"count": info.count, "rate": info.count / seconds}
        for name, info in sorted(reader.topics.items())
        if name.startswith(prefix) and info.count
    }


def _dropped(reader: BagReader) -> dict[str, int]:
    """Last value of every drop counter on /diagnostics, as ``node: reason`` -> count."""
    if topics.DIAGNOSTICS.name not in reader.topics:
        return {}
    counters: dict[str, int] = {}
    for raw in reader.messages([topics.DIAGNOSTICS.name]):
        for status in reader.decode(raw).status:
            for pair in status.values:
                if pair.key.startswith("dropped: "):
                    counters[f"{status.name}: {pair.key[9:]}"] = int(pair.value)
    return counters


def summarise(run: RunFolder) -> Summary:
    """Measure everything that the input has a reference for; also writes ``summary.json``."""
    info = run.info()
    with BagReader(measures.input_bag(run)) as reader:
        topics_in, seconds = _counts(reader), (reader.end_ns - reader.start_ns) * 1e-9
    with BagReader(run.result) as reader:
        topics_out, dropped = _counts(reader, "/sf/"), _dropped(reader)
    values: dict[str, Any] = {
        "line": info["line"],
        "engine": info["engine"],
        "seconds": info["seconds"],
        "input_seconds": seconds,
        "topics_in": topics_in,
        "topics_out": topics_out,
        "dropped": {**info.get("dropped", {}), **dropped},
    }
    measured = {
        "trajectory": lambda: measures.measure_trajectory(run).as_dict(),
        "depth": lambda: measures.measure_depth(run).as_dict(),
        "completion": lambda: measures.measure_completion(run, 0.5).as_dict(),
        "render": lambda: measures.measure_render(run),
    }
    values |= {name: _or_reason(measure) for name, measure in measured.items()}
    (run.path / "summary.json").write_text(json.dumps(values, indent=2, default=str))
    return Summary(run, values)


def _middle_keyframe_sample(run: RunFolder, views: list[measures.HeldOutView]) -> figures.Sample | None:
    """Image, LiDAR points, completed depth and rendered view of the keyframe in the middle of the run."""
    maps = dict(run.depth_maps())
    if not maps:
        return None
    stamp = sorted(maps)[len(maps) // 2]
    with BagReader(run.result) as reader:
        names = [n for n in (topics.KEYFRAME_IMAGE.name, topics.KEYFRAME_DEPTH.name) if n in reader.topics]
        found: dict[str, Any] = {}
        for raw in reader.messages(names):
            message = reader.decode(raw)
            if to_ns(message.header.stamp) == stamp:
                found[raw.topic] = message
    if topics.KEYFRAME_IMAGE.name not in found:
        return None
    sparse: DepthMap | None = None
    if topics.KEYFRAME_DEPTH.name in found:
        sparse = decode_depth(found[topics.KEYFRAME_DEPTH.name])
    middle = views[len(views) // 2].rendered if views else None
    is_sparse = sparse is not None and sparse.density < 0.5
    image = decode_image(found[topics.KEYFRAME_IMAGE.name])
    return figures.Sample(image, sparse if is_sparse else None, maps[stamp], middle)


def run_figures(run: RunFolder) -> dict[str, Figure]:
    """Every plot that this run has the data for, by name."""
    out = {}
    drawn = _or_reason(lambda: measures.render_held_out(run))
    views = [] if isinstance(drawn, str) else drawn
    sample, pair = _or_reason(lambda: _middle_keyframe_sample(run, views)), _or_reason(lambda: _aligned(run))
    if isinstance(sample, figures.Sample):
        out["overview"] = figures.overview(sample, *_ways(run, pair))
    if isinstance(pair, AlignedTrajectories):
        out["trajectory"] = figures.trajectory_figure(pair)
    landmarks = _or_reason(run.landmarks)
    if not isinstance(landmarks, str) and len(landmarks):
        ways = run.trajectory().positions, run.keyframes().positions
        out["trajectory and landmarks"] = figures.landmarks_figure(landmarks, *ways)
    if views:
        chosen = sorted({0, len(views) // 2, len(views) - 1})
        out["views that were not used"] = figures.views_figure([(views[k].rendered, views[k].real) for k in chosen])
    depth = _or_reason(lambda: [(found, truth) for _, found, truth in measures.depth_pairs(run)])
    if depth and not isinstance(depth, str):
        shown = sorted({0, len(depth) // 2, len(depth) - 1})
        out["depth error"] = figures.depth_error_figure([depth[k] for k in shown])
        errors = _calibration_samples(depth)
        if errors is not None:
            out["calibration of the depth variance"] = figures.calibration_figure(*errors)
    if (times := run.timing()) is not None:
        calls = {name: t["each_ms"] for name, t in times.items() if "each_ms" in t}
        if calls:
            out["rate and latency"] = figures.timing_figure(calls)
    return out


def _ways(run: RunFolder, pair: AlignedTrajectories | str) -> tuple[Float64 | None, Float64 | None]:
    """Positions of the camera as estimated and, where the input has a reference, as they were."""
    if isinstance(pair, AlignedTrajectories):
        return pair.estimate[:, :3, 3], pair.reference[:, :3, 3]
    own = _or_reason(run.trajectory)
    return (None if isinstance(own, str) else own.positions), None


def _aligned(run: RunFolder) -> AlignedTrajectories:
    return align_trajectories(run.trajectory(), measures.truth_of(run))


def write_page(summary: Summary) -> None:
    """Write ``overview.png`` and ``report.html`` into the run folder."""
    run, made = summary.run, run_figures(summary.run)
    if "overview" in made:
        made["overview"].savefig(run.path / "overview.png", dpi=80)
    page = Page("SceneFactory run")
    page.table([(r.name, r.value) for r in summary.rows()])
    add_figures(page, made)
    page.details("line", run.info()["explanation"])
    page.details("numbers", summary.values)
    page.write(run.path / "report.html")
    figures.close(made)


def _calibration_samples(pairs: list[tuple[DepthMap, DepthMap]]) -> tuple[Float64, Float64] | None:
    """Absolute errors and sigmas of all completed pixels with ground truth, [N] each, m."""
    errors, sigmas = [], []
    for depth, reference in pairs:
        if depth.variance is not None:
            both = depth.valid & reference.valid
            errors.append(np.abs(depth.z[both] - reference.z[both]))
            sigmas.append(np.sqrt(depth.variance[both]))
    return (np.concatenate(errors), np.concatenate(sigmas)) if errors else None
