"""The compiled rasteriser against its numpy definition, and the definition against known geometry."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sf_interfaces.errors import ConfigError
from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera
from sf_recon.config import ReconConfig
from sf_recon.core.ipr_reference import Raster, RasterOptions, rasterize_reference
from sf_recon.core.rasterizer import Rasterizer, make_rasterizer, rasterize

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


EVERYTHING = ("position", "index", "weight", "normal")


@pytest.mark.parametrize("name", CLOUDS)
@pytest.mark.parametrize("T", [np.eye(4), POSE], ids=["identity", "moved"])
def test_kernel_equals_definition(name: str, T: np.ndarray) -> None:
    fast = rasterize(CLOUDS[name], CAMERA, T, OPTIONS, outputs=EVERYTHING)
    slow = rasterize_reference(CLOUDS[name], CAMERA, T, OPTIONS, outputs=EVERYTHING)
    assert_same(fast, slow)


def assert_same(fast: Raster, slow: Raster) -> None:
    np.testing.assert_array_equal(fast.index, slow.index)
    np.testing.assert_array_equal(fast.hole, slow.hole)
    np.testing.assert_allclose(fast.depth, slow.depth, rtol=2e-6, equal_nan=True)
    # x and y of the kernel come back from the pixel: relative to the depth, not to themselves
    np.testing.assert_allclose(fast.position, slow.position, rtol=2e-5, atol=4e-6, equal_nan=True)
    np.testing.assert_allclose(fast.weight, slow.weight, rtol=2e-4, atol=2e-6)
    both = np.isfinite(fast.normal) & np.isfinite(slow.normal)  # one may just miss the least angle
    assert (np.isfinite(fast.normal) != np.isfinite(slow.normal)).mean() < 1e-2
    np.testing.assert_allclose(fast.normal[both], slow.normal[both], atol=2e-3)


ANY_CLOUD = given(
    seed=st.integers(0, 2**31),
    count=st.integers(0, 300),
    size=st.tuples(st.integers(1, 40), st.integers(1, 40)),
    k=st.integers(1, 12),
    grid=st.sampled_from([0.0, 0.05, 0.5]),  # coarse coordinates: many ties
    radius=st.floats(1e-6, 0.5),
    gap=st.sampled_from([0.0, 0.01, 0.3, 1e9]),
)


def assert_equals_definition(
    draw: Rasterizer, seed: int, count: int, size: tuple[int, int], k: int, grid: float, radius: float, gap: float
) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform([-1, -1, -0.5], [1, 1, 2], (count, 3))
    points = np.round(points / grid) * grid if grid else points
    points[rng.random(count) < 0.05] = rng.choice([np.nan, np.inf, -np.inf, 1e30])
    cloud = points.astype(np.float32)
    camera = Camera(*size, *rng.uniform(5, 60, 2), *rng.uniform(-5, 45, 2))
    options = RasterOptions(radius, 0.05, gap, float(rng.uniform(0.5, 70)), k)
    T = se3.exp(rng.normal(0, 0.2, 6))
    outputs = ("position", "index", "weight")
    fast = draw(cloud, camera, T, options, outputs=outputs)
    slow = rasterize_reference(cloud, camera, T, options, outputs=outputs)
    np.testing.assert_array_equal(fast.index, slow.index)
    np.testing.assert_allclose(fast.depth, slow.depth, rtol=1e-5, equal_nan=True)
    np.testing.assert_allclose(fast.position, slow.position, rtol=1e-4, atol=1e-5, equal_nan=True)
    np.testing.assert_allclose(fast.weight, slow.weight, rtol=1e-3, atol=1e-5)


@settings(max_examples=40, deadline=None)
@ANY_CLOUD
def test_kernel_equals_definition_on_any_cloud(**case: Any) -> None:
    assert_equals_definition(rasterize, **case)


def test_given_normals_are_blended_and_face_the_camera() -> None:
    cloud = box(3000, 0.5, 4.0)
    normals = np.random.default_rng(1).normal(size=cloud.shape).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    fast = rasterize(cloud, CAMERA, POSE, OPTIONS, outputs=EVERYTHING, normals=normals)
    slow = rasterize_reference(cloud, CAMERA, POSE, OPTIONS, outputs=EVERYTHING, normals=normals)
    hit = ~fast.hole
    np.testing.assert_allclose(fast.normal[hit], slow.normal[hit], atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(fast.normal[hit], axis=1), 1, atol=1e-5)


def test_normals_of_a_drawn_plane() -> None:
    points = plane(1.0) @ se3.exp(np.array([0, 0, 0, 0.3, -0.2, 0.1]))[:3, :3].T.astype(np.float32)
    options = RasterOptions(radius=0.0071, near=0.1, layer_gap=0.2)
    drawn = rasterize(points, CAMERA, np.eye(4), options, outputs=("position", "normal"))
    expected = -se3.exp(np.array([0, 0, 0, 0.3, -0.2, 0.1]))[:3, 2]
    inner = drawn.normal[5:-5, 5:-5].reshape(-1, 3)
    assert np.nanmedian(np.abs(inner @ expected)) > 0.995
    assert (inner @ expected > 0)[np.isfinite(inner[:, 0])].mean() > 0.99  # towards the camera


def test_points_that_cover_whole_tiles_hide_what_lies_behind() -> None:
    options = RasterOptions(radius=0.5, near=0.05, layer_gap=0.02, max_half=40, k_ray=3)
    cloud = box(3000, 0.2, 3.0) * np.array([0.2, 0.2, 1], np.float32)
    fast = rasterize(cloud, CAMERA, np.eye(4), options, outputs=("position", "index"))
    slow = rasterize_reference(cloud, CAMERA, np.eye(4), options, outputs=("position", "index"))
    np.testing.assert_array_equal(fast.index, slow.index)


@pytest.mark.slow
def test_ten_million_points_in_a_close_up_fit_in_memory() -> None:
    # Not ru_maxrss: a child starts with that of its parent.
    code = """
import re
import numpy as np
from sf_interfaces.types import Camera
from sf_recon.core.ipr_reference import RasterOptions
from sf_recon.core.rasterizer import rasterize
points = np.random.default_rng(0).uniform([-1, -1, 0.1], [1, 1, 1], (10_000_000, 3)).astype(np.float32)
camera = Camera(640, 480, 585, 585, 320, 240)
for radius in (0.001, 0.05):
    drawn = rasterize(points, camera, np.eye(4), RasterOptions(radius, 0.1, 0.02), outputs=("index",))
    assert drawn.hole.mean() < 1e-3
print(re.search(r"VmHWM:\\s+(\\d+) kB", open("/proc/self/status").read())[1])
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(run.stdout) < 2_000_000  # kB


def test_result_does_not_depend_on_threads() -> None:
    cloud = box(50000, 0.5, 4.0)
    one = rasterize(cloud, CAMERA, POSE, OPTIONS, threads=1, outputs=EVERYTHING)
    for threads in (2, 3, 7):
        other = rasterize(cloud, CAMERA, POSE, OPTIONS, threads=threads, outputs=EVERYTHING)
        for name in ("depth", *EVERYTHING):
            assert getattr(one, name).tobytes() == getattr(other, name).tobytes()


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
        make_rasterizer(ReconConfig(rasterizer="vulkan"))
    with pytest.raises(ConfigError, match="cpu or cuda"):
        make_rasterizer(ReconConfig(device="tpu"))
