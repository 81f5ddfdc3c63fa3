"""The simulator: determinism, exact ground truth, sensor statistics and the world loader."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sf_bringup.simulate import PRESETS, SimulationSpec, Simulator
from sf_bringup.simulate.builder import SceneBuilder
from sf_bringup.simulate.render import Renderer
from sf_bringup.simulate.sensors import structured_light, time_of_flight
from sf_bringup.simulate.simulator import T_CAMERA_LIDAR
from sf_bringup.simulate.world import load_world
from sf_interfaces.errors import ConfigError, FormatError
from sf_interfaces.geometry import se3

SPEC = SimulationSpec("lounge", width=160, height=120, focal=120.0, lidar="spinning64", image_noise=0.0)


@pytest.fixture(scope="module")
def simulator() -> Simulator:
    return Simulator(SPEC)


def test_same_seed_gives_identical_arrays(simulator: Simulator) -> None:
    again = Simulator(SPEC)
    for a, b in zip(simulator.frame(3), again.frame(3), strict=True):
        assert np.array_equal(a, b, equal_nan=True)
    assert np.array_equal(simulator.sweep(1)[0].points, again.sweep(1)[0].points)


def test_depth_and_poses_warp_one_image_onto_another(simulator: Simulator) -> None:
    camera = SPEC.camera
    first, z, T0 = simulator.frame(0)
    second, z1, T1 = simulator.frame(6)
    world = se3.transform(T0, camera.unproject(camera.pixel_grid(), z))
    uv, depth = camera.project(se3.transform(se3.inverse(T1), world))
    col, row = (
        np.floor(np.nan_to_num(uv)).astype(int)[..., 0],
        np.floor(np.nan_to_num(uv)).astype(int)[..., 1],
    )
    inside = (col >= 0) & (col < camera.width) & (row >= 0) & (row < camera.height) & (depth > 0)
    seen = np.abs(z1[row[inside], col[inside]] - depth[inside]) < 0.03 * depth[inside]
    assert seen.mean() > 0.7
    difference = np.abs(second[row[inside], col[inside]].astype(float) - first[inside].astype(float))
    unwarped = np.abs(second.astype(float) - first.astype(float)).mean()
    assert difference[seen].mean() < 0.6 * unwarped


def test_deskewed_sweep_lies_on_the_surfaces(simulator: Simulator) -> None:
    cloud, _ = simulator.sweep(5)
    start = (cloud.stamp_ns - 1_000_000_000_000) * 1e-9
    assert cloud.time_offset_ns is not None
    T = simulator.path.pose(start + cloud.time_offset_ns * 1e-9) @ T_CAMERA_LIDAR
    world = np.einsum("nij,nj->ni", T[:, :3, :3], cloud.points) + T[:, :3, 3]
    assert np.percentile(simulator.renderer.clearance(world), 95) < 0.04


class _Sideways:
    """A camera that looks along +x and moves to -y, that is to its right, at ``speed`` m/s."""

    def __init__(self, speed: float) -> None:
        self._speed = speed

    def pose(self, t: np.ndarray) -> np.ndarray:
        T = np.broadcast_to(
            np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]]), (*np.shape(t), 4, 4)
        )
        T = T.copy()
        T[..., 1, 3] = -self._speed * np.asarray(t)
        return T


def _pass_an_edge(simulator: Simulator) -> None:
    """Move to the right at 4 m/s, past an edge between dark and bright that is straight ahead at t = 0, 2 m away."""
    builder = SceneBuilder(0)
    white = builder.textures.add(np.full((8, 8, 3), 255, np.uint8))
    for left, shade in ((0.0, 0.1), (-4.0, 0.7)):
        builder.quad((2.0, left, -2.0), (0, 4, 0), (0, 0, 4), white, tint=(shade,) * 3, gloss=0.0)
    simulator.renderer, simulator.path = Renderer(builder.build(ambient=1.0)), _Sideways(4.0)  # type: ignore[assignment]


def test_motion_during_the_exposure_blurs_an_edge_into_a_ramp_of_known_length() -> None:
    spec = SimulationSpec("lounge", width=160, height=40, focal=100.0, image_noise=0.0, fps=10.0, blur=0.08)
    simulator, sharp = Simulator(spec), Simulator(replace(spec, blur=0.0))
    for one in (simulator, sharp):
        _pass_an_edge(one)
    (image, z, T), (still, sharp_z, sharp_T) = simulator.frame(1), sharp.frame(1)
    np.testing.assert_array_equal(z, sharp_z)
    np.testing.assert_array_equal(T, sharp_T)
    row, edge = image[20, :, 0].astype(float), 80 - 100 * 4.0 * 0.1 / 2.0  # px, in the middle of the exposure
    dark, bright = still[20, 5, 0], still[20, 155, 0]
    assert bright > dark + 80
    ramp = np.clip((np.arange(160) + 0.5 - edge) / (100 * 4.0 * 0.08 / 2.0) + 0.5, 0, 1)
    np.testing.assert_allclose((row - dark) / (float(bright) - dark), ramp, atol=0.06)
    with pytest.raises(ConfigError, match="blur"):
        replace(spec, blur=0.2)


def test_a_rolling_shutter_slants_an_edge_by_what_the_camera_moves_while_it_is_read() -> None:
    spec = SimulationSpec("lounge", width=160, height=120, focal=100.0, image_noise=0.0, fps=10.0, readout=0.05)
    simulator = Simulator(spec)
    _pass_an_edge(simulator)
    image, z, T = simulator.frame(0)
    assert T[1, 3] == 0.0 and np.nanmax(np.abs(z - 2.0)) < 1e-4
    edge = (image[:, :, 0] < image[60].mean()).sum(axis=1)  # px of the dark side
    late = (np.arange(120) + 0.5 - 60) / 120 * 0.05
    np.testing.assert_allclose(edge, 80 - 100 * 4.0 * late / 2.0, atol=1.0)
    with pytest.raises(ConfigError, match="readout"):
        replace(spec, readout=0.2)
    with pytest.raises(ConfigError, match="together"):
        replace(spec, blur=0.01)


def test_structured_light_noise_grows_with_the_square_of_depth() -> None:
    rng = np.random.default_rng(0)
    near, far = (structured_light(np.full((100, 100), z, np.float32), 480.0, rng) for z in (1.0, 3.0))
    assert np.nanstd(far) / np.nanstd(near) == pytest.approx(9, rel=0.3)
    assert np.isnan(structured_light(np.full((9, 9), 6.0, np.float32), 480.0, rng)).all()


def test_time_of_flight_is_unbiased() -> None:
    z = time_of_flight(np.full((100, 100), 2.0, np.float32), np.random.default_rng(0))
    assert np.nanmean(z) == pytest.approx(2.0, abs=1e-3) and 0.005 < np.nanstd(z) < 0.009


@pytest.mark.parametrize("name", [n for n in PRESETS if n not in ("palace", "campus")])
def test_indoor_paths_keep_clear_of_everything(name: str) -> None:
    simulator = Simulator(replace(PRESETS[name], width=16, height=12))
    positions = simulator.path.pose(np.linspace(0, simulator.path._lap, 200))[:, :3, 3]
    assert simulator.renderer.clearance(positions).min() > 0.15


def test_bad_input_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="unknown"):
        Simulator(SimulationSpec("nowhere"))
    with pytest.raises(FormatError, match="world"):
        load_world(tmp_path / "none.world")


def test_small_house_loads(shared_data) -> None:  # type: ignore[no-untyped-def]
    scene = load_world(shared_data("mesh_small_house") / "worlds" / "small_house.world")
    assert len(scene.corners) > 147_000  # 87 placed instances hold 147 684 faces, two of them degenerate
    assert np.abs(scene.corners[..., 0]).max() < 12
    assert len(np.unique(scene.texture)) > 50  # the models' own images, not the stand-in
