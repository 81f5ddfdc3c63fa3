"""Where in the map is this image? Answered from remembered views, their landmarks and descriptors alone."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np
from scipy.spatial import cKDTree

from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera, Float64, Frame, Keyframe, PointCloud, UInt8
from sf_tracking.core.patches import to_gray

_FEATURES = 1500
_PATCH_PX = 31.0  # what a descriptor looks at
_RATIO = 0.8  # Lowe's ratio between best and second match
_PNP_PX = 3.0
_PNP_ROUNDS = 500
_MIN_INLIERS = 40  # fewer were seen to agree on a pose that is decimetres off
_MIN_SHARE = 0.4  # of the matches
_SPARSE_PX = 2.0  # a corner takes the depth of a LiDAR point this near


def view(frame: Frame, T_map_camera: Float64) -> Keyframe | None:
    """A tracked frame as something to find the map by: its corners with measured depth are the landmarks.

    Returns:
        None where nothing is measured (the final keyframes of the tracker have to do).
    """
    assert frame.image is not None and frame.camera is not None
    corners = cv2.ORB_create(nfeatures=_FEATURES).detect(to_gray(frame.image), None)
    uv = np.array([k.pt for k in corners]).reshape(-1, 2) + 0.5
    z = np.full(len(uv), np.nan)
    if frame.depth is not None and len(uv):
        column, row = uv.astype(np.int64).T
        z = np.where(frame.depth.valid, frame.depth.z, np.nan)[row, column].astype(np.float64)
    elif frame.sparse_depth is not None and len(uv) and len(frame.sparse_depth):
        distance, nearest = cKDTree(frame.sparse_depth.uv).query(uv, distance_upper_bound=_SPARSE_PX)
        z[np.isfinite(distance)] = frame.sparse_depth.z[nearest[np.isfinite(distance)]]
    known = np.isfinite(z)
    if known.sum() < _MIN_INLIERS:
        return None
    points = frame.camera.unproject(uv[known], z[known]).astype(np.float32)
    return Keyframe(frame.stamp_ns, frame.camera, frame.image, T_map_camera, None, PointCloud(points))


def rejoin(keyframes: Iterable[Keyframe], image: UInt8, camera: Camera) -> Float64 | None:
    """T_map_camera of an image that sees landmarks of the keyframes, or None.

    Upright ORB descriptors at the landmarks are matched to the corners of the image; PnP with RANSAC over all
    keyframes together follows. The image's camera may be another than theirs.
    """
    orb = cv2.ORB_create(nfeatures=_FEATURES)
    gray = to_gray(image)
    corners, wanted = _describe(orb, gray, np.array([k.pt for k in orb.detect(gray, None)]))
    if wanted is None or len(corners) < _MIN_INLIERS:
        return None
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
    world, pixels = [], []
    for keyframe in keyframes:
        if keyframe.landmarks is None or not len(keyframe.landmarks):
            continue
        points = keyframe.landmarks.points.astype(np.float64)
        uv, _ = keyframe.camera.project(points)
        kept, known = _describe(orb, to_gray(keyframe.image), uv - 0.5)
        if known is None:
            continue
        for pair in matcher.knnMatch(known, wanted, k=2):
            if len(pair) == 2 and pair[0].distance < _RATIO * pair[1].distance:
                world.append(se3.transform(keyframe.T_map_camera, points[kept[pair[0].queryIdx].class_id]))
                pixels.append(corners[pair[0].trainIdx].pt)
    if len(world) < _MIN_INLIERS:
        return None
    return _solve(np.array(world), np.array(pixels) + 0.5, camera)


def _describe(orb: cv2.ORB, gray: UInt8, uv: Float64) -> tuple[list[cv2.KeyPoint], np.ndarray | None]:
    """Keypoints that ORB could describe (``class_id`` is the row of ``uv``) and their descriptors."""
    inside = [(i, u, v) for i, (u, v) in enumerate(uv) if np.isfinite((u, v)).all()]
    points = [cv2.KeyPoint(float(u), float(v), _PATCH_PX, 0.0, 0.0, 0, i) for i, u, v in inside]
    kept, descriptors = orb.compute(gray, points)
    return list(kept), descriptors


def _solve(world: Float64, pixels: Float64, camera: Camera) -> Float64 | None:
    cv2.setRNGSeed(0)
    ok, rvec, tvec, inliers = cv2.solvePnPRansac(
        world, pixels, camera.K, None,
        iterationsCount=_PNP_ROUNDS, reprojectionError=_PNP_PX, flags=cv2.SOLVEPNP_EPNP,
    )  # fmt: skip
    if not ok or inliers is None or len(inliers) < max(_MIN_INLIERS, _MIN_SHARE * len(world)):
        return None
    chosen = inliers.ravel()
    rvec, tvec = cv2.solvePnPRefineLM(world[chosen], pixels[chosen], camera.K, None, rvec, tvec)
    T_camera_map = np.eye(4)
    T_camera_map[:3, :3] = cv2.Rodrigues(rvec)[0]
    T_camera_map[:3, 3] = tvec.ravel()
    return se3.inverse(T_camera_map)
