"""The pictures of a run: what went in, what came out, and how far off it is."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib

matplotlib.use("Agg")  # reports are written on machines without a display
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from sf_bringup.evaluation.depth import sparsification
from sf_bringup.evaluation.trajectory import AlignedTrajectories
from sf_interfaces.types import DepthMap, Float32, Float64, UInt8


@dataclass(frozen=True, slots=True)
class Sample:
    """One keyframe to show: what came in and what the line made of it."""

    image: UInt8  # [H, W, 3]
    sparse: DepthMap | None
    dense: DepthMap | None
    rendered: UInt8 | None  # [H, W, 3] of a held-out view where there is one


def _depth_panel(axis: Any, z: Float64, title: str, figure: Figure, unit: str = "m", cmap: str = "turbo") -> None:
    finite = z[np.isfinite(z)]
    low, high = np.percentile(finite, (2, 98)) if finite.size else (0.0, 1.0)
    shown = axis.imshow(z, cmap=cmap, vmin=low, vmax=max(high, low + 1e-6), interpolation="nearest")
    axis.set_title(title)
    axis.axis("off")
    figure.colorbar(shown, ax=axis, fraction=0.04, label=unit)


def _image_panel(axis: Any, image: UInt8 | None, title: str) -> None:
    if image is not None:
        axis.imshow(image, cmap="gray" if image.ndim == 2 else None)
    else:
        axis.text(0.5, 0.5, "not part of this line", ha="center", va="center", transform=axis.transAxes)
    axis.set_title(title)
    axis.axis("off")


def _trajectory_panel(axis: Any, estimate: Float64, reference: Float64 | None) -> None:
    """Top view along the axis of least extent, so that any mounting of the sensor gives a useful map."""
    both = estimate if reference is None else np.concatenate([estimate, reference])
    a, b = np.sort(np.argsort(-np.ptp(both, axis=0))[:2])
    if reference is not None:
        axis.plot(reference[:, a], reference[:, b], "k--", lw=1.5, label="reference")
    axis.plot(estimate[:, a], estimate[:, b], "C0", lw=2, label="estimate")
    axis.set_xlabel(f"{'xyz'[a]} / m")
    axis.set_ylabel(f"{'xyz'[b]} / m")
    axis.axis("equal")
    axis.grid(alpha=0.3)
    axis.legend(loc="best")
    axis.set_title("trajectory")


def overview(sample: Sample, estimate: Float64 | None, reference: Float64 | None) -> Figure:
    """Input, depth, its standard deviation and a rendered view of one keyframe, and the way of the camera.

    Args:
        estimate, reference: positions [N, 3] and [M, 3] in m, aligned; None where unknown.
    """
    figure = plt.figure(figsize=(17, 8), constrained_layout=True)
    grid = figure.add_gridspec(2, 3)
    axes = np.array([[figure.add_subplot(grid[row, column]) for column in (0, 1)] for row in (0, 1)])
    if estimate is not None:
        _trajectory_panel(figure.add_subplot(grid[:, 2]), estimate, reference)
    _image_panel(axes[0, 0], sample.image, "input image" + (" and LiDAR points" if sample.sparse else ""))
    if sample.sparse is not None:
        row, col = np.nonzero(sample.sparse.valid)
        axes[0, 0].scatter(col, row, c=sample.sparse.z[row, col], s=1.2, cmap="turbo", linewidths=0)
    _image_panel(axes[1, 0], sample.rendered, "rendered view")
    dense = sample.dense
    _depth_or_note(axes[0, 1], None if dense is None else dense.z, "depth", figure)
    sigma = None if dense is None or dense.variance is None else np.sqrt(dense.variance)
    _depth_or_note(axes[1, 1], sigma, "standard deviation of depth", figure, "magma")
    return figure


def _depth_or_note(axis: Any, z: Any, title: str, figure: Figure, cmap: str = "turbo") -> None:
    if z is None:
        _image_panel(axis, None, title)
    else:
        _depth_panel(axis, np.asarray(z, np.float64), title, figure, cmap=cmap)


def views_figure(pairs: Sequence[tuple[UInt8, UInt8]]) -> Figure:
    """The recorded image, the rendered view and four times their difference, one row for each (rendered, real)."""
    figure, axes = plt.subplots(len(pairs), 3, figsize=(13, 3.2 * len(pairs)), squeeze=False, constrained_layout=True)
    for row, (rendered, real) in zip(axes, pairs, strict=True):
        difference = np.clip(4 * np.abs(rendered.astype(int) - real), 0, 255).astype(np.uint8)
        titles = ("recorded, not a keyframe", "rendered", "4 x difference")
        for axis, image, title in zip(row, (real, rendered, difference), titles, strict=True):
            _image_panel(axis, image, title)
    return figure


def trajectory_figure(pair: AlignedTrajectories) -> Figure:
    """Top view beside the reference, and the position error over time."""
    figure, (top, error) = plt.subplots(1, 2, figsize=(13, 5), constrained_layout=True)
    _trajectory_panel(top, pair.estimate[:, :3, 3], pair.reference[:, :3, 3])
    error.plot((pair.stamps_ns - pair.stamps_ns[0]) * 1e-9, 100 * pair.errors, "C3")
    error.set_xlabel("time / s")
    error.set_ylabel("position error / cm")
    error.set_title("error over time")
    error.grid(alpha=0.3)
    return figure


def landmarks_figure(landmarks: Float32, frames: Float64, keyframes: Float64) -> Figure:
    """Landmarks [N, 3] of a map with the way of the camera [M, 3] and its keyframes [K, 3], along both wider axes."""
    figure, axes = plt.subplots(1, 2, figsize=(13, 6), constrained_layout=True)
    some = landmarks[:: max(1, len(landmarks) // 20_000)]
    low, high = np.percentile(some, (1, 99), axis=0) if len(some) else (keyframes.min(axis=0), keyframes.max(axis=0))
    first, second, third = np.argsort(low - high)
    for axis, a, b in zip(axes, (first, first), (second, third), strict=True):
        axis.scatter(some[:, a], some[:, b], s=0.4, c="0.4", linewidths=0, label="landmarks", rasterized=True)
        axis.plot(frames[:, a], frames[:, b], "C0", lw=1.5, label="frames")
        axis.plot(keyframes[:, a], keyframes[:, b], "C3.", ms=4, label="keyframes")
        margin = 0.1 * (high - low) + 0.1
        every = np.concatenate([frames, keyframes, low[None] - margin, high[None] + margin])
        axis.set_xlim(every[:, a].min(), every[:, a].max())
        axis.set_ylim(every[:, b].min(), every[:, b].max())
        axis.set_aspect("equal")
        axis.set_xlabel(f"{'xyz'[a]}")
        axis.set_ylabel(f"{'xyz'[b]}")
        axis.grid(alpha=0.3)
    axes[0].legend(loc="best", markerscale=4)
    return figure


def depth_error_figure(pairs: Sequence[tuple[DepthMap, DepthMap]]) -> Figure:
    """Estimated depth, true depth and relative error, one row for each (estimate, truth)."""
    figure, axes = plt.subplots(len(pairs), 3, figsize=(13, 3.2 * len(pairs)), squeeze=False, constrained_layout=True)
    for row, (found, truth) in zip(axes, pairs, strict=True):
        z, g = np.asarray(found.z, np.float64), np.asarray(truth.z, np.float64)
        _depth_panel(row[0], z, "estimated depth", figure)
        _depth_panel(row[1], g, "true depth", figure)
        _depth_panel(row[2], 100 * np.abs(z - g) / g, "relative error", figure, "%", "magma")
    return figure


def calibration_figure(errors: Float64, sigmas: Float64) -> Figure:
    """How often the depth error stays below n sigma beside a Gaussian, and the sparsification by sigma.

    Args:
        errors: absolute depth errors [N], m.
        sigmas: predicted standard deviations [N], m.
    """
    from scipy.stats import norm

    n = np.linspace(0, 4, 81)
    ratio = np.sort(errors / np.maximum(sigmas, 1e-12))
    figure, (below, sparse) = plt.subplots(1, 2, figsize=(11, 4), constrained_layout=True)
    below.plot(n, 100 * np.searchsorted(ratio, n) / max(1, len(ratio)), label="measured")
    below.plot(n, 100 * (2 * norm.cdf(n) - 1), "k--", label="Gaussian")
    below.set_xlabel("error / predicted sigma")
    below.set_ylabel("pixels below / %")
    below.set_title("calibration of the depth variance")
    removed, by_sigma, by_error = sparsification(errors, sigmas)
    sparse.plot(100 * removed, by_sigma, label="by predicted sigma")
    sparse.plot(100 * removed, by_error, "k--", label="by true error")
    sparse.set_xlabel("most uncertain pixels removed / %")
    sparse.set_ylabel("mean error of the rest, relative")
    sparse.set_title("sparsification")
    for axis in (below, sparse):
        axis.legend()
        axis.grid(alpha=0.3)
    return figure


def timing_figure(each_ms: Mapping[str, Sequence[float]]) -> Figure:
    """Latency of every call of each stage, and its distribution; the legend says the rate this allows."""
    figure, (over, spread) = plt.subplots(1, 2, figsize=(13, 4), constrained_layout=True)
    for stage, values in each_ms.items():
        label = f"{stage}: median {np.median(values):.0f} ms, {1e3 / max(np.mean(values), 1e-6):.1f} calls/s"
        over.plot(values, label=label, lw=1)
        ordered = np.sort(values)
        spread.plot(ordered, 100 * (np.arange(len(ordered)) + 1) / len(ordered), label=stage)
    over.set_xlabel("call")
    over.set_ylabel("latency / ms")
    spread.set_xlabel("latency / ms")
    spread.set_ylabel("calls below / %")
    for axis, title in ((over, "latency and rate"), (spread, "distribution of latency")):
        axis.set_title(title)
        axis.set_yscale("log" if axis is over else "linear")
        axis.legend(fontsize=8)
        axis.grid(alpha=0.3)
    return figure


def close(figures: Mapping[str, Figure]) -> None:
    """Release the memory that matplotlib keeps for open figures."""
    for figure in figures.values():
        plt.close(figure)
