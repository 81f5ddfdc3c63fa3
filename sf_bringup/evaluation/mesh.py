"""Accuracy and completion of a surface, as NICE-SLAM (culled) and NICER-SLAM (not culled) measure them."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sf_interfaces.errors import FormatError
from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera, Float64

SAMPLES = 200_000
THRESHOLD = 0.05  # m: within it a point counts as completed, and for the F-score as precise
ICP_DISTANCE = 0.1  # m, of the pre-alignment
_ICP_ROUNDS = 50


@dataclass(frozen=True, slots=True)
class Samples:
    """Points on a surface: drawn from its triangles by area, or the points of a cloud.

    Args:
        vertices: [V, 3] m.
        triangles: [T, 3] indices; empty for a cloud.
    """

    vertices: Float64
    triangles: NDArray[np.int64]

    def draw(self, count: int, seed: int = 0) -> Float64:
        """``count`` points [N, 3] by area; of a cloud at most its own points.

        Raises:
            FormatError: there is no surface.
        """
        rng = np.random.default_rng(seed)
        if len(self.triangles) == 0:
            if len(self.vertices) == 0:
                raise FormatError("the surface is empty: it has neither triangles nor points")
            if len(self.vertices) <= count:
                return self.vertices
            return self.vertices[rng.choice(len(self.vertices), count, replace=False)]
        a, b, c = (self.vertices[self.triangles[:, k]] for k in range(3))
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        if not area.sum() > 0:
            raise FormatError("the surface is empty: none of its triangles has an area")
        which = rng.choice(len(area), count, p=area / area.sum())
        s, t = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
        return (1 - s) * a[which] + s * (1 - t) * b[which] + s * t * c[which]

    def moved(self, T: Float64, scale: float = 1.0) -> Samples:
        """The surface after ``T (scale * x)``."""
        return replace(self, vertices=se3.transform(T, scale * self.vertices))


@dataclass(frozen=True, slots=True)
class SurfaceError:
    """Distances between samples of a reconstruction and of the reference."""

    accuracy: float  # cm, mean distance reconstruction -> reference
    completion: float  # cm, mean distance reference -> reconstruction
    completion_ratio: float  # percent of reference samples within 5 cm
    precision: float  # percent of reconstruction samples within 5 cm
    f_score: float  # percent, harmonic mean of precision and completion ratio
    samples: int  # of the reference that were compared

    def as_dict(self) -> dict[str, float]:
        """Plain numbers for JSON."""
        return asdict(self)


def surface_error(
    reconstruction: Samples,
    reference: Samples,
    views: tuple[Camera, Float64] | None = None,
    samples: int = SAMPLES,
    seed: int = 0,
) -> SurfaceError:
    """Accuracy, completion, completion ratio and F-score; both surfaces in one frame, m.

    Args:
        views: camera and T_map_camera [N, 4, 4]: NICE culling, samples outside every view are dropped
            (frusta only, no occlusion); None: NICER, nothing is culled.

    Raises:
        FormatError: a surface is empty, or nothing of it lies in any view.
    """
    rec, ref = reconstruction.draw(samples, seed), reference.draw(samples, seed + 1)
    if views is not None:
        rec, ref = (points[seen_by_any(points, *views)] for points in (rec, ref))
        if len(rec) == 0 or len(ref) == 0:
            raise FormatError("no part of the surface lies in any view; are surface and trajectory in one frame?")
    return error_of_distances(nearest_distance(rec, ref), nearest_distance(ref, rec))


def error_of_distances(accuracy: Float64, completion: Float64) -> SurfaceError:
    """The measures of distances [N] m from the reconstruction to the reference and [M] m back."""
    precision, recall = (100 * float((d < THRESHOLD).mean()) for d in (accuracy, completion))
    return SurfaceError(
        accuracy=100 * float(accuracy.mean()),
        completion=100 * float(completion.mean()),
        completion_ratio=recall,
        precision=precision,
        f_score=2 * precision * recall / (precision + recall) if precision + recall else 0.0,
        samples=len(completion),
    )


def nearest_distance(source: Float64, target: Float64) -> Float64:
    """Distance [N] m from each source point to the nearest target point."""
    return cKDTree(target).query(source, workers=2)[0]


def seen_by_any(points: Float64, camera: Camera, T_map_camera: Float64) -> NDArray[np.bool_]:
    """Which points [N, 3] lie inside the frustum of at least one view."""
    seen = np.zeros(len(points), bool)
    for T in se3.inverse(T_map_camera):
        hidden = np.flatnonzero(~seen)
        uv, z = camera.project(se3.transform(T, points[hidden]))
        inside = (z > 0) & (uv >= 0).all(1) & (uv[:, 0] < camera.width) & (uv[:, 1] < camera.height)
        seen[hidden[inside]] = True
    return seen


def icp(source: Samples, target: Samples, samples: int = 50_000, seed: int = 0) -> Float64:
    """T_target_source of point-to-point ICP from identity, pairs within 0.1 m (NICE's pre-alignment).

    Raises:
        FormatError: the surfaces are nowhere within 0.1 m of each other.
    """
    from sf_interfaces.geometry.align import align

    points, tree = source.draw(samples, seed), cKDTree(target.draw(4 * samples, seed + 1))
    fixed, T = tree.data, np.eye(4)
    for _ in range(_ICP_ROUNDS):
        moved = se3.transform(T, points)
        distance, index = tree.query(moved, workers=2, distance_upper_bound=ICP_DISTANCE)
        pairs = np.isfinite(distance)
        if pairs.sum() < 3:
            raise FormatError("ICP finds no part of the surface within 0.1 m of the reference; align them first")
        _, step = align(moved[pairs], np.asarray(fixed)[index[pairs]])
        T = step @ T
        if np.linalg.norm(se3.log(step)) < 1e-6:
            break
    return T
