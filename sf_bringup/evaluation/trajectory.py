"""Errors of trajectories: absolute (ATE) after alignment, and relative (RPE) over a number of frames."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sf_interfaces.errors import ConfigError, FormatError
from sf_interfaces.geometry import se3
from sf_interfaces.geometry.align import align
from sf_interfaces.types import Float64, Scale, Trajectory

ALIGNMENTS = ("se3", "sim3", "none")
MAX_DIFFERENCE_NS = 10_000_000  # evo's default: stamps further apart are no pair


@dataclass(frozen=True, slots=True)
class AlignedTrajectories:
    """Matched poses of two trajectories, the estimate brought into the frame of the reference.

    Args:
        stamps_ns: of the estimate, [N].
        estimate, reference: [N, 4, 4].
        scale, T_reference_estimate: what was applied: ``reference ~ T (scale * estimate)``.
    """

    stamps_ns: NDArray[np.int64]
    estimate: Float64
    reference: Float64
    scale: float
    T_reference_estimate: Float64

    @property
    def errors(self) -> Float64:
        """Distance of matched positions, [N] m."""
        return np.linalg.norm(self.estimate[:, :3, 3] - self.reference[:, :3, 3], axis=1)


@dataclass(frozen=True, slots=True)
class TrajectoryError:
    """ATE in metres over matched positions; RPE per ``delta`` frames in metres and degrees."""

    rmse: float
    mean: float
    median: float
    max: float
    rpe_rmse: float  # m
    rpe_median: float  # m
    rpe_rotation_rmse: float  # degrees
    rpe_rotation_median: float  # degrees
    delta: int
    pairs: int
    path_length: float  # m, of the matched reference
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


def align_trajectories(
    estimate: Trajectory,
    reference: Trajectory,
    alignment: str | None = None,
    max_difference_ns: int = MAX_DIFFERENCE_NS,
) -> AlignedTrajectories:
    """Match by time, starting from the trajectory with fewer poses as evo does, and align (Umeyama).

    Args:
        alignment: se3, sim3 or none; None: sim3 where the estimate's scale is arbitrary, else se3.

    Raises:
        ConfigError: unknown alignment.
        FormatError: fewer than three stamps match, or the scale cannot be found as nothing moves.
    """
    alignment = alignment or ("sim3" if estimate.scale is Scale.ARBITRARY else "se3")
    if alignment not in ALIGNMENTS:
        raise ConfigError(f"alignment '{alignment}' is unknown; choose {', '.join(ALIGNMENTS)}")
    if len(reference) > len(estimate):
        i, j = match_stamps(estimate.stamps_ns, reference.stamps_ns, max_difference_ns)
    else:
        j, i = match_stamps(reference.stamps_ns, estimate.stamps_ns, max_difference_ns)
    if len(i) < 3:
        raise FormatError(
            f"only {len(i)} of {len(estimate)} poses have a reference within {max_difference_ns / 1e6:.0f} ms, "
            "at least 3 are needed; check that both trajectories use the same clock"
        )
    source, target = estimate.positions[i], reference.positions[j]
    if alignment == "sim3" and np.ptp(source, axis=0).max() < 1e-9:
        raise FormatError("all matched poses lie in one place: no scale can be found; choose --align se3")
    scale, T = (1.0, np.eye(4)) if alignment == "none" else align(source, target, with_scale=alignment == "sim3")
    poses = np.array(estimate.poses[i])
    poses[:, :3, 3] *= scale
    return AlignedTrajectories(estimate.stamps_ns[i], T @ poses, reference.poses[j], scale, T)


def trajectory_error(
    estimate: Trajectory,
    reference: Trajectory,
    max_difference_ns: int = MAX_DIFFERENCE_NS,
    alignment: str | None = None,
    delta: int = 1,
) -> TrajectoryError:
    """ATE and RPE as evo computes them (RPE over all pairs of matched poses ``delta`` apart).

    Raises:
        FormatError: fewer than three stamps match, or no two of them are ``delta`` apart.
    """
    pair = align_trajectories(estimate, reference, alignment, max_difference_ns)
    if not 1 <= delta < len(pair.stamps_ns):
        raise FormatError(
            f"no two of {len(pair.stamps_ns)} matched poses are {delta} frames apart; choose another delta"
        )
    error = pair.errors
    relative = _relative_errors(pair, delta)
    step = np.linalg.norm(relative[:, :3, 3], axis=1)
    angle = np.degrees(Rotation.from_matrix(relative[:, :3, :3]).magnitude())
    return TrajectoryError(
        rmse=_rms(error),
        mean=float(error.mean()),
        median=float(np.median(error)),
        max=float(error.max()),
        rpe_rmse=_rms(step),
        rpe_median=float(np.median(step)),
        rpe_rotation_rmse=_rms(angle),
        rpe_rotation_median=float(np.median(angle)),
        delta=delta,
        pairs=len(error),
        path_length=float(np.linalg.norm(np.diff(pair.reference[:, :3, 3], axis=0), axis=1).sum()),
        scale=pair.scale,
    )


def _relative_errors(pair: AlignedTrajectories, delta: int) -> Float64:
    """(Q_i^-1 Q_j)^-1 (P_i^-1 P_j) of reference Q and estimate P, j = i + delta: [N - delta, 4, 4]."""
    Q = se3.inverse(pair.reference[:-delta]) @ pair.reference[delta:]
    P = se3.inverse(pair.estimate[:-delta]) @ pair.estimate[delta:]
    return se3.inverse(Q) @ P


def _rms(values: Float64) -> float:
    return float(np.sqrt((values**2).mean()))


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
