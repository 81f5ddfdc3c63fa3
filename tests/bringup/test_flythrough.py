"""The smooth way of a flight, on ways with known answers; the whole verb is tested in test_lines."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sf_bringup import cli
from sf_bringup.flythrough import smooth_way
from sf_interfaces.errors import FormatError
from sf_interfaces.geometry import se3


def test_a_flight_is_even_and_smoother_than_the_hand_that_held_the_camera() -> None:
    rng = np.random.default_rng(0)
    angle = np.linspace(0, 1.5 * np.pi, 60) ** 1.2  # accelerates
    poses = np.tile(np.eye(4), (60, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(np.outer(angle, [0, 1, 0])).as_matrix()
    poses[:, :3, 3] = np.column_stack([2 * np.cos(angle), 0 * angle, 2 * np.sin(angle)])
    poses[:, :3, 3] += rng.normal(0, 0.02, (60, 3))
    way = smooth_way(poses, 200)
    assert way.shape == (200, 4, 4) and np.abs(way - se3.orthonormalise(way)).max() < 1e-9
    assert (
        np.linalg.norm(way[0, :3, 3] - poses[0, :3, 3]) < 0.2
        and np.linalg.norm(way[-1, :3, 3] - poses[-1, :3, 3]) < 0.3
    )
    assert np.abs(np.linalg.norm(way[20:-20, [0, 2], 3], axis=1) - 2).max() < 0.08  # stays on the circle
    steps = np.linalg.norm(np.diff(way[:, :3, 3], axis=0), axis=1)[20:-20]
    jumps = np.linalg.norm(np.diff(poses[:, :3, 3], n=2, axis=0), axis=1)
    assert steps.std() < 0.25 * steps.mean()
    assert np.linalg.norm(np.diff(way[:, :3, 3], n=2, axis=0), axis=1).max() < 0.3 * jumps.max()


def test_half_turns_of_the_sign_of_a_quaternion_do_not_matter() -> None:
    angle = np.linspace(0, 2.5 * np.pi, 40)
    poses = np.tile(np.eye(4), (40, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(np.outer(angle, [0, 0, 1])).as_matrix()
    way = smooth_way(poses, 100)
    turns = [np.linalg.norm(se3.log(se3.inverse(a) @ b)[3:]) for a, b in pairwise(way)]
    assert max(turns) < 0.15


def test_what_cannot_be_flown_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(FormatError, match="two keyframes"):
        smooth_way(np.eye(4)[None], 10)
    with pytest.raises(FormatError, match="never moves"):
        smooth_way(np.tile(np.eye(4), (5, 1, 1)), 10)
    for fly, out, words in (("1", "x.mp4", "two frames"), ("9", "x.avi", ".mp4")):
        assert cli.main(["render", str(tmp_path), "--fly", fly, "--out", str(tmp_path / out)]) == 2
        assert words in capsys.readouterr().err
