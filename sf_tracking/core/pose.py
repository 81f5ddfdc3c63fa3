"""The pose of a camera from patches whose place in the world is known: robust, by Gauss-Newton.

Compiled; :mod:`.pose_reference` is the same in numpy.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera, Float64
from sf_tracking.core.bundle import information_root
from sf_tracking.core.native import dense, intrinsics, native

STEPS = 6  # of Gauss-Newton at most, per robust scale
PRIOR = np.array([1e2] * 3 + [1e3] * 3)  # information that the start adds where patches see nothing


@dataclass(frozen=True, slots=True)
class Solution:
    """A pose and how well its patches agree with it."""

    T_cw: Float64
    error: Float64  # [E] px, reprojection errors; infinite behind the camera and for what is not finite
    information: Float64  # [6, 6] of exp(xi) T_cw
    excess: float  # squared errors relative to what their standard deviations say, at least 1
    support: float  # how many patches agree within what alignment claims: the sum of robust weights


def solve_pose(
    camera: Camera, T_cw: Float64, X: Float64, w: Float64, uv: Float64, information: Float64, scales: Sequence[float]
) -> Solution:
    """Robust pose of a camera from patches in the world, near ``T_cw``.

    Args:
        X: [E, 3] scaled points, world position times inverse depth ``w`` [E].
        uv, information: [E, 2] px and [E, 2, 2] where they were seen.
        scales: where the robust kernel sets in, standard deviations; narrower from one to the next.
    """
    root = information_root(information)
    T, *found = native().solve_pose(
        intrinsics(camera), dense(T_cw), dense(X), dense(w), dense(uv), root, dense(scales), PRIOR, STEPS
    )
    return Solution(se3.orthonormalise(T), *found)
