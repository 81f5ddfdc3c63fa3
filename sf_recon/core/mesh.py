"""Triangles from the map: the surface is drawn from the keyframes, and what was drawn is fused (Sec. V-A).

Drawing first removes what a point cloud has and a surface has not: points behind the first layer, and the noise
that the mean over a ray's points takes away.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import open3d as o3d

from sf_interfaces.errors import ConfigError, FormatError
from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera, Float32, Float64, UInt8
from sf_recon.config import MESHES
from sf_recon.core.renderer import normals

if TYPE_CHECKING:
    from sf_recon.core.reconstruction import Reconstruction

_TRUNCATION = 4.0  # of the signed distance, in voxels
_BLOCK = 8  # voxels per side of a block
_MOST_BLOCKS = 30000  # with points, which blocks of the finest voxels may be: they weigh about 1 GB
_TRIM = 3.0  # a triangle farther than this from every drawn point is invented, in voxels
_MAX_DEPTH = 10  # of the Poisson octree: 1024 cells per side
_SMALLEST = 120  # triangles; a smaller piece is noise

Mesh = o3d.geometry.TriangleMesh


def extract(reconstruction: Reconstruction, kind: str = "tsdf") -> Mesh:
    """The surface of a map as coloured triangles in the map frame.

    Raises:
        ConfigError: ``kind`` is neither tsdf nor poisson.
        FormatError: the map keeps no keyframe to draw from.
    """
    if kind not in MESHES[1:]:
        raise ConfigError(f"recon.mesh must be one of {', '.join(MESHES)}, got '{kind}'")
    if not reconstruction.views:
        raise FormatError("the map keeps no keyframe to draw its surface from, so it has no mesh")
    return tsdf(reconstruction) if kind == "tsdf" else poisson(reconstruction)


def tsdf(reconstruction: Reconstruction) -> Mesh:
    """Fuse the drawn depth in a truncated signed distance field (Open3D) and take its zero surface."""
    voxel = _voxel(reconstruction)
    names, kinds, sizes = ("tsdf", "weight", "color"), (o3d.core.float32,) * 3, ((1), (1), (3))
    grid = o3d.t.geometry.VoxelBlockGrid(names, kinds, sizes, voxel, _BLOCK, 20000, o3d.core.Device("CPU:0"))
    for camera, T_map_camera, z, image in _drawn(reconstruction):
        depth = o3d.t.geometry.Image(np.nan_to_num(z))
        color = o3d.t.geometry.Image(image.astype(np.float32) / np.float32(255))
        K = o3d.core.Tensor(camera.K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]))  # centres at integers there
        T = o3d.core.Tensor(se3.inverse(T_map_camera))
        far = float(np.nanmax(z)) + 1.0
        blocks = grid.compute_unique_block_coordinates(depth, K, T, 1.0, far, _TRUNCATION)
        grid.integrate(blocks, depth, color, K, K, T, 1.0, far, _TRUNCATION)
    mesh = grid.extract_triangle_mesh(weight_threshold=0.5).to_legacy()
    return _cleaned(mesh)


def poisson(reconstruction: Reconstruction) -> Mesh:
    """Screened Poisson surface of the drawn points with their normals, cut where no point was drawn."""
    voxel = _voxel(reconstruction)
    cloud = o3d.geometry.PointCloud()
    for camera, T_map_camera, z, image in _drawn(reconstruction):
        normal = normals(camera, z, 2 * voxel)
        good = np.isfinite(normal[..., 0]) & np.isfinite(z)
        local = camera.unproject(camera.pixel_grid()[good], z[good].astype(np.float64))
        part = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(se3.transform(T_map_camera, local)))
        part.normals = o3d.utility.Vector3dVector(normal[good] @ T_map_camera[:3, :3].T)
        part.colors = o3d.utility.Vector3dVector(image[good] / 255.0)
        cloud = (cloud + part.voxel_down_sample(voxel)).voxel_down_sample(voxel)
    extent = float(np.max(cloud.get_max_bound() - cloud.get_min_bound()))
    depth = int(np.clip(np.ceil(np.log2(1.1 * extent / voxel)), 4, _MAX_DEPTH))
    mesh, _ = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=depth)
    tree = o3d.core.nns.NearestNeighborSearch(o3d.core.Tensor(np.asarray(cloud.points, np.float32)))
    tree.knn_index()
    _, distance2 = tree.knn_search(o3d.core.Tensor(np.asarray(mesh.vertices, np.float32)), 1)
    mesh.remove_vertices_by_mask(distance2.numpy()[:, 0] > (_TRIM * voxel) ** 2)
    return _cleaned(mesh)


def _voxel(reconstruction: Reconstruction) -> float:
    """Side of a voxel, m."""
    return (reconstruction.config.mesh_voxel or _automatic(reconstruction)) * reconstruction.resolution


def _automatic(reconstruction: Reconstruction) -> float:
    """Voxel in resolutions: half of them find more of the surface, and more truly, at eight times the memory."""
    assert reconstruction.points is not None
    block = _BLOCK * reconstruction.resolution
    levels = (reconstruction.points.tops(i) for i in range(len(reconstruction.points.levels)))
    taken = sum(len(np.unique(np.floor(points / block).astype(np.int64), axis=0)) for points in levels)
    return 1.0 if taken <= _MOST_BLOCKS else 2.0


def _drawn(reconstruction: Reconstruction) -> Iterator[tuple[Camera, Float64, Float32, UInt8]]:
    """Camera, pose, drawn depth and image of every keyframe that the map keeps and that sees its surface."""
    for view in reconstruction.views:
        z = reconstruction.depth(view.camera, view.T_map_camera)
        if np.isfinite(z).any():
            yield view.camera, view.T_map_camera, z, view.image


def _cleaned(mesh: Mesh) -> Mesh:
    """Without crumbs, with normals and colours in 0..1."""
    pieces, sizes, _ = mesh.cluster_connected_triangles()
    if len(sizes):
        mesh.remove_triangles_by_mask(np.asarray(sizes)[np.asarray(pieces)] < _SMALLEST)
        mesh.remove_unreferenced_vertices()
    colors = np.asarray(mesh.vertex_colors)  # shares the mesh's memory
    np.clip(colors, 0, 1, out=colors)
    mesh.compute_vertex_normals()
    return mesh


def write_mesh(path: Path, mesh: Mesh) -> None:
    """Write triangles with colour and normals as PLY.

    Raises:
        FormatError: the file cannot be written.
    """
    if not o3d.io.write_triangle_mesh(str(path), mesh):
        raise FormatError(f"cannot write {path}; choose a folder that can be written")
