"""The compiled rasteriser against its numpy definition, and the definition against known geometry."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from sf_interfaces.errors import ConfigError
from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera
from sf_recon.config import ReconConfig
from sf_recon.core.ipr_reference import RasterOptions, rasterize_reference
from sf_recon.core.rasterizer import make_rasterizer, rasterize

CAMERA = Camera(53, 37, 61.0, 47.0, 25.7, 19.1)  # not a multiple of the tile, fx != fy
OPTIONS = RasterOptions(radius=0.02, near=0.05, layer_gap=0.06, max_half=9.0, k_ray=5)
POSE = se3.exp(np.array([0.1, -0.05, 0.2, 0.1, -0.2, 0.3]))


def box(n: int, low: float, high: float, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.uniform([-1.2, -1.2, low], [1.2, 1.2, high], (n, 3)).astype(np.float32)


CLOUDS = {
    "empty": np.zeros((0, 3), np.float32),
    "one": np.array([[0.1, 0.2, 1.5]], np.float32),
    "scattered": box(3000, 0.5, 4.0),
    "dense": box(20000, 2.0, 2.3),
    "close-up": box(400, -0.3, 0.5) * np.array([0.3, 0.3, 1], np.float32),
    "behind": box(500, -4.0, -1.0),
    "not finite": np.array([[np.nan, 0, 1], [np.inf, 0, 2], [0, 0, np.inf], [0, 0, 1.2]], np.float32),
    "equal depth": np.round(box(3000, 1.0, 1.0), 1),
    "far aside": np.array([[1e8, 0, 1], [0, -1e8, 1], [0, 0, 1e8]], np.float32),
}


@pytest.mark.parametrize("name", CLOUDS)
@pytest.mark.parametrize("T", [np.eye(4), POSE], ids=["identity", "moved"])
def test_kernel_equals_definition(name: str, T: np.ndarray) -> None:
    fast = rasterize(CLOUDS[name], CAMERA, T, OPTIONS)
    slow = rasterize_reference(CLOUDS[name], CAMERA, T, OPTIONS)
    np.testing.assert_array_equal(fast.hole, slow.hole)
    np.testing.assert_allclose(fast.depth, slow.depth, rtol=2e-6, equal_nan=True)
    # x and y of the kernel come back from the pixel: relative to the depth, not to themselves
    np.testing.assert_allclose(fast.position, slow.position, rtol=2e-5, atol=4e-6, equal_nan=True)


def test_result_does_not_depend_on_threads() -> None:
    cloud = box(50000, 0.5, 4.0)
    one = rasterize(cloud, CAMERA, POSE, OPTIONS, threads=1)
    for threads in (2, 3, 7):
        other = rasterize(cloud, CAMERA, POSE, OPTIONS, threads=threads)
        assert one.position.tobytes() == other.position.tobytes()


def plane(z: float, spacing: float = 0.01) -> np.ndarray:
    x, y = np.meshgrid(np.arange(-1, 1, spacing), np.arange(-1, 1, spacing))
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, z)], axis=1).astype(np.float32)


def test_first_layer_hides_what_lies_behind() -> None:
    options = RasterOptions(radius=0.0071, near=0.1, layer_gap=0.02)
    both = rasterize(np.concatenate([plane(1.0), plane(0.7)]), CAMERA, np.eye(4), options)
    np.testing.assert_allclose(both.depth, 0.7, rtol=1e-6)
    thick = rasterize(np.concatenate([plane(0.71), plane(0.7)]), CAMERA, np.eye(4), options)
    assert 0.7 < np.nanmean(thick.depth) < 0.71  # one layer: the mean of both


@pytest.mark.parametrize("z", [0.15, 0.3, 0.6, 0.9])
def test_near_surface_has_no_holes(z: float) -> None:
    options = RasterOptions(radius=0.0071, near=0.1, layer_gap=0.02)
    assert not rasterize(plane(z), CAMERA, np.eye(4), options).hole.any()
    fixed = RasterOptions(radius=1e-6, near=0.1, layer_gap=0.02)  # one pixel per point
    if z < 0.5:
        assert rasterize(plane(z), CAMERA, np.eye(4), fixed).hole.any()


def test_position_lies_on_its_ray_and_at_its_pixel_centre() -> None:
    u, v, z = 20, 11, 1.5
    point = CAMERA.unproject(np.array([u + 0.5, v + 0.5]), np.array(z)).astype(np.float32)
    drawn = rasterize(point[None], CAMERA, np.eye(4), RasterOptions(radius=1e-6, near=0.1, layer_gap=0.02))
    assert np.flatnonzero(~drawn.hole).tolist() == [v * CAMERA.width + u]
    np.testing.assert_allclose(drawn.position[v, u], point, atol=1e-6)


def test_rasteriser_is_chosen_by_name() -> None:
    assert make_rasterizer(ReconConfig(rasterizer="reference")) is rasterize_reference
    with pytest.raises(ConfigError, match="native or reference"):
        make_rasterizer(ReconConfig(rasterizer="cuda"))
