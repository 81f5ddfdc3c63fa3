"""Accuracy and completion of the surface that was seen, from samples to triangles.

A distance between two sets of samples has a floor: with n samples on an area A the nearest one is 0.5 * sqrt(A / n)
away although both surfaces are the same; 200 000 samples on the 200 m^2 of a room give 1.6 cm. And frusta see
through walls: the backs and insides of furniture count as missing though no camera can show them. Here the distance
is that to the nearest triangle, and a sample of the reference counts if a view sees it (GO-Surf and Co-SLAM cull so).
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from sf_bringup.evaluation.mesh import (
    SAMPLES,
    Samples,
    SurfaceError,
    error_of_distances,
    nearest_distance,
    seen_by_any,
)
from sf_interfaces.errors import FormatError
from sf_interfaces.types import Camera, Float64

MOST_VIEWS = 200  # evenly spread ones are enough to see what a path sees
_BEHIND = 0.01  # m: a sample so far behind the first hit of its ray is hidden


def seen_surface_error(
    reconstruction: Samples,
    reference: Samples,
    camera: Camera,
    T_map_camera: Float64,
    samples: int = SAMPLES,
    seed: int = 0,
) -> SurfaceError:
    """Accuracy of what lies in any frustum, completion of what any view sees; both surfaces in one frame, m.

    Args:
        T_map_camera: views [N, 4, 4]; at most ``MOST_VIEWS`` evenly spread ones are used.

    Raises:
        FormatError: a surface is empty, the reference has no triangles, or nothing of it is seen.
    """
    if len(reference.triangles) == 0:
        raise FormatError("what is hidden can only be told by a reference with triangles, this one has points alone")
    chosen = np.unique(np.linspace(0, len(T_map_camera) - 1, MOST_VIEWS).astype(int))
    views = T_map_camera[chosen]
    made, true = reconstruction.draw(samples, seed), reference.draw(samples, seed + 1)
    made = made[seen_by_any(made, camera, views)]
    true = true[visible_to_any(true, reference, camera, views)]
    if len(made) == 0 or len(true) == 0:
        raise FormatError("no part of the surface is seen by any view; are surface and trajectory in one frame?")
    return error_of_distances(distance_to(reference, made), distance_to(reconstruction, true))


def visible_to_any(points: Float64, surface: Samples, camera: Camera, T_map_camera: Float64) -> NDArray[np.bool_]:
    """Which points [N, 3] of a surface at least one view sees: inside its frustum and not behind another part."""
    scene, seen = _scene(surface), np.zeros(len(points), bool)
    for T in T_map_camera:
        hidden = np.flatnonzero(~seen)
        inside = hidden[seen_by_any(points[hidden], camera, T[None])]
        offset = points[inside] - T[:3, 3]
        distance = np.linalg.norm(offset, axis=1, keepdims=True)
        rays = np.hstack([np.broadcast_to(T[:3, 3], offset.shape), offset / np.maximum(distance, 1e-9)])
        hit = scene.cast_rays(o3d.core.Tensor(rays.astype(np.float32)))["t_hit"].numpy()
        seen[inside[hit > distance[:, 0] - _BEHIND]] = True
    return seen


def distance_to(surface: Samples, points: Float64) -> Float64:
    """Distance [N] m from points [N, 3] to the nearest triangle, or to the nearest point of a cloud."""
    if len(surface.triangles) == 0:
        return nearest_distance(points, surface.vertices)
    distance: Float64 = _scene(surface).compute_distance(o3d.core.Tensor(points.astype(np.float32))).numpy()
    return distance.astype(np.float64)


def _scene(surface: Samples) -> o3d.t.geometry.RaycastingScene:
    scene = o3d.t.geometry.RaycastingScene()
    triangles = np.ascontiguousarray(surface.triangles, dtype=np.uint32)
    scene.add_triangles(o3d.core.Tensor(surface.vertices.astype(np.float32)), o3d.core.Tensor(triangles))
    return scene
