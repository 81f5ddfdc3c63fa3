"""Good neighbours, scale to global, outliers and the monocular prior: small parts with known answers."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sf_depth.core.monodepth import StructurePrior, load_monodepth
from sf_depth.core.neighbors import NeighborLimits, before_and_after, find_good_neighbors, nearest
from sf_depth.core.outliers import lonely
from sf_depth.core.scale import from_translations
from sf_interfaces.errors import ConfigError, InsufficientParallax
from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera, DepthMap

CAMERA = Camera(80, 60, 70.0, 70.0, 40.0, 30.0)
LIMITS = NeighborLimits(30.0, 0.03, 0.4)


def pose(x: float, z: float = 0.0, yaw_deg: float = 0.0) -> np.ndarray:
    return se3.exp(np.array([x, 0, z, 0, 0, 0])) @ se3.exp(np.array([0, 0, 0, 0, np.radians(yaw_deg), 0]))


@pytest.mark.parametrize("unit", [0.01, 1.0, 1000.0])
def test_neighbours_do_not_depend_on_the_unit(unit: float) -> None:
    candidates = [pose(0.01), pose(0.1), pose(0.3), pose(0.2, yaw_deg=40), pose(0.1, z=0.2), pose(0.9)]
    scaled = [T * np.where(np.arange(4) == 3, [[unit], [unit], [unit], [1]], 1.0) for T in candidates]
    assert find_good_neighbors(np.eye(4), scaled, unit, LIMITS, 2) == [2, 1]


def test_neighbours_come_from_both_sides_where_they_can() -> None:
    poses = [pose(0.1 * k) for k in range(7)]
    assert before_and_after(3, poses, 1.0, LIMITS, 4) == [0, 1, 5, 6]
    assert before_and_after(0, poses, 1.0, LIMITS, 4) == [1, 2, 3]


def test_the_nearest_of_the_others_see_what_passes_close_by() -> None:
    poses = [pose(0.02 * k) for k in range(7)]
    assert nearest(3, poses, 1.0, LIMITS, [0, 1, 5, 6], 2) == [2, 4]
    assert nearest(0, poses, 1.0, LIMITS, [6], 3) == [1, 2, 3]
    assert nearest(0, [*poses[:3], pose(0.001), pose(0.03, yaw_deg=40)], 1.0, LIMITS, [1], 3) == [2]


def test_translations_give_the_scale_in_spite_of_a_wrong_one() -> None:
    own = np.random.default_rng(1).normal(size=(5, 3))
    given = 7.0 * own
    given[2] *= 1.5
    assert abs(from_translations(own, given).factor / 7 - 1) < 1e-9
    with pytest.raises(InsufficientParallax, match="no baseline"):
        from_translations(own, np.zeros((5, 3)))


def test_lonely_points_are_found_at_any_distance() -> None:
    for depth in (0.5, 500.0):
        d = np.full((40, 40), 1 / depth, np.float32)
        d[20, 20] *= 2
        found = lonely(d, np.full_like(d, 1e-12))
        assert found[20, 20] and found.sum() < 0.02 * found.size + 1


def test_the_structure_prior_is_a_plane_where_the_scene_is() -> None:
    rays = CAMERA.unproject(CAMERA.pixel_grid(), np.ones((60, 80)))
    truth = 4.0 / (rays @ np.array([0.3, 0.5, 1.0]))
    kept = np.random.default_rng(0).random(truth.shape) < 0.1
    grey = np.full((60, 80), 90, np.uint8)
    found = StructurePrior()(grey, CAMERA, DepthMap(np.where(kept, truth, np.nan)))
    assert np.abs(found.z / truth - 1).max() < 0.02


def test_weights_that_are_not_there_are_not_downloaded(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no Metric3D repository in"):
        load_monodepth("metric3d", str(tmp_path))
    with pytest.raises(ConfigError, match=r"needs transformers|nothing is downloaded"):
        load_monodepth("depth_anything", str(tmp_path))
    with pytest.raises(ConfigError, match="no monocular depth 'oracle'"):
        load_monodepth("oracle")
