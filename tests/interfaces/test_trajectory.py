"""Trajectory files keep nanoseconds and poses."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sf_interfaces.errors import FormatError
from sf_interfaces.geometry import se3
from sf_interfaces.io.trajectory import read_kitti, read_tum, write_kitti, write_tum
from sf_interfaces.types import Trajectory


def sample(n: int = 30) -> Trajectory:
    poses = se3.exp(np.random.default_rng(0).normal(size=(n, 6)))
    return Trajectory(1_700_000_000_123_456_789 + np.arange(n) * 33_333_333, poses)


def test_tum_round_trip(tmp_path: Path) -> None:
    write_tum(tmp_path / "t.tum", sample())
    back = read_tum(tmp_path / "t.tum")
    np.testing.assert_array_equal(back.stamps_ns, sample().stamps_ns)
    np.testing.assert_allclose(back.poses, sample().poses, atol=1e-8)


def test_kitti_round_trip(tmp_path: Path) -> None:
    write_kitti(tmp_path / "p.txt", sample())
    (tmp_path / "times.txt").write_text("\n".join(f"{i * 0.1:.6f}" for i in range(30)))
    back = read_kitti(tmp_path / "p.txt", tmp_path / "times.txt")
    np.testing.assert_allclose(back.poses, sample().poses, atol=1e-8)
    assert back.stamps_ns[3] == 300_000_000


@pytest.mark.parametrize(
    "text", ["", "# only\n", "1 2 3\n", "1 0 0 0 0 0 0 0\n", "x 0 0 0 0 0 0 1\n", "1 0 0 nan 0 0 0 1\n"]
)
def test_bad_tum(tmp_path: Path, text: str) -> None:
    (tmp_path / "t.tum").write_text(text)
    with pytest.raises(FormatError):
        read_tum(tmp_path / "t.tum")
    with pytest.raises(FormatError, match="cannot read"):
        read_tum(tmp_path / "none.tum")


def test_real_files(shared_data: Callable[[str], Path]) -> None:
    folder = shared_data("trajectories_evo")
    assert len(read_tum(folder / "freiburg1_xyz-groundtruth.txt")) > 100
    assert len(read_kitti(folder / "KITTI_00_gt.txt", folder / "KITTI_00_gt_times.txt")) > 100
