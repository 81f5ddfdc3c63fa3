"""Geometric verification: the pose of an image among remembered places, or the proof that it is elsewhere."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera, Float64, UInt8
from sf_tracking.core.places import Features, Place

_RATIO = 0.8  # Lowe's ratio between best and second match
_FURTHEST = 64  # bits by which descriptors of one point differ at most
_PNP_PX = (0.005, 1.5, 3.0)  # reprojection error of an inlier: share of the image width, at least and at most, px
_PNP_ROUNDS = 500
_MIN_INLIERS = 30  # different corners of the image; fewer were seen to agree on a pose that is decimetres off
_MIN_SHARE = 0.4  # of the matched corners
_MIN_SEEN = 0.1  # of the places' points that the image should show and of its corners there
_CELLS, _MIN_CELLS = 4, 4  # the image has 4 x 4 cells; the inliers lie in so many of them at least
_NEAR = 0.03  # of the image width: a corner takes the depth of a landmark of its image this near
_MIN_SCALED = 10  # corners with such a depth, from which the ratio of two units is known
_PNP = cv2.SOLVEPNP_EPNP
_CORNER_PX, _INDEPENDENT = 0.7, 100  # deviation of a corner, and how many of them err independently


@dataclass(frozen=True, slots=True)
class Sighting:
    """An image found among places.

    Args:
        T: pose of the camera in the frame and the unit of the places.
        sigma: [6] deviations of the pose in the camera's own frame (unit of the places, rad).
        uv: [K, 2] px corners that agree; points: [K, 3] where they lie, in the frame of the places.
    """

    T: Float64
    sigma: Float64
    uv: Float64
    points: Float64

    @property
    def inliers(self) -> int:
        """How many corners of the image agree with the pose."""
        return len(self.uv)

    def unit(self, own: Place) -> float | None:
        """Length of the image's own unit in that of the places, by depths of the same points; None if too few."""
        uv, _ = own.camera.project(own.points.astype(np.float64))
        z = se3.transform(se3.inverse(self.T), self.points)[:, 2]
        distance = np.linalg.norm(uv[None] - self.uv[:, None], axis=-1)  # [K, N]
        if distance.size == 0:
            return None
        nearest = np.argmin(distance, axis=1)
        near = distance[np.arange(len(z)), nearest] < _NEAR * own.camera.width
        ratios = z[near] / own.points[nearest[near], 2]
        return float(np.median(ratios)) if near.sum() >= _MIN_SCALED else None


def sight(places: Sequence[Place], S: Float64, found: Features, camera: Camera) -> Sighting | None:
    """The pose of an image that shows ``places`` lying at ``S`` [P, 4, 4] in one frame, or None.

    The image's camera may be another than theirs. A repeated texture fails the ratio test; a picture that hangs
    in two rooms fails because too little around it agrees.
    """
    points = np.concatenate([se3.transform(s, p.points.astype(np.float64)) for p, s in zip(places, S, strict=True)])
    descriptors = np.concatenate([p.descriptors for p in places])
    point, corner = _matches(descriptors, found.descriptors)
    if len(np.unique(corner)) < _MIN_INLIERS:
        return None
    T_cw, inlier = _pose(points[point], found.uv[corner], camera)
    if T_cw is None:
        return None
    agreed, first = np.unique(corner[inlier], return_index=True)
    uv = found.uv[agreed]
    if len(agreed) < max(_MIN_INLIERS, _MIN_SHARE * len(np.unique(corner))) or _spread(uv, camera) < _MIN_CELLS:
        return None
    if _seen(points, T_cw, camera, found, point[inlier]) < _MIN_SEEN:
        return None
    agreeing = points[point[inlier][first]]
    return Sighting(se3.inverse(T_cw), _deviations(se3.transform(T_cw, agreeing), camera), uv, agreeing)


def _matches(known: UInt8, wanted: UInt8) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Indices of descriptors that belong together: alike, and clearly more so than any second."""
    if len(known) == 0 or len(wanted) < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(known, wanted, k=2)
    good = [(a.queryIdx, a.trainIdx) for a, b in pairs if a.distance < min(_RATIO * b.distance, _FURTHEST)]
    index = np.array(good, dtype=np.int64).reshape(-1, 2)
    return index[:, 0], index[:, 1]


def _pose(points: Float64, uv: Float64, camera: Camera) -> tuple[Float64 | None, NDArray[np.int64]]:
    """T_camera_places by PnP with RANSAC and a refinement on the inliers, and the indices of those."""
    share, least, most = _PNP_PX
    px = float(np.clip(share * camera.width, least, most))
    cv2.setRNGSeed(0)
    ok, rvec, tvec, inlier = cv2.solvePnPRansac(
        points, uv, camera.K, None, iterationsCount=_PNP_ROUNDS, reprojectionError=px, flags=_PNP
    )
    if not ok or inlier is None or len(inlier) < _MIN_INLIERS:
        return None, np.zeros(0, np.int64)
    index = inlier.ravel()
    rvec, tvec = cv2.solvePnPRefineLM(points[index], uv[index], camera.K, None, rvec, tvec)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(rvec)[0], tvec.ravel()
    with np.errstate(invalid="ignore"):
        good = np.linalg.norm(camera.project(se3.transform(T, points))[0] - uv, axis=1) < px
    return T, np.flatnonzero(good)


def _deviations(X: Float64, camera: Camera) -> Float64:
    """Deviations [6] of a pose from which points X [K, 3], camera frame, are seen.

    Errors of corners and depths are alike in neighbours, so many points tell no more than ``_INDEPENDENT``.
    """
    z = X[:, 2]
    on_axis = X[:, :2] / z[:, None]
    J = np.zeros((len(X), 2, 3))
    J[:, 0, 0], J[:, 1, 1], J[:, :, 2] = 1.0, 1.0, -on_axis
    J *= np.array([camera.fx, camera.fy])[:, None] / z[:, None, None]
    J_xi = np.concatenate([-J, J @ se3.hat(X)], axis=2).reshape(-1, 6)
    covariance = np.linalg.inv(J_xi.T @ J_xi) * len(X) / min(len(X), _INDEPENDENT)
    return np.asarray(_CORNER_PX * np.sqrt(np.diag(covariance)))


def _spread(uv: Float64, camera: Camera) -> int:
    """How many cells of the image the corners lie in."""
    cell = np.floor(uv / (camera.width, camera.height) * _CELLS).astype(np.int64)
    return len(np.unique(cell @ (1, _CELLS)))


def _seen(points: Float64, T_cw: Float64, camera: Camera, found: Features, agreed: NDArray[np.int64]) -> float:
    """Share of the points in view that agree."""
    uv, z = camera.project(se3.transform(T_cw, points))
    visible = camera.sees(uv, z)
    return len(np.unique(agreed)) / max(1, int(visible.sum()))
