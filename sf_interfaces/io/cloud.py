"""Point cloud files."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import numpy as np
import open3d as o3d

from sf_interfaces.errors import FormatError
from sf_interfaces.types import Float32, PointCloud

_EMPTY = """ply
format ascii 1.0
element vertex 0
property double x
property double y
property double z
property uchar red
property uchar green
property uchar blue
end_header
"""


def write_surface(path: Path, cloud: PointCloud, normals: Float32 | None = None) -> None:
    """Write points with colour, and normals [N, 3] where given, as PLY; without any point the file says so.

    Raises:
        FormatError: the file cannot be written.
    """
    if not len(cloud):  # Open3D refuses
        path.write_text(_EMPTY)
        return
    out = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud.points.astype(np.float64)))
    if cloud.colors is not None:
        out.colors = o3d.utility.Vector3dVector(cloud.colors / 255.0)
    if normals is not None:
        out.normals = o3d.utility.Vector3dVector(normals.astype(np.float64))
    if not o3d.io.write_point_cloud(path, out):
        raise FormatError(f"cannot write {path}; choose a folder that can be written")
