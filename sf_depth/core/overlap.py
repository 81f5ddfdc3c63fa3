"""How far away the scene is that two posed images share, from a few sparse matches."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np

from sf_depth.core import pinhole
from sf_depth.core.matching import grey
from sf_depth.core.seeds import detect, match_features
from sf_depth.core.start import linear_inverse_depth
from sf_interfaces.geometry import se3
from sf_interfaces.types import Keyframe

_LEAST = 20  # matches with parallax
_PARALLAX = np.radians(1.0)


def sighted_depth(frame: Keyframe, others: list[Keyframe]) -> float | None:
    """Median depth of matches triangulated with the poses of the farthest other frame that shows parallax.

    Returns:
        The depth in the unit of the poses, or None where no pair has parallax.
    """
    theta = pinhole.theta_of(frame.camera)
    own = detect(grey(frame.image))
    apart = [np.linalg.norm(o.T_map_camera[:3, 3] - frame.T_map_camera[:3, 3]) for o in others]
    for k in np.argsort(apart)[::-1][:3]:
        matches = match_features(own, detect(grey(others[k].image)))
        if len(matches) < _LEAST:
            continue
        T = se3.inverse(others[k].T_map_camera) @ frame.T_map_camera
        x, y = pinhole.rays(theta, matches.first.T), pinhole.rays(theta, matches.second.T)
        d, _ = linear_inverse_depth(T, x, y)
        good = (d > 0) & (d * np.linalg.norm(T[:3, 3]) > _PARALLAX)
        if good.sum() >= _LEAST:
            return float(1.0 / np.median(d[good]))
    return None
