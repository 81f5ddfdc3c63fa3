"""Multiresolution neural points: where they are, and the nearest ones of each level (Sec. IV-A).

Level ``l`` has spacing ``resolution * multiplier**l``. A point once placed stays, and its index never
changes, so features and optimiser moments only ever grow.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sf_interfaces.errors import FormatError
from sf_interfaces.types import Float32
from sf_recon.core.native import native

Int32 = NDArray[np.int32]

CELL = 3.0  # width of a grid cell, in spacings: holds about ten surface points; measured fastest of 1 to 6
COPY_RADIUS = 4.0  # spacings within which a new point copies the feature of the nearest
SEARCH_RADIUS = 4.0  # spacings; a neighbour farther than this says nothing about a surface point


def knn_reference(points: Float32, queries: Float32, k: int, radius: float) -> tuple[Int32, Float32]:
    """What the compiled grid computes, by scipy: ids [N, k] (-1: none) and squared distances [N, k] (inf)."""
    if len(points) == 0:
        return np.full((len(queries), k), -1, np.int32), np.full((len(queries), k), np.inf, np.float32)
    distance, ids = cKDTree(points).query(queries, k=k, distance_upper_bound=radius)
    distance, ids = distance.reshape(-1, k), ids.reshape(-1, k)
    return np.where(np.isfinite(distance), ids, -1).astype(np.int32), (distance**2).astype(np.float32)


@dataclass(frozen=True, slots=True)
class Added:
    """Points that one allocation appended to one level."""

    points: Float32  # [M, 3] m, map frame
    colors: Float32  # [M, 3] mean observed colour, 0..1
    parents: Int32  # [M] older point whose feature is copied, or -1


class Level:
    """The points of one resolution."""

    def __init__(self, spacing: float) -> None:
        self.spacing = spacing
        self._grid: Any = native().PointGrid(CELL * spacing)
        self._points: list[Float32] = []
        self._colors: list[Float32] = []

    def __len__(self) -> int:
        return len(self._grid)

    @property
    def points(self) -> Float32:
        """Positions [N, 3] m, map frame."""
        return _joined(self._points)

    @property
    def colors(self) -> Float32:
        """Mean colour observed where the point was placed, [N, 3] in 0..1."""
        return _joined(self._colors)

    def extend(self, samples: Float32) -> Added:
        """Add the samples (rows x y z r g b) that lie farther than the spacing from every point so far."""
        positions = np.ascontiguousarray(samples[:, :3])
        rows, parents = self._grid.add_spaced(positions, self.spacing, COPY_RADIUS * self.spacing)
        added = Added(positions[rows], np.ascontiguousarray(samples[rows, 3:]), parents)
        self._points.append(added.points)
        self._colors.append(added.colors)
        return added

    def restore(self, points: Float32, colors: Float32) -> None:
        """Take over saved points in their saved order."""
        self._grid.add(np.ascontiguousarray(points, dtype=np.float32))
        self._points, self._colors = [points], [colors]

    def nearest(self, queries: Float32, k: int, threads: int = 0) -> tuple[Int32, Float32]:
        """Ids [N, k] (-1: none) and squared distances [N, k] m^2 (inf), nearest first, in four spacings."""
        radius = SEARCH_RADIUS * self.spacing
        ids, d2 = self._grid.knn(np.ascontiguousarray(queries, dtype=np.float32), k, radius, threads)
        return ids, d2


def _joined(parts: list[Float32]) -> Float32:
    """The parts as one array, which then replaces them."""
    if len(parts) != 1:
        parts[:] = [np.concatenate([np.zeros((0, 3), np.float32), *parts])]
    return parts[0]


class NeuralPoints:
    """All levels, finest first."""

    def __init__(self, resolution: float, levels: int, multiplier: float) -> None:
        self.levels = [Level(resolution * multiplier**level) for level in range(levels)]

    def allocate(self, points: Float32, colors: Float32) -> list[Added]:
        """Thin the samples level by level and place points where none is near (Sec. IV-A-1).

        Args:
            points: [N, 3] m, map frame. Rows that are not finite are left out.
            colors: [N, 3] in 0..1.

        Returns:
            What was added to each level, finest first.

        Raises:
            FormatError: a point lies more than a million cells from the map origin.
        """
        finite = np.isfinite(points).all(axis=1)
        samples = np.concatenate([points[finite], colors[finite]], axis=1).astype(np.float32)
        added = []
        for level in self.levels:
            try:
                samples = native().voxel_means(np.ascontiguousarray(samples), level.spacing)
            except IndexError as error:
                raise FormatError(
                    f"a point lies too far from the map origin for resolution {self.levels[0].spacing:g} m; "
                    "raise recon.resolution or check the depth unit"
                ) from error
            added.append(level.extend(samples))
        return added
