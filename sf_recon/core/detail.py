"""What the nearest keyframe images show of a drawn surface: the fine detail of the light field.

The colour network interpolates over a few points and averages over all keyframes. Between two keyframes their own
images, reprojected by the drawn surface, say more. Keyframes that do not see a pixel's surface, because it is
occluded or outside, do not count for it.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera, Float32, Float64
from sf_recon.core.keyframe_view import KeyframeView
from sf_recon.core.native import native

_DOUBT = 0.05  # of the depth: a keyframe whose own depth is off by so much counts half
_OTHER = 0.3  # of the depth: off by more, it saw another surface. Poses and the drawn edges err by some percent.
_FEATHER = 16.0  # px over which a keyframe fades out towards its border
_UNKNOWN = 0.1  # weight of a keyframe pixel without depth: it may show something nearer
_ENOUGH = 0.98  # fraction of the surface's pixels at which no further keyframe is asked


@dataclass(frozen=True, slots=True)
class Detail:
    """Mean of the keyframe images, and how far it is to be trusted."""

    color: Float32  # [H, W, 3] in 0..255
    confidence: Float32  # [H, W] 0..1: 0 where no keyframe sees the surface from a similar side
    known: NDArray[np.bool_]  # [H, W] whether any keyframe covers the pixel


def view_distances(T_map_camera: Float64, poses: Float64, depth: float) -> Float64:
    """How differently the cameras at poses [N, 4, 4] look: rotation in rad plus translation in depths."""
    cosine = (np.einsum("ij,nij->n", T_map_camera[:3, :3], poses[:, :3, :3]) - 1) / 2
    shift = np.linalg.norm(poses[:, :3, 3] - T_map_camera[:3, 3], axis=1)
    return np.arccos(np.clip(cosine, -1, 1)) + shift / depth


def nearest_views(
    views: Sequence[KeyframeView], T_map_camera: Float64, depth: float, count: int
) -> list[tuple[KeyframeView, float]]:
    """The ``count`` keyframes that look most alike at a scene ``depth`` m away, with their view distances."""
    if not views or count == 0:
        return []
    distances = view_distances(T_map_camera, np.stack([v.T_map_camera for v in views]), depth)
    return [(views[i], float(distances[i])) for i in np.argsort(distances, kind="stable")[:count]]


def detail(
    nearest: Sequence[tuple[KeyframeView, float]],
    camera: Camera,
    T_map_camera: Float64,
    z: Float32,
    surface: NDArray[np.bool_],
    *,
    reach: float,
    threads: int = 0,
) -> Detail:
    """Blend the images of the nearest keyframes, weighted by inverse squared view distance.

    Args:
        nearest: keyframes and their view distances, nearest first.
        z: [H, W] m, finite everywhere.
        surface: [H, W]; where False, z is a guess and a keyframe is not asked whether it saw that depth.
        reach: view distance up to which a keyframe is trusted; fully up to half of it.
        threads: 0 for all. The result does not depend on it.
    """
    sums = Sums.zeros(z.shape)
    z, mask = np.ascontiguousarray(z), np.ascontiguousarray(surface).view(np.uint8)
    for rank, (view, distance) in enumerate(nearest):
        trust = float(np.clip(1.5 - distance / reach, 0, 1))
        if trust == 0 or (rank > 1 and (sums.confidence >= trust).sum() > _ENOUGH * surface.sum()):
            break
        A, b = _motion(view, camera, T_map_camera)
        native().blend_view(
            *(z, mask, view.image, view.z, view.step, A, b, trust, weight_of(distance)),
            *((_DOUBT, _OTHER, _FEATHER, _UNKNOWN), sums.color, sums.total, sums.confidence, threads),
        )
    return Detail(sums.color / np.maximum(sums.total, 1e-12)[..., None], sums.confidence, sums.total > 0)


@dataclass(frozen=True, slots=True)
class Sums:
    """What is added up over keyframes, changed in place."""

    color: Float32  # [H, W, 3]
    total: Float32  # [H, W] of the weights
    confidence: Float32  # [H, W] the largest trust

    @staticmethod
    def zeros(shape: tuple[int, ...]) -> Sums:
        """Before the first keyframe."""
        return Sums(np.zeros((*shape, 3), np.float32), np.zeros(shape, np.float32), np.zeros(shape, np.float32))


def weight_of(distance: float) -> float:
    """Of a keyframe at a view distance."""
    return 1 / (distance**2 + 1e-5)


def blend_reference(
    view: KeyframeView,
    camera: Camera,
    T_map_camera: Float64,
    z: Float32,
    surface: NDArray[np.bool_],
    trust: float,
    weight: float,
    sums: Sums,
) -> None:
    """What the kernel ``blend_view`` computes, by numpy and OpenCV (whose samples lie on a grid of 1/32 px)."""
    image, covered, agreement = _reproject(view, camera, T_map_camera, z, surface)
    np.maximum(sums.confidence, np.float32(trust) * covered, out=sums.confidence)
    share = covered * agreement * np.float32(weight)
    sums.color[:] += image * share[..., None]
    sums.total[:] += share


def _motion(view: KeyframeView, camera: Camera, T_map_camera: Float64) -> tuple[Float32, Float32]:
    """A [3, 3] and b [3]: a pixel [u v 1] at depth z is (A [u v 1] z + b) of the view, before the division."""
    T = se3.inverse(view.T_map_camera) @ T_map_camera
    A = (view.camera.K @ T[:3, :3] @ np.linalg.inv(camera.K)).astype(np.float32)
    return A, (view.camera.K @ T[:3, 3]).astype(np.float32)


def _reproject(
    view: KeyframeView, camera: Camera, T_map_camera: Float64, z: Float32, surface: NDArray[np.bool_]
) -> tuple[NDArray[np.uint8], Float32, Float32]:
    """What a view shows of each pixel's surface.

    Returns:
        Its colour [H, W, 3]; whether it saw that surface, faded at its border, [H, W]; how well its depth agrees, 0..1.
    """
    A, b = _motion(view, camera, T_map_camera)
    u = np.arange(camera.width, dtype=np.float32)[None] + np.float32(0.5)
    v = np.arange(camera.height, dtype=np.float32)[:, None] + np.float32(0.5)
    x, y, d = (z * (A[i, 0] * u + (A[i, 1] * v + A[i, 2])) + b[i] for i in range(3))
    ahead = d > 1e-6
    d[~ahead] = 1.0
    x /= d
    y /= d
    width, height = view.camera.width, view.camera.height
    border = np.minimum(np.minimum(x, width - x), np.minimum(y, height - y))
    weight: Float32 = np.clip(border / np.float32(_FEATHER), 0, 1)
    weight *= ahead
    x -= np.float32(0.5)  # OpenCV counts pixel centres at integers
    y -= np.float32(0.5)
    image = cv2.remap(view.image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    seen = cv2.remap(view.z, x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE) * np.float32(view.step)
    off = np.abs(seen - d) / d
    off[(seen == 0) | ~surface] = 0
    weight *= off < np.float32(_OTHER)
    agreement = 1 / (1 + np.square(off * np.float32(1 / _DOUBT)))
    agreement[seen == 0] = _UNKNOWN
    return image, weight, agreement
