"""Point clouds of the kernels' benchmarks: the walls of a room, or a fused RGB-D recording."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

HALF = np.array([2.5, 1.4, 3.0])  # m, half size of the room
ROOM_POSE = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1.5], [0, 0, 0, 1]], float)  # T_camera_map


def walls(count: int, seed: int = 0) -> np.ndarray:
    """Points [N, 3] float32 m on the six walls, by area, in random order."""
    rng = np.random.default_rng(seed)
    area = np.array([HALF[1] * HALF[2], HALF[0] * HALF[2], HALF[0] * HALF[1]])
    axis = rng.choice(3, count, p=area / area.sum())
    points = rng.uniform(-HALF, HALF, (count, 3))
    points[np.arange(count), axis] = rng.choice([-1, 1], count) * HALF[axis]
    return points.astype(np.float32)


def fused(folder: Path, count: int, view: int = 150, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Random points [N, 3] of the fused depth images of a 7-Scenes recording, and T_camera_map of one frame."""
    parts = []
    v, u = np.mgrid[0:480, 0:640]
    for path in sorted(folder.glob("frame-*.depth.png"))[::4]:
        z = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) / 1000
        valid = (z > 0.1) & (z < 10)
        pose = np.loadtxt(str(path).replace("depth.png", "pose.txt"))
        local = np.stack([(u + 0.5 - 320) / 585 * z, (v + 0.5 - 240) / 585 * z, z], axis=-1)[valid]
        parts.append((local @ pose[:3, :3].T + pose[:3, 3]).astype(np.float32))
    cloud = np.concatenate(parts)
    picked = np.random.default_rng(seed).choice(len(cloud), count, replace=False)
    return cloud[picked], np.linalg.inv(np.loadtxt(folder / f"frame-{view:06d}.pose.txt"))


def in_space_order(points: np.ndarray, cell: float = 0.1) -> np.ndarray:
    """The points sorted by cell, as a map that grew keyframe by keyframe roughly is."""
    return points[np.lexsort(np.floor(points / cell).T)]


def median_ms(calls: dict[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Median wall times over two rounds, so that a busy moment does not hit one method alone.

    Within a round each call repeats by itself: threads of another library may still spin when it has returned.
    """
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(2):
        for name, call in calls.items():
            for turn in range(repeats + 3):  # the first three pay for memory, compilation and what still spins
                start = time.perf_counter()
                call()
                if turn >= 3:
                    times[name].append(time.perf_counter() - start)
    return {name: 1e3 * float(np.median(seconds)) for name, seconds in times.items()}
