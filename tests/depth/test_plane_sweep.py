"""Plane sweep: what stands far in front is found, and aggregation is the shortest path that it claims to be."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray
from views import CAMERA

from sf_depth.config import DepthConfig
from sf_depth.core import pinhole, plane_sweep
from sf_depth.core import plane_sweep_reference as reference
from sf_depth.core.dense_ba import Estimate
from sf_depth.core.filling import Filler
from sf_depth.core.mvd import MultiViewDepth
from sf_interfaces.geometry import se3
from sf_interfaces.types import Keyframe

NEAR, FAR = 1.0, 4.0
SQUARE = (slice(90, 160), slice(120, 200))
STEPS = ((-0.3, 0.0), (0.3, 0.05), (0.05, -0.25), (-0.1, 0.28))  # a near pixel moves by more than the square is wide


@dataclass(frozen=True)
class TwoPlanes:
    """A textured square in front of a textured wall, seen from five places side by side."""

    images: list[NDArray[np.uint8]]
    z: NDArray[np.float64]
    T: NDArray[np.float64]

    @staticmethod
    def make() -> TwoPlanes:
        rng = np.random.default_rng(0)
        wall = _texture(rng, (CAMERA.height + 200, CAMERA.width + 200))
        front = _texture(rng, (SQUARE[0].stop - SQUARE[0].start, SQUARE[1].stop - SQUARE[1].start))
        images, T = [], []
        for x, y in ((0.0, 0.0), *STEPS):
            far, near = (np.round(-CAMERA.fx * np.array([x, y]) / z).astype(int) for z in (FAR, NEAR))
            image = wall[100 - far[1] :, 100 - far[0] :][: CAMERA.height, : CAMERA.width].copy()
            row, col = SQUARE[0].start + near[1], SQUARE[1].start + near[0]
            image[row : row + front.shape[0], col : col + front.shape[1]] = front
            images.append(image)
            pose = np.eye(4)
            pose[:2, 3] = -x, -y
            T.append(pose)
        z = np.full((CAMERA.height, CAMERA.width), FAR)
        z[SQUARE] = NEAR
        return TwoPlanes(images, z, np.stack(T[1:]))


def _texture(rng: np.random.Generator, shape: tuple[int, int]) -> NDArray[np.uint8]:
    coarse = rng.integers(0, 255, (shape[0] // 4 + 1, shape[1] // 4 + 1, 3), dtype=np.uint8)
    return coarse.repeat(4, 0).repeat(4, 1)[: shape[0], : shape[1]]


def test_what_stands_far_in_front_is_found() -> None:
    scene = TwoPlanes.make()
    at = Estimate(pinhole.theta_of(CAMERA), scene.T, np.full(100, 1 / FAR))  # nothing near is known yet
    found = 1 / plane_sweep.sweep_planes(scene.images[0], scene.images[1:], at)
    off = np.abs(found / scene.z[2::4, 2::4] - 1)
    assert (off < 0.05).mean() > 0.9 and np.median(off[23:40, 30:50]) < 0.03


def test_it_gets_depth_and_so_does_what_it_hides() -> None:
    scene = TwoPlanes.make()
    found = MultiViewDepth(DepthConfig()).recover(scene.images[0], scene.images[1:], CAMERA, scene.T)
    full = Filler(DepthConfig()).fill(Keyframe(0, CAMERA, scene.images[0], np.eye(4), found.depth)).depth
    assert full is not None
    off = np.abs(full.z / scene.z - 1)
    assert np.isfinite(found.depth.z[SQUARE]).mean() > 0.5
    assert np.mean(off < 0.03) > 0.93 and np.nanmean(np.abs(found.depth.z / scene.z - 1)) < 0.02


def test_one_path_is_the_best_of_all_assignments() -> None:
    rng = np.random.default_rng(1)
    cost = rng.random((4, 1, 3)).astype(np.float32)
    image = np.array([[0.0], [30.0], [30.0], [0.0]], np.float32)
    total = (plane_sweep.best_paths(cost, image, True) - cost)[-1, 0]  # what comes from below is no path yet
    steps = [max(plane_sweep.BREAK / (1 + d / plane_sweep.EDGE), plane_sweep.BEND) for d in (30.0, 0.0, 30.0)]
    best = np.full(3, np.inf)
    for labels in np.ndindex(3, 3, 3, 3):
        jumps = np.abs(np.diff(labels))
        price = sum(0 if j == 0 else plane_sweep.BEND if j == 1 else s for j, s in zip(jumps, steps, strict=True))
        best[labels[-1]] = min(best[labels[-1]], price + sum(cost[i, 0, k] for i, k in enumerate(labels)))
    np.testing.assert_allclose(total - total.min(), best - best.min(), atol=1e-5)


@pytest.mark.parametrize("sources", [1, 3])
def test_the_kernels_compute_what_the_reference_says(sources: int) -> None:
    rng = np.random.default_rng(2)
    first, *others = rng.uniform(0, 255, (1 + sources, 22, 37)).astype(np.float32)
    theta = np.array([120.0, 118.0, 74.0, 43.0, -0.05])
    at = Estimate(theta, se3.exp(rng.normal(0, 0.1, (sources, 6))), np.ones(1))
    compared = plane_sweep.Compared(first, others, at, 4.0, 4.1)
    for d in np.float32([0.1, 1.0, 3.0]):
        expected = reference.dissimilarity(compared, d)
        assert (expected == plane_sweep.UNSEEN).any()
        np.testing.assert_allclose(compared.dissimilarity(d), expected, atol=2e-4)  # grey levels cancel in variances
    cost = rng.random((22, 37, 19)).astype(np.float32)
    for upright in (True, False):
        expected = reference.best_paths(cost, first, upright)
        np.testing.assert_allclose(plane_sweep.best_paths(cost, first, upright), expected, rtol=1e-5)
