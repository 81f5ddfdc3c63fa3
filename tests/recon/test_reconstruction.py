"""The whole block on a room whose colour and depth are known exactly."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sf_interfaces.errors import FormatError
from sf_interfaces.types import DepthMap, Scale
from sf_recon.config import ReconConfig
from sf_recon.core.color_field import Neighbourhood, gaussian_weights
from sf_recon.core.reconstruction import Reconstruction
from sf_recon.core.trainer import RowAdam
from tests.recon.scene import CAMERA, HALF, psnr, view

CONFIG = ReconConfig(pixels=2048, final_iterations=100)


@pytest.fixture(scope="module")
def room() -> Reconstruction:
    out = Reconstruction(CONFIG)
    for i in range(0, 12, 2):
        out.add(view(i))
    out.finish()
    return out


def test_held_out_view(room: Reconstruction) -> None:
    for i in (3, 7):
        truth = view(i)
        drawn = room.render(CAMERA, truth.T_map_camera)
        hit = drawn.depth.valid
        assert drawn.hole_fraction < 0.03
        assert psnr(drawn.image[hit], truth.image[hit]) > 30
        assert np.median(np.abs(drawn.depth.z - truth.depth.z)[hit]) < 0.2 * room.resolution
        assert (drawn.image[~hit] == 0).all()


def test_surface_lies_on_the_walls(room: Reconstruction) -> None:
    cloud = room.surface()
    off = np.abs(np.abs(cloud.points) - HALF).min(axis=1)
    assert len(cloud) > 5000 and np.percentile(off, 99) < 0.5 * room.resolution
    assert cloud.colors is not None and cloud.frame_id == "map"


def test_training_lowers_the_error(room: Reconstruction) -> None:
    assert np.mean(room.losses[-20:]) < 0.05 * np.mean(room.losses[:3])


def test_two_runs_are_equal() -> None:
    runs = []
    for _ in range(2):
        out = Reconstruction(replace(CONFIG, final_iterations=10))
        clouds = [out.add(view(i)) for i in (0, 2)]
        out.finish()
        runs.append((out, clouds))
    (a, clouds_a), (b, clouds_b) = runs
    assert a.losses == b.losses
    for x, y in zip(clouds_a, clouds_b, strict=True):
        assert x.points.tobytes() == y.points.tobytes() and x.colors.tobytes() == y.colors.tobytes()
    assert a.surface().colors.tobytes() == b.surface().colors.tobytes()


def test_save_and_load(room: Reconstruction, tmp_path: Path) -> None:
    path = tmp_path / "map.sfmap"
    room.save(path)
    again = Reconstruction.load(path)
    before, after = (r.render(CAMERA, view(3).T_map_camera) for r in (room, again))
    np.testing.assert_array_equal(before.image, after.image)
    np.testing.assert_array_equal(before.depth.z, after.depth.z)
    added = again.add(view(14))  # a loaded map grows on
    assert 0 < len(added) < len(again.surface())


def test_bad_map_files(tmp_path: Path, room: Reconstruction) -> None:
    path = tmp_path / "broken.sfmap"
    path.write_bytes(b"PK nothing")
    with pytest.raises(FormatError, match="not a SceneFactory map"):
        Reconstruction.load(path)
    with pytest.raises(FormatError, match="not a SceneFactory map"):
        Reconstruction.load(tmp_path / "absent.sfmap")
    room.save(path)
    path.write_bytes(path.read_bytes()[:-2000])
    with pytest.raises(FormatError, match="not a SceneFactory map"):
        Reconstruction.load(path)


def test_mono_image_gives_grey() -> None:
    out = Reconstruction(replace(CONFIG, iterations=60))
    key = view(0)
    out.add(replace(key, image=key.image[:, :, 0].copy()))
    drawn = out.render(CAMERA, key.T_map_camera)
    hit = drawn.depth.valid
    assert np.abs(np.diff(drawn.image[hit].astype(int), axis=1)).mean() < 8


def test_uncertain_depth_is_left_out() -> None:
    key = view(0)
    variance = np.full(key.depth.z.shape, 1e-6, np.float32)
    variance[:, :80] = 1.0
    out = Reconstruction(replace(CONFIG, iterations=1))
    out.add(replace(key, depth=DepthMap(key.depth.z, variance)))
    drawn = out.render(CAMERA, key.T_map_camera)
    assert drawn.depth.valid[:, :75].mean() < 0.01 and drawn.depth.valid[:, 85:].mean() > 0.97


def test_resolution_follows_the_scene() -> None:
    key = view(0)
    T = key.T_map_camera.copy()
    T[:3, 3] *= 0.01
    small = replace(key, T_map_camera=T, depth=DepthMap(key.depth.z * 0.01, scale=Scale.ARBITRARY))
    a, b = Reconstruction(replace(CONFIG, iterations=1)), Reconstruction(replace(CONFIG, iterations=1))
    a.add(key)
    b.add(small)
    assert b.resolution == pytest.approx(0.01 * a.resolution)
    assert len(b.surface()) == pytest.approx(len(a.surface()), rel=0.02)


def test_input_that_cannot_be_used() -> None:
    key = view(0)
    with pytest.raises(FormatError, match="no depth"):
        Reconstruction(CONFIG).add(replace(key, depth=None))
    with pytest.raises(FormatError, match="register depth"):
        Reconstruction(CONFIG).add(replace(key, depth=DepthMap(np.ones((4, 4)))))
    with pytest.raises(FormatError, match="no valid depth"):
        Reconstruction(CONFIG).add(replace(key, depth=DepthMap(np.full((120, 160), np.nan))))


def test_empty_map_draws_holes() -> None:
    empty = Reconstruction(CONFIG)
    drawn = empty.render(CAMERA, np.eye(4))
    assert drawn.hole_fraction == 1.0 and not drawn.image.any() and len(empty.surface()) == 0


def test_gaussian_weights() -> None:
    d2 = np.array([[0.0, 1.0], [400.0, 401.0], [5.0, np.inf], [np.inf, np.inf]], np.float32)
    w = gaussian_weights(d2, 1.0)
    e = np.exp(-1.0)
    np.testing.assert_allclose(w, [[1 / (1 + e), e / (1 + e)]] * 2 + [[1, 0], [0, 0]], rtol=1e-6)


def test_row_adam_equals_adam_and_keeps_moments_when_it_grows() -> None:
    rng = np.random.default_rng(0)
    table = torch.zeros(4, 3)
    parameter = torch.zeros(4, 3, requires_grad=True)
    adam = torch.optim.Adam([parameter], lr=0.1, betas=(0.9, 0.99), eps=1e-15)
    rows = RowAdam(3)
    rows.grow(4)
    near = Neighbourhood(torch.arange(4, dtype=torch.int32)[:, None], torch.ones(4, 1))
    for step in range(6):
        gradient = torch.from_numpy(rng.normal(size=(4, 3)).astype(np.float32))
        rows.step(table, near, gradient, 0.1)
        parameter.grad = gradient
        adam.step()
        if step == 2:  # new rows must not disturb the old ones
            rows.grow(7)
            table = torch.cat([table, torch.zeros(3, 3)])
    torch.testing.assert_close(table[:4], parameter.detach(), rtol=1e-5, atol=1e-6)
    assert not table[4:].any() and rows.steps.tolist() == [6.0] * 4 + [0.0] * 3
