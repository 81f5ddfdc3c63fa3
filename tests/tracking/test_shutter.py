"""A tracker that knows the readout of its rolling shutter errs a fraction of what one errs that does not."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sf_bringup.evaluation.trajectory import trajectory_error
from sf_bringup.simulate import SimulationSpec, Simulator
from sf_bringup.simulate.trajectories import PathPlan
from sf_interfaces.geometry import se3
from sf_interfaces.types import DepthMap, Frame, Trajectory
from sf_tracking.config import TrackingConfig
from sf_tracking.core.session import TrackingSession
from sf_tracking.core.shutter import Shutter, image_velocity

READOUT = 0.03


@pytest.fixture(scope="module")
def walk() -> list[Frame]:
    path = PathPlan((1.5, 1.0), 1.4, speed=0.9)
    spec = SimulationSpec("lounge", frames=30, fps=15.0, width=240, height=180, focal=180.0, supersampling=1,
                          readout=READOUT, path=path)  # fmt: skip
    simulator, frames = Simulator(spec), []
    for k in range(spec.frames):
        image, z, T = simulator.frame(k)
        frames.append(Frame(1_000_000_000 + round(k / spec.fps * 1e9), spec.camera, image, DepthMap(z), None, T))
    return frames


def error(frames: list[Frame], measured: bool, **config: float) -> float:
    """m, of the frames that were tracked."""
    session = TrackingSession(TrackingConfig(**config))  # type: ignore[arg-type]
    for frame in frames:
        session.track(replace(frame, depth=frame.depth if measured else None, T_map_camera=None))
    session.finish()
    found = session.trajectory()
    assert len(found) >= len(frames) - 2
    truth = Trajectory.from_pairs([(f.stamp_ns, f.T_map_camera) for f in frames if f.T_map_camera is not None])
    return trajectory_error(found, truth, alignment="se3" if measured else "sim3").rmse


@pytest.mark.parametrize("measured", [True, False])
def test_the_trajectory_errs_half_as_much_or_less(walk: list[Frame], measured: bool) -> None:
    assert error(walk, measured, readout_s=READOUT) < 0.55 * error(walk, measured)


def test_without_a_rolling_shutter_frames_are_left_as_they_are(walk: list[Frame]) -> None:
    shutter = Shutter(TrackingConfig())
    assert not shutter
    assert shutter.before_map(walk[0]) is walk[0]


def test_before_the_map_the_first_image_alone_says_nothing(walk: list[Frame]) -> None:
    images = [replace(frame, depth=None) for frame in walk[:3]]
    shutter = Shutter(TrackingConfig(readout_s=READOUT))
    assert shutter.before_map(images[0]) is None
    assert shutter.before_map(images[1]) is not None
    paused = replace(images[2], stamp_ns=images[1].stamp_ns + 1_000_000_000)
    assert shutter.before_map(paused) is None
    assert Shutter(TrackingConfig(readout_s=READOUT)).before_map(walk[0]) is walk[0]  # measured: it begins the map


def test_the_velocity_is_that_of_the_last_frames(walk: list[Frame]) -> None:
    first, second, third = walk[:3]
    assert first.T_map_camera is not None and second.T_map_camera is not None and third.T_map_camera is not None
    recent = [(f.stamp_ns, se3.inverse(f.T_map_camera)) for f in (first, second)]
    shutter, near = Shutter(TrackingConfig(readout_s=READOUT)), np.full((37, 49), 0.3, np.float32)
    assert shutter.expected(third, [], near).image is third.image  # just found again: it is not known how it moves
    seen = shutter.expected(third, recent, near)
    assert seen.image is not third.image
    on = se3.exp(se3.log(recent[1][1] @ se3.inverse(recent[0][1]))) @ recent[1][1]
    assert shutter.corrected(third, recent, on, near) is None  # it moved as expected
    turned = se3.exp(np.array([0, 0, 0, 0, 0.05, 0])) @ on
    assert shutter.corrected(third, recent, turned, near) is not None


def test_the_image_velocity_of_a_picture_that_slides() -> None:
    rng = np.random.default_rng(0)
    wide = np.kron(rng.integers(0, 255, (24, 40)), np.ones((6, 6))).astype(np.uint8)
    velocity = image_velocity(0, wide[:, 8:200], 100_000_000, wide[:, 4:196])  # 4 px to the right in 0.1 s
    assert velocity.shape == (72, 96, 2)
    np.testing.assert_allclose(np.median(velocity, axis=(0, 1)), [40, 0], atol=3)
