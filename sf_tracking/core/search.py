"""Wide search: the pose of a frame from descriptors alone, when the predicted motion does not hold."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera, Float64, UInt8
from sf_tracking.config import TrackingConfig
from sf_tracking.core.keyframes import TrackedKeyframe

_FEATURES = 1500
_RATIO = 0.8  # Lowe's ratio between best and second match
_PNP_PX = 3.0


def relocate(
    keyframes: Sequence[TrackedKeyframe], gray: UInt8, camera: Camera, config: TrackingConfig
) -> Float64 | None:
    """Pose T_cw of an image against the patches of recent keyframes, or None.

    ORB descriptors are taken at the patches, whose 3D positions are known, and matched to the corners of
    the image; PnP with RANSAC and a refinement on the inliers follow.
    """
    orb = cv2.ORB_create(nfeatures=_FEATURES)
    corners, descriptors = orb.detectAndCompute(gray, None)
    if descriptors is None or len(corners) < config.min_inliers:
        return None
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
    world, pixels = [], []
    for keyframe in keyframes:
        known, wanted = _described(orb, keyframe)
        if wanted is None or len(wanted) < 2:
            continue
        T_wc = se3.inverse(keyframe.T_cw)
        for pair in matcher.knnMatch(wanted, descriptors, k=2):
            if len(pair) == 2 and pair[0].distance < _RATIO * pair[1].distance:
                world.append(se3.transform(T_wc, keyframe.patches.points(camera)[known[pair[0].queryIdx]]))
                pixels.append(corners[pair[0].trainIdx].pt)
    if len(world) == 0:
        return None
    return consensus(np.array(world), np.array(pixels) + 0.5, camera, config)


def _described(orb: cv2.ORB, keyframe: TrackedKeyframe) -> tuple[list[int], np.ndarray | None]:
    """Indices of the patches that ORB could describe, and their descriptors."""
    uv = keyframe.patches.uv - 0.5
    points = [cv2.KeyPoint(float(u), float(v), 31.0, -1.0, 0.0, 0, i) for i, (u, v) in enumerate(uv)]
    angled = orb.detect(keyframe.view.gray, None)
    if angled:  # a patch takes the orientation of the nearest corner, so that rotation does not break matching
        spots = np.array([k.pt for k in angled])
        for point in points:
            point.angle = angled[int(np.argmin(np.abs(spots - point.pt).sum(axis=1)))].angle
    kept, descriptors = orb.compute(keyframe.view.gray, points)
    return [k.class_id for k in kept], descriptors


def consensus(world: Float64, pixels: Float64, camera: Camera, config: TrackingConfig) -> Float64 | None:
    """Pose T_cw that most pairs of points [E, 3] m and pixels [E, 2] agree on, whatever the others say; or None."""
    if len(world) < config.min_inliers:
        return None
    cv2.setRNGSeed(config.seed)
    ok, rvec, tvec, inliers = cv2.solvePnPRansac(
        world, pixels, camera.K, None, iterationsCount=300, reprojectionError=_PNP_PX, flags=cv2.SOLVEPNP_EPNP
    )
    if not ok or inliers is None or len(inliers) < config.min_inliers:
        return None
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(rvec)[0]
    T[:3, 3] = tvec.ravel()
    return T
