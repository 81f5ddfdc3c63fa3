"""Files for other programs: the mesh and the cloud with normals, on a room known exactly."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import numpy as np
import open3d as o3d
import pytest

from sf_interfaces.errors import ConfigError
from sf_recon.config import ReconConfig
from sf_recon.core import mesh
from sf_recon.core.reconstruction import Reconstruction
from tests.recon.scene import HALF, texture


def off_wall(points: np.ndarray) -> np.ndarray:
    return np.abs(np.abs(points) - HALF).min(axis=1)


@pytest.mark.parametrize("kind", ["tsdf", "poisson"])
def test_mesh_lies_on_the_walls_with_their_colour(room: Reconstruction, kind: str) -> None:
    made = mesh.extract(room, kind)
    sampled = made.sample_points_uniformly(20000)
    points, colors = np.asarray(sampled.points), np.asarray(sampled.colors)
    assert np.percentile(off_wall(points), 95) < room.resolution
    assert np.median(np.abs(colors - texture(points))) < 0.04
    seen = np.concatenate([v.sample(2000, np.random.default_rng(0)).points for v in room.views])
    tree = o3d.geometry.KDTreeFlann(sampled)
    gaps = [np.sqrt(tree.search_knn_vector_3d(p, 1)[2][0]) for p in seen[::20].astype(np.float64)]
    assert np.percentile(gaps, 95) < 4 * room.resolution  # complete where the camera looked


def test_products(room: Reconstruction, tmp_path: Path) -> None:
    names = [path.name for path in room.save_products(tmp_path)]
    assert names == ["map.sfmap", "surface.ply", "mesh.ply"]
    cloud = o3d.io.read_point_cloud(str(tmp_path / "surface.ply"))
    points, normals = np.asarray(cloud.points), np.asarray(cloud.normals)
    inner = (HALF - np.abs(points) > 4 * room.resolution).sum(axis=1) == 2  # away from the edges of the room
    inward = -np.sign(points) * (np.abs(np.abs(points) - HALF) == off_wall(points)[:, None])
    agreement = (normals * inward).sum(axis=1)[inner]
    assert np.median(agreement) > 0.98 and (agreement > 0).mean() > 0.99


def test_a_large_map_gets_voxels_of_twice_the_resolution(room: Reconstruction, monkeypatch: pytest.MonkeyPatch) -> None:
    fine = mesh.extract(room)
    monkeypatch.setattr(mesh, "_MOST_BLOCKS", 10)
    coarse = mesh.extract(room)
    assert 3 * len(coarse.triangles) < len(fine.triangles)


def test_unknown_mesh_is_an_error() -> None:
    with pytest.raises(ConfigError, match=r"none, tsdf, poisson"):
        Reconstruction(ReconConfig(mesh="marching"))
