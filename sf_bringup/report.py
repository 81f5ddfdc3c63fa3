"""The picture and the page of a run: inputs, results and numbers in one self-contained ``report.html``."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import base64
import html
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")  # reports are written on machines without a display
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from sf_interfaces.types import DepthMap, Float64, Trajectory, UInt8


@dataclass(frozen=True, slots=True)
class Sample:
    """One keyframe to show: what came in and what the line made of it."""

    image: UInt8  # [H, W, 3]
    sparse: DepthMap | None
    dense: DepthMap | None
    rendered: UInt8 | None  # [H, W, 3] of a held-out view where there is one


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the result table."""

    name: str
    value: str


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


def overview(sample: Sample, estimate: Float64, reference: Float64 | None) -> Figure:
    """Input, completed depth, its standard deviation, a rendered view and the trajectory.

    Args:
        sample: the keyframe to show.
        estimate, reference: aligned positions [N, 3] and [M, 3] in m; reference None where unknown.
    """
    figure, axes = plt.subplots(2, 3, figsize=(15, 7.6), constrained_layout=True)
    _image_panel(axes[0, 0], sample.image, "input image and LiDAR points")
    if sample.sparse is not None:
        row, col = np.nonzero(sample.sparse.valid)
        axes[0, 0].scatter(col, row, c=sample.sparse.z[row, col], s=1.2, cmap="turbo", linewidths=0)
    if sample.dense is not None:
        _depth_panel(axes[0, 1], np.asarray(sample.dense.z, np.float64), "depth", figure)
    else:
        _image_panel(axes[0, 1], None, "depth")
    if sample.dense is not None and sample.dense.variance is not None:
        sigma = np.sqrt(np.asarray(sample.dense.variance, np.float64))
        _depth_panel(axes[0, 2], sigma, "standard deviation of depth", figure, cmap="magma")
    else:
        _image_panel(axes[0, 2], None, "standard deviation of depth")
    _image_panel(axes[1, 0], sample.rendered, "rendered view")
    _trajectory_panel(axes[1, 1], estimate, reference)
    axes[1, 2].axis("off")
    if reference is not None and len(reference) == len(estimate):
        axes[1, 2].axis("on")
        axes[1, 2].plot(100 * np.linalg.norm(estimate - reference, axis=1), "C3")
        axes[1, 2].set_title("position error over frames")
        axes[1, 2].set_ylabel("cm")
        axes[1, 2].set_xlabel("frame")
        axes[1, 2].grid(alpha=0.3)
    return figure


def calibration_figure(errors: Float64, sigmas: Float64) -> Figure:
    """How often the depth error stays below n sigma, beside the Gaussian it should follow.

    Args:
        errors: absolute depth errors [N], m.
        sigmas: predicted standard deviations [N], m.
    """
    from scipy.stats import norm

    n = np.linspace(0, 4, 81)
    ratio = np.sort(errors / np.maximum(sigmas, 1e-12))
    figure, axis = plt.subplots(figsize=(5, 4), constrained_layout=True)
    axis.plot(n, 100 * np.searchsorted(ratio, n) / max(1, len(ratio)), label="measured")
    axis.plot(n, 100 * (2 * norm.cdf(n) - 1), "k--", label="Gaussian")
    axis.set_xlabel("error / predicted sigma")
    axis.set_ylabel("pixels below / %")
    axis.set_title("calibration of the depth variance")
    axis.legend()
    axis.grid(alpha=0.3)
    return figure


def _embed(figure: Figure) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=90)
    return base64.b64encode(buffer.getvalue()).decode()


def write_report(
    path: Path,
    title: str,
    rows: Sequence[Row],
    figures: Mapping[str, Figure],
    details: Mapping[str, Any],
) -> None:
    """Write one HTML file that needs nothing beside it: numbers, figures and the plan with its reasons."""
    table = "".join(f"<tr><td>{html.escape(r.name)}</td><td>{html.escape(r.value)}</td></tr>" for r in rows)
    images = "".join(
        f'<h2>{html.escape(name)}</h2><img src="data:image/png;base64,{_embed(figure)}">'
        for name, figure in figures.items()
    )
    blocks = "".join(
        f"<h2>{html.escape(name)}</h2><pre>{html.escape(_text(value))}</pre>" for name, value in details.items()
    )
    style = (
        "body{font-family:sans-serif;max-width:1300px;margin:2em auto;padding:0 1em}"
        "td{padding:.2em 1.2em .2em 0;border-bottom:1px solid #ddd}"
        "img{max-width:100%}pre{background:#f6f6f6;padding:1em;overflow:auto}"
    )
    path.write_text(
        f"<!doctype html><html><head><meta charset='utf-8'><title>{html.escape(title)}</title>"
        f"<style>{style}</style></head><body><h1>{html.escape(title)}</h1>"
        f"<table>{table}</table>{images}{blocks}</body></html>"
    )


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, indent=2, default=str)


def aligned_positions(estimate: Trajectory, reference: Trajectory | None) -> tuple[Float64, Float64 | None]:
    """Estimated positions, and reference positions brought into the estimate's frame, frame by frame.

    Frames without a reference are left out where a reference exists.
    """
    from sf_bringup.evaluation import match_stamps
    from sf_interfaces.geometry import se3
    from sf_interfaces.geometry.align import align

    if reference is None:
        return estimate.positions, None
    i, j = match_stamps(estimate.stamps_ns, reference.stamps_ns, 10_000_000)
    if len(i) < 3:
        return estimate.positions, None
    est, ref = estimate.positions[i], reference.positions[j]
    _, T = align(ref, est)
    return est, se3.transform(T, ref)


def close(figures: Mapping[str, Figure]) -> None:
    """Release the memory that matplotlib keeps for open figures."""
    for figure in figures.values():
        plt.close(figure)
