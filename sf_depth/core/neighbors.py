"""Which frames to triangulate a reference with (paper Sec. Depth Frame Selection, supplement algorithm).

A good neighbour faces the same way and has a baseline. All lengths are relative to the depth of the scene, so
that a table and a town are treated alike. (The printed algorithm keeps angles *above* the limit; what it means
is below.)
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sf_interfaces.geometry import se3
from sf_interfaces.types import Float64

_CLOSE = 0.5  # of the least baseline of a good neighbour


@dataclass(frozen=True, slots=True)
class NeighborLimits:
    """What makes a good neighbour: facing angle deg, and baselines relative to the depth of the scene."""

    max_angle: float
    min_baseline: float
    max_baseline: float


def find_good_neighbors(
    T_map_reference: Float64, poses: Sequence[Float64], scene_depth: float, limits: NeighborLimits, count: int
) -> list[int]:
    """Indices of the ``count`` poses with the largest sideways baselines, best first; fewer if there are fewer.

    Args:
        T_map_reference: pose of the reference [4, 4].
        poses: T_map_camera of the candidates.
        scene_depth: typical depth the reference sees, in the unit of the poses.
    """
    good: list[tuple[float, int]] = []
    for j, T_map_j in enumerate(poses):
        T = se3.inverse(T_map_reference) @ T_map_j
        facing = np.degrees(np.arccos(np.clip(T[2, 2], -1.0, 1.0)))
        baseline = float(np.linalg.norm(T[:3, 3])) / scene_depth
        sideways = float(np.linalg.norm(T[:2, 3])) / scene_depth
        if facing < limits.max_angle and limits.min_baseline < baseline < limits.max_baseline:
            good.append((-sideways, j))
    return [j for _, j in sorted(good)[:count]]


def before_and_after(
    index: int, poses: Sequence[Float64], scene_depth: float, limits: NeighborLimits, count: int
) -> list[int]:
    """Good neighbours of pose ``index``, half of them earlier and half later where both sides have enough."""
    earlier = find_good_neighbors(poses[index], poses[:index], scene_depth, limits, count)
    later = [index + 1 + j for j in find_good_neighbors(poses[index], poses[index + 1 :], scene_depth, limits, count)]
    half = count // 2
    first = max(half, count - len(later))
    chosen = earlier[:first]
    return sorted(chosen + later[: count - len(chosen)])


def nearest(
    index: int, poses: Sequence[Float64], scene_depth: float, limits: NeighborLimits, taken: Sequence[int], count: int
) -> list[int]:
    """The ``count`` poses next to pose ``index`` that are not taken, nearest first: they see what passes close by.

    They face the same way, and half the baseline of a good neighbour is enough.
    """
    close = replace(limits, min_baseline=_CLOSE * limits.min_baseline)
    others = [j for j in range(len(poses)) if j != index and j not in taken]
    good = find_good_neighbors(poses[index], [poses[j] for j in others], scene_depth, close, len(others))
    away = [(float(np.linalg.norm(poses[others[k]][:3, 3] - poses[index][:3, 3])), others[k]) for k in good]
    return [j for _, j in sorted(away)[:count]]
