"""Refinement of swept depth: between the planes of a sweep, on surfaces at a slant."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from sf_depth.core import pinhole
from sf_depth.core.dense_ba import Estimate
from sf_depth.core.plane_sweep import Compared, compare
from sf_depth.core.refined import refined
from sf_interfaces.geometry import se3
from sf_interfaces.types import Float32
from tests.depth.views import room

MOVED = 0.75  # px between two planes


@pytest.fixture(scope="module")
def scene() -> tuple[Compared, Float32, float]:
    """A view of a room beside three others, its exact inverse depth, and the spacing of the planes of its sweep."""
    views = room(4)
    T = np.stack([se3.inverse(pose) @ views.poses[0] for pose in views.poses[1:]])
    at = Estimate(pinhole.theta_of(views.camera), T, 1 / views.z[0].reshape(-1).astype(np.float64))
    spacing = MOVED / (views.camera.fx * float(np.linalg.norm(T[:, :3, 3], axis=1).max()))
    return compare(views.images[0], views.images[1:], at, 1), (1 / views.z[0]).astype(np.float32), spacing


def test_depth_is_found_between_the_planes(scene: tuple[Compared, Float32, float]) -> None:
    part, exact, spacing = scene
    on_planes = (np.rint(exact / spacing) * spacing).astype(np.float32)
    before, after = (np.abs(d - exact) / spacing for d in (on_planes, refined(part, on_planes, spacing)[0]))
    assert np.median(before) > 0.2 and np.median(after) < 0.5 * np.median(before)
    assert np.mean(after) < np.mean(before)


def test_a_surface_of_one_depth_looks_like_its_plane(scene: tuple[Compared, Float32, float]) -> None:
    part, exact, _ = scene
    d = np.float32(np.median(exact))
    np.testing.assert_allclose(part.dissimilarity_of(np.full_like(exact, d)), part.dissimilarity(d), atol=1e-3)
    wrong = part.dissimilarity_of((1.2 * exact).astype(np.float32))
    assert np.median(part.dissimilarity_of(exact)) < 0.6 * np.median(wrong)
