"""A map on a GPU: neighbours, colours and learning are those of the CPU."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
import torch

from sf_interfaces.geometry import se3
from sf_recon.config import ReconConfig
from sf_recon.core.color_field import ColorField
from sf_recon.core.device import DeviceGrid, torch_device
from sf_recon.core.keyframe_view import KeyframeView
from sf_recon.core.neural_points import Level, NeuralPoints
from sf_recon.core.observation import backproject
from sf_recon.core.renderer import Renderer
from sf_recon.core.trainer import Trainer
from tests.recon.scene import CAMERA, psnr, view
from tests.recon.test_rasterizer_cuda import needs_gpu

RNG = np.random.default_rng(0)
CLOUDS = {
    "surface": RNG.uniform([-2, -2, 1], [2, 2, 1.02], (30000, 3)).astype(np.float32),
    "lattice": np.stack(np.meshgrid(*[np.arange(12) * 0.05] * 3), axis=-1).reshape(-1, 3).astype(np.float32),
    "twice": np.repeat(RNG.uniform(-1, 1, (500, 3)), 2, axis=0).astype(np.float32),
    "one": np.array([[0.1, 0.2, 0.3]], np.float32),
    "none": np.zeros((0, 3), np.float32),
}


@needs_gpu
@pytest.mark.parametrize("name", CLOUDS)
@pytest.mark.parametrize("k", [1, 4, 16])
def test_neighbours_equal_those_of_the_cpu(name: str, k: int) -> None:
    level, device = Level(0.05), torch_device("cuda")
    grid = DeviceGrid(level, device)
    cloud = CLOUDS[name]
    for points in (cloud[: len(cloud) // 2], cloud, cloud + np.float32(0.3)):  # grows, then moves
        level.replace(points, np.zeros(len(points), np.float16), [])
        queries = np.concatenate([points[:500], RNG.uniform(-2.5, 2.5, (4000, 3)).astype(np.float32)])
        ids, distance2 = grid.nearest(torch.from_numpy(queries).to(device), k)
        expected_ids, expected_distance2 = level.nearest(queries, k)
        np.testing.assert_array_equal(ids.cpu(), expected_ids)
        np.testing.assert_array_equal(distance2.cpu(), expected_distance2)


@needs_gpu
def test_queries_that_are_nowhere_have_no_neighbours() -> None:
    level, device = Level(0.05), torch_device("cuda")
    level.replace(CLOUDS["surface"], np.zeros(30000, np.float16), [])
    queries = torch.tensor([[np.nan, 0, 1], [np.inf, 0, 0], [1e30, 0, 0], [0, 0, 1]], device=device)
    ids, distance2 = DeviceGrid(level, device).nearest(queries, 3)
    assert (ids[:3] == -1).all() and torch.isinf(distance2[:3]).all() and (ids[3] >= 0).all()


def learnt(device: str, iterations: int) -> tuple[Trainer, Renderer]:
    """A room of four views, on which a field has been trained."""
    config = ReconConfig(device=device, pixels=2048, detail=0, sharpen=0)
    points = NeuralPoints(0.02, 3, 4.0)
    field = ColorField(points, config)
    trainer = Trainer(field, config, np.random.default_rng(0))
    for index in range(0, 8, 2):
        key = view(index)
        assert key.depth is not None
        pixels = np.arange(key.depth.z.size)
        seen, _ = backproject(key.camera, key.T_map_camera, key.depth.z.reshape(-1).astype(np.float32), pixels)
        field.grow(points.allocate(seen, key.image.reshape(-1, 3).astype(np.float32) / 255))
        trainer.add(
            KeyframeView.make(index, key.camera, key.T_map_camera, key.image, key.depth.z.astype(np.float32), None)
        )
    trainer.run(iterations)
    return trainer, Renderer(config, points, field)


@needs_gpu
def test_a_field_learns_and_draws_on_a_gpu_as_on_the_cpu() -> None:
    (cpu, draw_cpu), (gpu, draw_gpu) = learnt("cpu", 60), learnt("cuda", 60)
    assert gpu.field.features[0].is_cuda and gpu.rows[0].mean.is_cuda
    np.testing.assert_allclose(gpu.losses[:3], cpu.losses[:3], rtol=1e-3)
    assert np.mean(gpu.losses[-10:]) == pytest.approx(np.mean(cpu.losses[-10:]), rel=0.05)
    unseen = view(3)
    images = [draw.render(CAMERA, unseen.T_map_camera, [], unseen.depth.scale).image for draw in (draw_cpu, draw_gpu)]
    assert psnr(*images) > 40 and psnr(images[1], unseen.image) == pytest.approx(psnr(images[0], unseen.image), abs=0.3)


@needs_gpu
def test_a_field_on_a_gpu_forgets_points() -> None:
    trainer, _ = learnt("cuda", 3)
    kept = [np.arange(len(f)) % 2 == 0 for f in trainer.field.features]
    before = [f.clone() for f in trainer.field.features]
    trainer.field.keep(kept)
    for adam, mask, old, new in zip(trainer.rows, kept, before, trainer.field.features, strict=True):
        adam.keep(mask)
        assert torch.equal(new, old[torch.from_numpy(mask).to(old.device)]) and len(adam.steps) == mask.sum()


def test_colours_in_torch_operations_equal_the_decoder() -> None:
    trainer, _ = learnt("cpu", 10)
    seen, _ = backproject(CAMERA, np.eye(4), np.full(CAMERA.width, 1.9, np.float32), np.arange(CAMERA.width))
    for eye in (None, se3.inverse(np.eye(4))[:3, 3]):
        for level in range(3):
            torch_colors = trainer.field.color_by_torch(seen, eye, level)
            np.testing.assert_allclose(torch_colors, trainer.field.color(seen, eye, level), atol=3e-6)
