"""What the map weighs, and what it forgets when that is more than its budget."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sf_interfaces.types import Float64
from sf_recon.core.color_field import ColorField
from sf_recon.core.neural_points import NeuralPoints
from sf_recon.core.trainer import Trainer

_ROOM = 0.9  # of the budget remains after an eviction, so that not every keyframe evicts


def points_bytes(points: NeuralPoints, field: ColorField, trainer: Trainer) -> int:
    """Memory of positions, deviations, features, moments and search grids of all levels."""
    own = sum(level.points.nbytes + level.sigmas.nbytes + level.grid.nbytes for level in points.levels)
    return own + sum(f.nbytes for f in field.features) + sum(adam.nbytes for adam in trainer.rows)


def evict(
    points: NeuralPoints, field: ColorField, trainer: Trainer, poses: Mapping[int, Float64], budget: float
) -> None:
    """Forget keyframes with the points they placed until the rest fits, the farthest and oldest first.

    The order is that of distance from the newest keyframe times age in keyframes; the newest stays.
    """
    stamps = list(poses)
    here = poses[stamps[-1]][:3, 3]
    distance = np.array([np.linalg.norm(poses[s][:3, 3] - here) for s in stamps])
    age = np.arange(len(stamps) - 1, -1, -1)
    images = {view.stamp_ns: view.nbytes for view in trainer.views}
    total = points_bytes(points, field, trainer)
    each = total / max(1, sum(len(level) for level in points.levels))
    placed = dict.fromkeys(stamps, 0)
    for level in points.levels:
        for stamp, count in level.runs:
            placed[stamp] += count
    weight = total + sum(images.values())
    gone = set()
    for index in np.argsort(-(distance + 1e-9) * age, kind="stable")[:-1]:
        if weight <= _ROOM * budget:
            break
        stamp = stamps[index]
        weight -= each * placed[stamp] + images.get(stamp, 0)
        gone.add(stamp)
    trainer.views[:] = [view for view in trainer.views if view.stamp_ns not in gone]
    kept = [~np.isin(level.owners, list(gone)) for level in points.levels]
    field.keep(kept)
    for level, adam, mask in zip(points.levels, trainer.rows, kept, strict=True):
        adam.grow(len(mask))
        adam.keep(mask)
        level.keep(mask)
    points.changed()
