"""Trajectories as files: TUM (stamp tx ty tz qx qy qz qw) and KITTI (rows of 3x4)."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from sf_interfaces.errors import FormatError
from sf_interfaces.geometry import se3
from sf_interfaces.types import Float64, Scale, Trajectory


def _rows(path: Path, columns: int, form: str) -> list[list[str]]:
    try:
        lines = path.read_text().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise FormatError(f"cannot read trajectory {path}: {error}; give a {form} text file") from error
    rows = []
    for number, line in enumerate(lines, 1):
        words = line.replace(",", " ").split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) != columns:
            raise FormatError(f"{path}:{number} has {len(words)} values; {form} needs {columns} in each line")
        rows.append(words)
    if not rows:
        raise FormatError(f"trajectory {path} holds no pose; give a {form} file with at least one line")
    return rows


def _numbers(path: Path, rows: list[list[str]]) -> Float64:
    try:
        values = np.array(rows, dtype=np.float64)
    except ValueError as error:
        raise FormatError(f"{path} holds something that is no number ({error}); mend that line") from error
    if not np.isfinite(values).all():
        raise FormatError(f"{path} holds values that are not finite; remove those lines")
    return values


def read_tum(path: Path, scale: Scale = Scale.METRIC) -> Trajectory:
    """Read a TUM file. Stamps are read exactly (decimal, not float); order and duplicates are mended.

    Raises:
        FormatError: unreadable, wrong number of values, or a quaternion of length zero.
    """
    rows = _rows(path, 8, "TUM")
    try:
        stamps = [int((Decimal(row[0]) * 10**9).to_integral_value()) for row in rows]
    except (InvalidOperation, OverflowError, ValueError) as error:
        raise FormatError(f"{path} holds a stamp that is no number; mend that line") from error
    if max(map(abs, stamps)) >= 1 << 63:
        raise FormatError(f"{path} holds a stamp centuries away; TUM files count seconds, not nanoseconds")
    values = _numbers(path, [row[1:] for row in rows])
    if (np.linalg.norm(values[:, 3:], axis=1) < 1e-6).any():
        raise FormatError(f"{path} holds a quaternion of length zero; remove that line")
    poses = se3.from_quaternion(values[:, :3], values[:, 3:])
    return Trajectory.from_pairs(list(dict(zip(stamps, poses, strict=True)).items()), scale)


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write a TUM file, stamps in seconds with nine decimals."""
    t, q = se3.to_quaternion(trajectory.poses)
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w") as file:
        for stamp, values in zip(trajectory.stamps_ns.tolist(), np.hstack([t, q]), strict=True):
            sec, nanosec = divmod(stamp, 1_000_000_000)
            file.write(f"{sec}.{nanosec:09d} " + " ".join(f"{v:.9f}" for v in values) + "\n")


def read_kitti(path: Path, times: Path | None = None, scale: Scale = Scale.METRIC) -> Trajectory:
    """Read KITTI rows of 3x4 with times in seconds from another file (without: 10 Hz from 0).

    Raises:
        FormatError: unreadable, wrong number of values, or fewer times than poses.
    """
    values = _numbers(path, _rows(path, 12, "KITTI")).reshape(-1, 3, 4)
    poses = np.tile(np.eye(4), (len(values), 1, 1))
    poses[:, :3] = values
    stamps = np.arange(len(poses), dtype=np.int64) * 100_000_000
    if times is not None:
        seconds = _numbers(times, _rows(times, 1, "a list of times"))[:, 0]
        if len(seconds) < len(poses):
            raise FormatError(f"{times} has {len(seconds)} times for {len(poses)} poses; give one per pose")
        stamps = np.rint(seconds[: len(poses)] * 1e9).astype(np.int64)
    return Trajectory(stamps, se3.orthonormalise(poses), scale)


def write_kitti(path: Path, trajectory: Trajectory) -> None:
    """Write KITTI rows of 3x4."""
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, trajectory.poses[:, :3].reshape(-1, 12), fmt="%.9e")
