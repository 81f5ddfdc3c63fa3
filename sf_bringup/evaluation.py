"""Measures of a run against ground truth: trajectory, depth, completion and rendered views."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from sf_interfaces.errors import FormatError
from sf_interfaces.geometry import se3
from sf_interfaces.geometry.align import align
from sf_interfaces.types import DepthMap, Float64, Scale, Trajectory, UInt8

INLIER_RATIO = 1.03  # RobustMVD: max(p/g, g/p) below this counts as an inlier


@dataclass(frozen=True, slots=True)
class TrajectoryError:
    """Absolute trajectory error in metres after alignment of matched positions."""

    rmse: float
    median: float
    max: float
    pairs: int
    path_length: float
    scale: float

    def as_dict(self) -> dict[str, float]:
        """Plain numbers for JSON."""
        return asdict(self)


def match_stamps(a: np.ndarray, b: np.ndarray, max_difference_ns: int) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the nearest stamp in ``b`` for each of ``a``, where within the limit. Both sorted, ns."""
    if len(b) == 0:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    right = np.clip(np.searchsorted(b, a), 0, len(b) - 1)
    left = np.maximum(right - 1, 0)
    nearest = np.where(np.abs(b[left] - a) <= np.abs(b[right] - a), left, right)
    keep = np.abs(b[nearest] - a) <= max_difference_ns
    return np.nonzero(keep)[0], nearest[keep]


def trajectory_error(
    estimate: Trajectory, reference: Trajectory, max_difference_ns: int = 10_000_000
) -> TrajectoryError:
    """ATE after SE3 alignment (metric) or Sim3 alignment (arbitrary scale), as evo computes it.

    Raises:
        FormatError: fewer than three stamps match.
    """
    i, j = match_stamps(estimate.stamps_ns, reference.stamps_ns, max_difference_ns)
    if len(i) < 3:
        raise FormatError(
            f"only {len(i)} of {len(estimate)} poses have a reference within {max_difference_ns / 1e6:.0f} ms; "
            "check that both trajectories use the same clock"
        )
    est, ref = estimate.positions[i], reference.positions[j]
    scale, T = align(est, ref, with_scale=estimate.scale is Scale.ARBITRARY)
    error = np.linalg.norm(se3.transform(T, scale * est) - ref, axis=1)
    length = float(np.linalg.norm(np.diff(ref, axis=0), axis=1).sum())
    rmse = float(np.sqrt((error**2).mean()))
    return TrajectoryError(rmse, float(np.median(error)), float(error.max()), len(i), length, scale)


@dataclass(frozen=True, slots=True)
class DepthError:
    """Depth error over the pixels valid in both maps, without alignment; calibration where variance is known."""

    absrel: float  # percent
    inlier: float  # percent of pixels within the 1.03 ratio
    mae: float  # m
    rmse: float  # m
    density: float  # percent of reference pixels that are predicted
    within_1_sigma: float  # percent, NaN without variance; a Gaussian has 68.3
    within_2_sigma: float  # percent, NaN without variance; a Gaussian has 95.4
    pixels: int

    def as_dict(self) -> dict[str, float]:
        """Plain numbers for JSON."""
        return asdict(self)


def depth_error(estimate: DepthMap, reference: DepthMap) -> DepthError:
    """Compare one depth map with its reference of the same size (RobustMVD definitions, no alignment).

    Raises:
        FormatError: sizes differ or no pixel is valid in both.
    """
    if estimate.z.shape != reference.z.shape:
        raise FormatError(f"depth maps differ in size: {estimate.z.shape} and {reference.z.shape}")
    both = estimate.valid & reference.valid
    if not both.any():
        raise FormatError("no pixel has both an estimated and a reference depth")
    p, g = estimate.z[both].astype(np.float64), reference.z[both].astype(np.float64)
    error = np.abs(p - g)
    within = (float("nan"), float("nan"))
    if estimate.variance is not None:
        sigma = np.sqrt(estimate.variance[both].astype(np.float64))
        within = (100 * float((error <= sigma).mean()), 100 * float((error <= 2 * sigma).mean()))
    return DepthError(
        absrel=100 * float((error / g).mean()),
        inlier=100 * float((np.maximum(p / g, g / p) < INLIER_RATIO).mean()),
        mae=float(error.mean()),
        rmse=float(np.sqrt((error**2).mean())),
        density=100 * float(both.sum() / max(1, reference.valid.sum())),
        within_1_sigma=within[0],
        within_2_sigma=within[1],
        pixels=int(both.sum()),
    )


def mean_depth_error(errors: list[DepthError]) -> DepthError:
    """Mean over images of each measure; pixel counts add up."""
    rows = np.array([[float(value) for value in asdict(e).values()] for e in errors])
    mean = rows.mean(axis=0)
    return DepthError(*(float(v) for v in mean[:-1]), pixels=int(rows[:, -1].sum()))


def psnr(image: UInt8, reference: UInt8, mask: np.ndarray | None = None) -> float:
    """Peak signal-to-noise ratio in dB on [0, 1] values, over the mask [H, W] where given."""
    difference = (image.astype(np.float64) - reference.astype(np.float64)) / 255.0
    if mask is not None:
        difference = difference[mask]
    mse = float((difference**2).mean()) if difference.size else float("nan")
    return float("inf") if mse == 0 else -10.0 * float(np.log10(mse))


def interpolate_pose(trajectory: Trajectory, stamp_ns: int) -> Float64 | None:
    """Pose at a stamp, on the screw between its neighbours; None outside the trajectory."""
    stamps = trajectory.stamps_ns
    if len(stamps) == 0 or stamp_ns < stamps[0] or stamp_ns > stamps[-1]:
        return None
    k = int(np.searchsorted(stamps, stamp_ns))
    if stamps[k] == stamp_ns:
        return trajectory.poses[k]
    alpha = (stamp_ns - stamps[k - 1]) / (stamps[k] - stamps[k - 1])
    return se3.interpolate(trajectory.poses[k - 1], trajectory.poses[k], float(alpha))
