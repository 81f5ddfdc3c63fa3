"""Placement and neighbour search of the multiresolution points."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.distance import pdist

from sf_interfaces.errors import FormatError
from sf_recon.core.native import native
from sf_recon.core.neural_points import NeuralPoints, knn_reference


def surface(n: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-1, 1, (n, 2))
    return np.column_stack([xy, 0.3 * np.sin(4 * xy[:, 0])]).astype(np.float32)


@pytest.mark.parametrize("k", [1, 4, 9])
@pytest.mark.parametrize("radius", [0.02, 0.11, 0.35])
def test_grid_finds_the_exact_neighbours(k: int, radius: float) -> None:
    points, queries = surface(4000), surface(500, seed=1) + np.float32(0.01)
    grid = native().PointGrid(0.05)
    grid.add(points[:1500])
    grid.add(points[1500:])
    ids, d2 = grid.knn(queries, k, radius)
    expected_ids, expected_d2 = knn_reference(points, queries, k, radius)
    np.testing.assert_array_equal(ids >= 0, expected_ids >= 0)
    np.testing.assert_allclose(d2, expected_d2, rtol=1e-4, atol=1e-9)
    found = ids >= 0
    true_d2 = ((points[ids] - queries[:, None]) ** 2).sum(-1)
    np.testing.assert_allclose(d2[found], true_d2[found], rtol=1e-4, atol=1e-9)


def test_empty_grid_and_bad_query() -> None:
    grid = native().PointGrid(0.1)
    ids, d2 = grid.knn(np.zeros((2, 3), np.float32), 3, 0.4)
    assert (ids == -1).all() and np.isinf(d2).all()
    with pytest.raises(IndexError):
        grid.knn(np.full((1, 3), np.nan, np.float32), 1, 0.4)


def test_points_keep_their_spacing_and_cover_the_surface() -> None:
    points = NeuralPoints(0.02, levels=3, multiplier=4.0)
    first = points.allocate(surface(20000), np.full((20000, 3), 0.25, np.float32))
    second = points.allocate(surface(20000, seed=1), np.full((20000, 3), 0.75, np.float32))
    for level, added, later in zip(points.levels, first, second, strict=True):
        assert len(level) == len(added.points) + len(later.points)
        assert pdist(level.points).min() > level.spacing * (1 - 1e-6)
        assert len(later.points) < 0.2 * len(added.points)  # the same surface again adds little
        gap = cKDTree(level.points).query(surface(2000, seed=2))[0].max()
        assert gap < 2.2 * level.spacing
        assert (later.parents < len(added.points)).all()
    assert len(points.levels[0]) > 3 * len(points.levels[1]) > 9 * len(points.levels[2])


def test_parents_are_the_nearest_older_points() -> None:
    points = NeuralPoints(0.1, levels=1, multiplier=4.0)
    color = np.zeros((1, 3), np.float32)
    points.allocate(np.array([[0.0, 0, 0]], np.float32), color)
    far = points.allocate(np.array([[2.0, 0, 0]], np.float32), color)[0]
    near = points.allocate(np.array([[0.15, 0, 0]], np.float32), color)[0]
    assert far.parents.tolist() == [-1] and near.parents.tolist() == [0]


def test_all_levels_and_the_search_grid_weigh_little_for_each_finest_point() -> None:
    rng = np.random.default_rng(0)
    points = NeuralPoints(0.004, 3, 4.0)
    xy = rng.uniform(-1, 1, (500_000, 2))
    cloud = np.column_stack([xy, 0.3 * np.sin(4 * xy[:, 0])]).astype(np.float32)
    points.allocate(cloud, np.full_like(cloud, 0.5))
    grids = sum(level.grid.nbytes for level in points.levels)
    assert 16 * len(points.levels[0]) < grids < 34 * len(points.levels[0])  # x y z id and free places
    empty = native().PointGrid(0.1)
    before = empty.nbytes
    empty.add(np.zeros((1, 3), np.float32))
    assert empty.nbytes > before


def test_samples_that_are_not_finite_or_out_of_range() -> None:
    points = NeuralPoints(0.01, levels=2, multiplier=4.0)
    samples = np.array([[np.nan, 0, 0], [0, 0, 1]], np.float32)
    assert len(points.allocate(samples, np.zeros((2, 3), np.float32))[0].points) == 1
    with pytest.raises(FormatError, match="too far"):
        points.allocate(np.array([[1e6, 0, 0]], np.float32), np.zeros((1, 3), np.float32))
    assert [len(level) for level in points.levels] == [1, 1]
