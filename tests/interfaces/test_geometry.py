"""Laws of rigid motions and of the pinhole camera, on random motions and cameras."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sf_interfaces.errors import CalibrationError
from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera

unit = st.floats(-1.0, 1.0)
shift = st.floats(-100.0, 100.0)
angles = st.one_of(
    st.floats(0.0, 1e-9),
    st.floats(1e-6, 1e-3),  # where the closed form would cancel
    st.floats(0.049, 0.051),  # around the switch from series to closed form
    st.floats(0.0, 3.0),
    st.floats(np.pi - 1e-3, np.pi - 1e-6),
)


@st.composite
def twists(draw: st.DrawFn) -> np.ndarray:
    axis = np.array([draw(unit), draw(unit), draw(unit)])
    length = np.linalg.norm(axis)
    axis = axis / length if length > 1e-3 else np.array([0.0, 0.0, 1.0])
    return np.array([draw(shift), draw(shift), draw(shift), *(draw(angles) * axis)])


motions = twists().map(se3.exp)
cameras = st.builds(
    Camera,
    st.integers(2, 2000),
    st.integers(2, 2000),
    st.floats(10.0, 2000.0),
    st.floats(10.0, 2000.0),
    st.floats(0.0, 2000.0),
    st.floats(0.0, 2000.0),
)


@given(twists())
def test_log_inverts_exp(xi: np.ndarray) -> None:
    np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, atol=1e-6)


@given(motions)
def test_a_stack_of_motions_equals_one_after_the_other(T: np.ndarray) -> None:
    xi = se3.log(T)
    stack = np.stack([xi, 1e-9 * xi, 0 * xi])
    np.testing.assert_allclose(se3.exp(stack), [se3.exp(x) for x in stack], atol=1e-12 * (1 + np.abs(xi).max()))
    np.testing.assert_allclose(se3.log(se3.exp(stack)), stack, atol=1e-6)


@given(motions)
def test_exp_inverts_log_and_stays_rigid(T: np.ndarray) -> None:
    np.testing.assert_allclose(se3.exp(se3.log(T)), T, atol=1e-6)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)


@given(motions)
def test_inverse(T: np.ndarray) -> None:
    np.testing.assert_allclose(T @ se3.inverse(T), np.eye(4), atol=1e-10)
    np.testing.assert_allclose(se3.inverse(se3.inverse(T)), T, atol=1e-10)


@given(motions, motions, motions)
def test_composition_is_associative_and_acts_on_points(A: np.ndarray, B: np.ndarray, C: np.ndarray) -> None:
    np.testing.assert_allclose((A @ B) @ C, A @ (B @ C), atol=1e-9)
    points = np.array([[1.0, -2.0, 3.0], [0.0, 0.0, 0.0]])
    np.testing.assert_allclose(se3.transform(A @ B, points), se3.transform(A, se3.transform(B, points)), atol=1e-9)


@given(motions, twists())
def test_adjoint_moves_a_twist_to_the_other_side(T: np.ndarray, xi: np.ndarray) -> None:
    left = T @ se3.exp(xi) @ se3.inverse(T)
    np.testing.assert_allclose(left, se3.exp(se3.adjoint(T) @ xi), atol=1e-6)


@given(motions, motions)
def test_interpolation_ends_and_middle(A: np.ndarray, B: np.ndarray) -> None:
    np.testing.assert_allclose(se3.interpolate(A, B, 0.0), A, atol=1e-6)
    relative = se3.log(se3.inverse(A) @ B)
    if np.linalg.norm(relative[3:]) < np.pi - 1e-3:  # at pi the shortest way is not unique
        np.testing.assert_allclose(se3.interpolate(A, B, 1.0), B, atol=1e-6)
        half = se3.interpolate(A, B, 0.5)
        np.testing.assert_allclose(half @ se3.inverse(A) @ half, B, atol=1e-5)


@given(motions)
def test_quaternion_round_trip(T: np.ndarray) -> None:
    translation, xyzw = se3.to_quaternion(T)
    assert xyzw[3] >= 0
    np.testing.assert_allclose(se3.from_quaternion(translation, 3.0 * xyzw), T, atol=1e-9)


@given(motions, st.floats(-0.01, 0.01))
def test_orthonormalise_repairs_drift(T: np.ndarray, drift: float) -> None:
    damaged = T.copy()
    damaged[:3, :3] *= 1 + drift
    np.testing.assert_allclose(se3.orthonormalise(damaged), T, atol=1e-9)


def test_batches_agree_with_single_calls() -> None:
    xi = np.random.default_rng(0).normal(size=(2, 3, 6))
    T = se3.exp(xi)
    assert T.shape == (2, 3, 4, 4) and se3.adjoint(T).shape == (2, 3, 6, 6)
    np.testing.assert_allclose(T[1, 2], se3.exp(xi[1, 2]))
    np.testing.assert_allclose(se3.log(T)[0, 1], se3.log(T[0, 1]))


@settings(max_examples=50)
@given(cameras, st.floats(0.1, 100.0), st.integers(0, 2**31))
def test_project_inverts_unproject(camera: Camera, z: float, seed: int) -> None:
    pixels = np.random.default_rng(seed).uniform(0, 1, (7, 2)) * [camera.width, camera.height]
    back, depth = camera.project(camera.unproject(pixels, np.full(7, z)))
    np.testing.assert_allclose(back, pixels, atol=1e-6)
    np.testing.assert_allclose(depth, z)


@settings(max_examples=50)
@given(cameras, st.floats(0.1, 4.0))
def test_a_scaled_camera_sees_the_same_rays(camera: Camera, factor: float) -> None:
    small = camera.scaled(factor)
    ratio = np.array([small.width / camera.width, small.height / camera.height])
    point = np.array([0.3, -0.2, 1.7])
    np.testing.assert_allclose(small.project(point)[0], camera.project(point)[0] * ratio, rtol=1e-9, atol=1e-9)


def test_pixel_centres_lie_at_half_integers_and_K_projects() -> None:
    camera = Camera(4, 3, 10.0, 11.0, 2.0, 1.5)
    grid = camera.pixel_grid()
    assert grid.shape == (3, 4, 2)
    np.testing.assert_array_equal(grid[2, 3], [3.5, 2.5])
    homogeneous = camera.K @ np.array([0.5, -0.25, 2.0])
    np.testing.assert_allclose(homogeneous[:2] / 2.0, camera.project(np.array([0.5, -0.25, 2.0]))[0])


@pytest.mark.parametrize("values", [(0, 4, 1, 1, 0, 0), (4, 4, -1, 1, 0, 0), (4, 4, 1, 1, float("nan"), 0)])
def test_impossible_cameras_are_refused(values: tuple[float, ...]) -> None:
    with pytest.raises(CalibrationError):
        Camera(*values)  # type: ignore[arg-type]
