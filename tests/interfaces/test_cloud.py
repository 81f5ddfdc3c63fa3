"""Point cloud files."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import numpy as np
import open3d as o3d
import pytest

from sf_interfaces.io.cloud import write_surface
from sf_interfaces.types import PointCloud


@pytest.mark.parametrize("count", [0, 1, 5])
def test_a_written_surface_has_its_points(count: int, tmp_path: Path) -> None:
    points = np.arange(3 * count, dtype=np.float32).reshape(-1, 3)
    write_surface(tmp_path / "s.ply", PointCloud(points, np.full((count, 3), 200, np.uint8)))
    read = o3d.io.read_point_cloud(tmp_path / "s.ply")
    np.testing.assert_array_equal(np.asarray(read.points).reshape(-1, 3), points)
