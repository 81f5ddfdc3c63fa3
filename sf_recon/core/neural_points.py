"""Multiresolution neural points: where they are, and the nearest ones of each level (Sec. IV-A).

Level ``l`` has spacing ``resolution * multiplier**l``. A surface seen from afar, or with an uncertain depth, gets
points on the coarser levels only: resolution follows the viewing distance. Rows keep their order, so features and
optimiser moments grow with them.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sf_interfaces.errors import FormatError
from sf_interfaces.geometry import se3
from sf_interfaces.types import Float32, Float64
from sf_recon.core.native import native

Int32 = NDArray[np.int32]

CELL = 6.0  # width of a grid cell, in spacings: half the memory of 3, and no slower
COPY_RADIUS = 4.0  # spacings within which a new point copies the feature of the nearest
_MAX_SIGMA = 6e4  # m, what half precision holds
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
    """The points of one resolution.

    Attributes:
        runs: (keyframe stamp ns, number of points) in the order of the rows: which keyframe placed which points.
    """

    def __init__(self, spacing: float) -> None:
        self.spacing = spacing
        self.runs: list[tuple[int, int]] = []
        self.grid: Any = native().PointGrid(CELL * spacing)
        self._points: list[Float32] = []
        self._sigmas: list[NDArray[np.float16]] = []

    def __len__(self) -> int:
        return len(self.grid)

    @property
    def points(self) -> Float32:
        """Positions [N, 3] m, map frame."""
        return _joined(self._points, (0, 3), np.float32)

    @property
    def sigmas(self) -> NDArray[np.float16]:
        """Standard deviation [N] m of the depth that placed each point."""
        return _joined(self._sigmas, (0,), np.float16)

    @property
    def owners(self) -> NDArray[np.int64]:
        """Stamp [N] ns of the keyframe that placed each point."""
        stamps, counts = (np.array([run[i] for run in self.runs], np.int64) for i in (0, 1))
        return np.repeat(stamps, counts)

    def extend(self, samples: Float32, stamp_ns: int) -> Added:
        """Add the samples (rows x y z r g b sigma) that lie farther than the spacing from every point so far."""
        positions = np.ascontiguousarray(samples[:, :3])
        rows, parents = self.grid.add_spaced(positions, self.spacing, COPY_RADIUS * self.spacing)
        added = Added(positions[rows], np.ascontiguousarray(samples[rows, 3:6]), parents)
        self._points.append(added.points)
        self._sigmas.append(samples[rows, 6].clip(0, _MAX_SIGMA).astype(np.float16))
        if len(rows):
            self.runs.append((stamp_ns, len(rows)))
        return added

    def replace(self, points: Float32, sigmas: NDArray[np.float16], runs: list[tuple[int, int]]) -> None:
        """Take over other points in their order; builds the grid anew."""
        self.grid = native().PointGrid(CELL * self.spacing)
        self.grid.add(np.ascontiguousarray(points, dtype=np.float32))
        self._points, self._sigmas, self.runs = [points], [sigmas], runs

    def keep(self, mask: NDArray[np.bool_]) -> None:
        """Keep only some points."""
        bounds = np.cumsum([0, *(count for _, count in self.runs)])
        counts = [int(mask[a:b].sum()) for a, b in pairwise(bounds)]
        runs = [(stamp, n) for (stamp, _), n in zip(self.runs, counts, strict=True) if n]
        self.replace(self.points[mask], self.sigmas[mask], runs)

    def nearest(self, queries: Float32, k: int, threads: int = 0, radius: float = 0.0) -> tuple[Int32, Float32]:
        """Ids [N, k] (-1: none) and squared distances [N, k] m^2 (inf), nearest first, in ``radius`` (0: four)."""
        radius = radius or SEARCH_RADIUS * self.spacing
        ids, d2 = self.grid.knn(np.ascontiguousarray(queries, dtype=np.float32), k, radius, threads)
        return ids, d2


def _joined(parts: list[Any], empty: tuple[int, ...], dtype: Any) -> Any:
    """The parts as one array, which then replaces them."""
    if len(parts) != 1:
        parts[:] = [np.concatenate([np.zeros(empty, dtype), *parts])]
    return parts[0]


class NeuralPoints:
    """All levels, finest first."""

    def __init__(self, resolution: float, levels: int, multiplier: float) -> None:
        self.levels = [Level(resolution * multiplier**level) for level in range(levels)]
        self._multiplier = multiplier
        self._tops: dict[int, tuple[tuple[int, int], NDArray[np.bool_]]] = {}

    def allocate(
        self,
        points: Float32,
        colors: Float32,
        scales: Float32 | None = None,
        sigmas: Float32 | None = None,
        stamp_ns: int = 0,
    ) -> list[Added]:
        """Thin the samples level by level and place points where none is near (Sec. IV-A-1).

        Args:
            points: [N, 3] m, map frame. Rows that are not finite are left out.
            colors: [N, 3] in 0..1.
            scales: [N] m, the finest structure a sample can resolve (None: the finest level's). It goes to the
                levels whose spacing times the root of the multiplier reaches that.
            sigmas: [N] m, standard deviation of the depth; means are weighted by its inverse square (None: equal).
            stamp_ns: the keyframe they come from.

        Returns:
            What was added to each level, finest first.

        Raises:
            FormatError: a point lies more than a million cells from the map origin.
        """
        finite = np.isfinite(points).all(axis=1)
        sigma = np.full(len(points), self.levels[0].spacing, np.float32) if sigmas is None else sigmas
        weight = (1 / np.maximum(sigma, 1e-6) ** 2).astype(np.float32)
        weight /= max(float(weight.mean()), 1e-12) if len(weight) else 1
        values = np.column_stack([points, colors, sigma]) * weight[:, None]
        rows = np.column_stack([points, values, weight]).astype(np.float32)[finite]  # x y z, w (xyz rgb sigma), w
        reach = np.array([level.spacing for level in self.levels]) * np.sqrt(self._multiplier)
        first = np.zeros(len(rows), np.intp)
        if scales is not None:
            first = np.minimum(np.searchsorted(reach, scales[finite]), len(self.levels) - 1)
        thinned, added = rows[:0], []
        for index, level in enumerate(self.levels):
            try:
                fed = np.concatenate([thinned, rows[first == index]])
                thinned = native().voxel_means(np.ascontiguousarray(fed), level.spacing)
            except IndexError as error:
                raise FormatError(
                    f"a point lies too far from the map origin for resolution {self.levels[0].spacing:g} m; "
                    "raise recon.resolution or check the depth unit"
                ) from error
            samples = np.ascontiguousarray(thinned[:, 3:10] / thinned[:, 10:])
            thinned[:, :3] = samples[:, :3]
            added.append(level.extend(samples, stamp_ns))
        return added

    def tops(self, index: int) -> Float32:
        """The points [M, 3] of a level that no finer point stands for: what is drawn of it."""
        return self.levels[index].points[self._top(index)] if index else self.levels[0].points

    def top_owners(self, index: int) -> NDArray[np.int64]:
        """Stamps [M] ns of the keyframes that placed those points."""
        return self.levels[index].owners[self._top(index)]

    def _top(self, index: int) -> NDArray[np.bool_]:
        """Mask [N] of the points of a level that no finer point stands for."""
        level = self.levels[index]
        if index == 0:
            return np.ones(len(level), bool)
        finer = self.levels[index - 1]
        size = (len(level), len(finer))
        seen, mask = self._tops.get(index, ((0, 0), np.zeros(0, bool)))
        if seen != size:
            mask = np.concatenate([mask, np.ones(len(level) - len(mask), bool)])
            open_ = np.flatnonzero(mask)  # a finer point never goes away, so only these can change
            ids, _ = finer.nearest(level.points[open_], 1, radius=level.spacing)
            mask[open_[ids[:, 0] >= 0]] = False
            self._tops[index] = size, mask
        return mask

    def changed(self) -> None:
        """Points were moved or removed: what depended on them is computed anew."""
        self._tops.clear()

    def move(self, motions: Mapping[int, Float64]) -> None:
        """Apply similarities [4, 4] (map frame) to the points that the keyframes with these stamps placed."""
        for level in self.levels:
            points, sigmas, start = level.points.copy(), level.sigmas.copy(), 0
            for stamp, count in level.runs:
                run = slice(start, start + count)
                if stamp in motions:
                    S = motions[stamp]
                    points[run] = se3.transform(S, points[run].astype(np.float64))
                    sigmas[run] = (sigmas[run] * np.cbrt(np.linalg.det(S[:3, :3]))).clip(0, _MAX_SIGMA)
                start += count
            if start:
                level.replace(points, sigmas, level.runs)
        self.changed()
