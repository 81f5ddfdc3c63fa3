"""De-skewing recovers the static scene; projection keeps what the camera sees and nothing else."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sf_interfaces.errors import CalibrationError, FormatError
from sf_interfaces.geometry import se3
from sf_interfaces.geometry.lidar import deskew, project_sweep
from sf_interfaces.types import Camera

CAMERA = Camera(320, 240, 200.0, 200.0, 160.0, 120.0)
speed = st.floats(-20.0, 20.0)
turn = st.floats(-3.0, 3.0)


@settings(max_examples=60, deadline=None)
@given(
    st.tuples(speed, speed, speed, turn, turn, turn),
    st.integers(-100_000_000, 100_000_000),
    st.integers(0, 2**31),
)
def test_static_scene_deskews_to_the_truth(twist: tuple[float, ...], reference_ns: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = rng.uniform(-50, 50, (40, 3))  # world = LiDAR frame at offset 0
    offsets = rng.integers(-100_000_000, 100_000_000, 40)
    xi = np.array(twist)
    T_world_lidar = se3.exp(offsets[:, None] * 1e-9 * xi)
    scanned = (
        np.einsum("nij,nj->ni", se3.inverse(T_world_lidar)[:, :3, :3], truth) + se3.inverse(T_world_lidar)[:, :3, 3]
    )
    expected = se3.transform(se3.inverse(se3.exp(reference_ns * 1e-9 * xi)), truth)
    np.testing.assert_allclose(deskew(scanned, offsets, xi, reference_ns), expected, atol=1e-6)


def test_deskew_without_rotation_is_a_shift() -> None:
    moved = deskew(np.zeros((2, 3)), [0, 100_000_000], [10.0, 0, 0, 0, 0, 0])
    np.testing.assert_allclose(moved, [[0, 0, 0], [1.0, 0, 0]], atol=1e-12)


@pytest.mark.parametrize("twist", [[0.0] * 5, [np.nan] * 6])
def test_deskew_rejects_a_bad_twist(twist: list[float]) -> None:
    with pytest.raises(FormatError, match="twist"):
        deskew(np.zeros((1, 3)), [0], twist)


def test_deskew_rejects_missing_times() -> None:
    with pytest.raises(FormatError, match="one time offset per point"):
        deskew(np.zeros((3, 3)), [0, 1], np.zeros(6))


def _scan(T_camera_lidar: np.ndarray, elevation_deg: float = 0.4) -> tuple[np.ndarray, np.ndarray]:
    """Sweep over a 1 m wide board at 3 m before a wall at 10 m, and which points hit the board."""
    lidar = T_camera_lidar[:3, 3]
    az, el = np.meshgrid(np.deg2rad(np.arange(-40, 40, 0.2)), np.deg2rad(np.arange(-30, 30, elevation_deg)))
    d = np.stack([np.sin(az) * np.cos(el), np.sin(el), np.cos(az) * np.cos(el)], -1).reshape(-1, 3)
    near = lidar + d * ((3.0 - lidar[2]) / d[:, 2:])
    far = lidar + d * ((10.0 - lidar[2]) / d[:, 2:])
    board = (np.abs(near[:, 0]) < 0.5) & (np.abs(near[:, 1]) < 0.6)
    hit = np.where(board[:, None], near, far)
    return se3.transform(se3.inverse(T_camera_lidar), hit), board


def test_points_hidden_from_the_camera_are_removed() -> None:
    T = se3.exp(np.array([0.3, -0.2, 0.0, 0.0, 0.0, 0.0]))
    points, _ = _scan(T)
    depth = project_sweep(points, CAMERA, T)
    everything = project_sweep(points, CAMERA, T, remove_occluded=False)

    def hidden(d):
        at_board = (d.uv - [160.0, 120.0]) / 200.0 * 3.0
        return (d.z > 5) & (np.abs(at_board) < [0.45, 0.55]).all(axis=1)

    assert hidden(everything).sum() > 100
    assert hidden(depth).sum() < 0.1 * hidden(everything).sum()
    assert (depth.z < 5).sum() == (everything.z < 5).sum()  # nothing of the board is lost
    assert len(depth) > 0.95 * (len(everything) - hidden(everything).sum())


@settings(max_examples=25, deadline=None)
@given(st.floats(-0.9, 0.9), st.floats(-0.45, 0.45))
def test_no_plane_hides_itself(slope_x: float, slope_y: float) -> None:
    T = se3.exp(np.array([0.2, -0.2, 0.1, 0.0, 0.0, 0.0]))
    az, el = np.meshgrid(np.deg2rad(np.arange(-38, 38, 0.2)), np.deg2rad(np.arange(-30, 30, 0.4)))
    d = np.stack([np.tan(az), np.tan(el), np.ones_like(az)], -1).reshape(-1, 3)
    normal, origin = np.array([slope_x, slope_y, 1.0]), T[:3, 3]
    points = origin + d * ((8.0 - origin @ normal) / (d @ normal))[:, None]
    sweep = se3.transform(se3.inverse(T), points)
    assert len(project_sweep(sweep, CAMERA, T)) == len(project_sweep(sweep, CAMERA, T, remove_occluded=False))


def test_projection_agrees_with_the_camera_and_drops_bad_returns() -> None:
    points = np.array([[0, 0, 4.0], [1, 0, 4.0], [np.nan, 0, 4], [0, 0, -4], [0, 0, 0.1], [0, 0, 1e4]])
    depth = project_sweep(points, CAMERA, np.eye(4))
    np.testing.assert_allclose(depth.uv, [[160, 120], [210, 120]])
    np.testing.assert_allclose(depth.z, [4, 4])


def test_empty_sweep_gives_empty_depth() -> None:
    assert len(project_sweep(np.zeros((0, 3)), CAMERA, np.eye(4))) == 0


def test_bad_input_is_refused() -> None:
    with pytest.raises(FormatError, match=r"\(N, 3\)"):
        project_sweep(np.zeros((5, 4)), CAMERA, np.eye(4))
    with pytest.raises(CalibrationError):
        project_sweep(np.zeros((5, 3)), CAMERA, 2 * np.eye(4))
    with pytest.raises(CalibrationError, match="missing"):
        project_sweep(np.zeros((5, 3)), CAMERA, None)
