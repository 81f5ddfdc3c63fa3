"""The files a map leaves behind."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sf_interfaces.io.cloud import write_surface
from sf_interfaces.types import Float32, Float64
from sf_recon.core import mesh
from sf_recon.core.neural_points import NeuralPoints

if TYPE_CHECKING:
    from sf_recon.core.reconstruction import Reconstruction

_NEIGHBOURS = 12  # points a normal is fitted to


def save_products(reconstruction: Reconstruction, folder: Path) -> list[Path]:
    """Write ``map.sfmap``, ``surface.ply`` (points with colour and normals) and, by configuration, ``mesh.ply``.

    Raises:
        FormatError: the map is empty, or a file cannot be written.
    """
    paths = [folder / "map.sfmap", folder / "surface.ply"]
    reconstruction.save(paths[0])
    assert reconstruction.points is not None
    normals = point_normals(reconstruction.points, reconstruction.poses)
    write_surface(paths[1], reconstruction.surface(), normals)
    if reconstruction.config.mesh != "none" and reconstruction.views:
        paths.append(folder / "mesh.ply")
        mesh.write_mesh(paths[-1], mesh.extract(reconstruction, reconstruction.config.mesh))
    return paths


def point_normals(points: NeuralPoints, poses: dict[int, Float64]) -> Float32:
    """Unit normals [N, 3] of the drawn points of all levels, towards the keyframe that placed each.

    The direction of least spread of a point's nearest neighbours on its level.
    """
    out = [np.zeros((0, 3), np.float32)]
    for index, level in enumerate(points.levels):
        own, owners = points.tops(index), points.top_owners(index)
        if len(own) == 0:
            continue
        ids, _ = level.nearest(own, _NEIGHBOURS)
        near = np.where((ids >= 0)[..., None], level.points[np.maximum(ids, 0)], own[:, None])
        near = near - near.mean(axis=1, keepdims=True)
        normal = np.linalg.eigh(np.einsum("nki,nkj->nij", near, near).astype(np.float64))[1][:, :, 0]
        stamps, place = np.unique(owners, return_inverse=True)
        centres = np.array([poses[int(s)][:3, 3] for s in stamps])[place]
        away = np.einsum("ni,ni->n", normal, centres - own) < 0
        normal[away] *= -1
        out.append(normal.astype(np.float32))
    return np.concatenate(out)
