"""Rolling shutters are undone: what rows that were read late show moves to where one instant has it."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sf_bringup.simulate import SimulationSpec, Simulator
from sf_bringup.simulate.trajectories import PathPlan
from sf_interfaces.geometry import se3
from sf_interfaces.geometry.rolling_shutter import Readout, nearness, shift, unrolled, unrolled_by_flow
from sf_interfaces.types import Camera, DepthMap, Frame

CAMERA = Camera(160, 120, 120.0, 120.0, 80.0, 60.0)
FAR = nearness(CAMERA, np.zeros((0, 2)), np.zeros(0))
RNG = np.random.default_rng(0)


def frame_of(image: np.ndarray, depth: DepthMap | None = None) -> Frame:
    return Frame(1, CAMERA, image, depth)


def test_a_camera_at_rest_and_a_global_shutter_change_nothing() -> None:
    frame = frame_of(RNG.integers(0, 255, (120, 160), np.uint8))
    assert unrolled(frame, np.zeros(6), FAR, Readout(0.03)) is frame
    still = unrolled(frame, np.array([0, 0, 0, 0, 1.0, 0]), FAR, Readout(0.0))
    np.testing.assert_array_equal(still.image, frame.image)
    assert not Readout(0.0) and Readout(-0.01)


@given(st.floats(-1, 1), st.floats(-0.03, 0.03), st.floats(0.1, 1.0))
def test_the_shift_is_that_of_the_motion_at_the_outermost_row(rate: float, readout: float, w: float) -> None:
    turn, slide = np.array([0, 0, 0, 0, rate, 0]), np.array([rate, 0, 0, 0, 0, 0])
    near = np.full_like(FAR, w)
    late = abs(readout) / 2  # the upper half is read so much before the middle, the lower after
    most = 120 * abs(rate) * late * (1 + (80 / 120) ** 2)
    assert shift(CAMERA, turn, FAR, readout) == pytest.approx(most, rel=0.1, abs=1e-9)
    assert shift(CAMERA, slide, near, readout) == pytest.approx(120 * abs(rate) * late * w, rel=0.1, abs=1e-9)


def test_nearness_is_that_of_the_nearest_known_point() -> None:
    assert not FAR.any()
    near = nearness(CAMERA, np.array([[10.5, 60.5], [150.5, 60.5], [-50.0, 0.0]]), np.array([0.5, 2.0, 9.0]))
    assert set(np.unique(near)) == {0.5, 2.0}
    assert (near[:, :15] == 0.5).all() and (near[:, 18:] == 2.0).all()


def test_depth_of_a_wall_that_comes_nearer_is_that_of_one_instant() -> None:
    speed, readout = 0.8, 0.03  # m/s towards it
    late = (np.arange(120) + 0.5 - 60) / 120 * readout
    rolled = np.repeat((3.0 - speed * late)[:, None], 160, axis=1).astype(np.float32)
    frame = frame_of(np.zeros((120, 160), np.uint8), DepthMap(rolled, np.full_like(rolled, 0.01)))
    velocity, near = np.array([0, 0, -speed, 0, 0, 0]), np.full_like(FAR, 1 / 3)
    found = unrolled(frame, velocity, near, Readout(readout, readout)).depth
    assert found is not None and found.variance is not None
    np.testing.assert_allclose(found.z[2:-2, 2:-2], 3.0, atol=5e-4)
    np.testing.assert_allclose(found.variance[2:-2, 2:-2], 0.01)
    kept = unrolled(frame, velocity, near, Readout(readout)).depth
    assert kept is frame.depth  # a depth camera that takes all at once


@pytest.fixture(scope="module")
def rolled() -> tuple[Simulator, Simulator]:
    spec = SimulationSpec("lounge", frames=40, fps=15.0, width=160, height=120, focal=120.0, image_noise=0.0,
                          readout=0.03, path=PathPlan((1.5, 1.0), 1.4, speed=1.2))  # fmt: skip
    return Simulator(spec), Simulator(replace(spec, readout=0.0))


@pytest.mark.parametrize("index", [10, 30])
def test_a_simulated_image_becomes_that_of_a_global_shutter(rolled: tuple[Simulator, Simulator], index: int) -> None:
    (image, z, _), (true, _, _) = (simulator.frame(index) for simulator in rolled)
    before, after = (rolled[0].path.pose(index / 15 + dt) for dt in (-0.001, 0.001))
    velocity = se3.log(se3.inverse(after) @ before) / 0.002
    near = nearness(CAMERA, CAMERA.pixel_grid().reshape(-1, 2), 1 / z.ravel().astype(np.float64))

    def off(seen: np.ndarray) -> float:  # smoothed, as no interpolation brings back what is finer than a pixel
        smooth, wanted = (cv2.GaussianBlur(part.astype(np.float32), (0, 0), 1.0) for part in (seen, true))
        return float(np.abs(smooth - wanted)[8:-8, 8:-8].mean())

    found = unrolled(frame_of(image), velocity, near, Readout(0.03)).image
    assert found is not None and off(found) < 0.5 * off(image)
    wrong = unrolled(frame_of(image), velocity, near, Readout(-0.03)).image
    assert wrong is not None and off(wrong) > 1.3 * off(image)
    x = CAMERA.unproject(CAMERA.pixel_grid(), z.astype(np.float64))
    moved, _ = CAMERA.project(x + 0.001 * (velocity[:3] + np.cross(velocity[3:], x)))
    flow = ((moved - CAMERA.pixel_grid()) / 0.001).astype(np.float32)
    by_flow = unrolled_by_flow(frame_of(image), flow, Readout(0.03)).image
    assert by_flow is not None and off(by_flow) < 0.5 * off(image)
