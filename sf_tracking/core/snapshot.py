"""The file by which a tracking session outlives its process: arrays without pickle, so loading runs no code."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sf_interfaces.errors import FormatError
from sf_interfaces.io.atomic import replace_file
from sf_interfaces.types import Camera, Float64, Scale, Trajectory
from sf_tracking.core.keyframe_map import KeyframeMap
from sf_tracking.core.places import Place

_VERSION = 3
View = tuple[Place, Float64]  # with its T_map_camera


def write(path: Path, keyframes: KeyframeMap, trajectory: Trajectory, views: Sequence[View]) -> None:
    """Write the map of keyframes with its places, the poses of all frames, and the views of the last seconds."""
    keyframes.complete()
    edges = keyframes.edges
    arrays: dict[str, np.ndarray] = {
        "version": np.array(_VERSION),
        "metric": np.array(keyframes.scale is Scale.METRIC),
        "stamps": trajectory.stamps_ns,
        "poses": trajectory.poses,
        "keyframe_stamps": np.array(keyframes.stamps, np.int64),
        "keyframes": keyframes.S,
        "keyframes_measured": np.array(keyframes.measured, bool),
        "edge_ends": np.array([(i, j, loop) for i, j, _, _, loop in edges], np.int64).reshape(-1, 3),
        "edge_motions": np.array([Z for _, _, Z, _, _ in edges]).reshape(-1, 4, 4),
        "edge_sigmas": np.array([sigma for _, _, _, sigma, _ in edges]).reshape(-1, 7),
        "view_poses": np.array([T for _, T in views]).reshape(-1, 4, 4),
    }
    arrays |= _packed("place", keyframes.places) | _packed("view", [place for place, _ in views])
    with replace_file(path) as draft, draft.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)


def read(path: Path, keyframes: KeyframeMap) -> tuple[dict[int, Float64], list[View]]:
    """Fill a map of keyframes; the poses of all frames by stamp, and the views of the last seconds.

    Raises:
        FormatError: not a snapshot.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            a = {name: file[name] for name in file.files}
        if int(a["version"]) != _VERSION:
            raise ValueError(f"its version is {int(a['version'])}, this program reads {_VERSION}")
        ends = a["edge_ends"].tolist()
        edges = [
            (i, j, Z, sigma, bool(loop))
            for (i, j, loop), Z, sigma in zip(ends, a["edge_motions"], a["edge_sigmas"], strict=True)
        ]
        keyframes.scale = Scale.METRIC if a["metric"] else Scale.ARBITRARY
        measured = a["keyframes_measured"].tolist()
        keyframes.restore(a["keyframe_stamps"].tolist(), a["keyframes"], measured, _unpacked("place", a), edges)
        views = list(zip(_unpacked("view", a), a["view_poses"], strict=True))
        return dict(zip(a["stamps"].tolist(), a["poses"], strict=True)), views
    except (OSError, ValueError, KeyError, TypeError, EOFError, IndexError, zipfile.BadZipFile) as error:
        raise FormatError(f"{path} is no snapshot of the tracker ({error}); delete it and start anew") from error


def _packed(name: str, places: Sequence[Place]) -> dict[str, np.ndarray]:
    """Places as few long arrays."""
    cameras = [(c.width, c.height, c.fx, c.fy, c.cx, c.cy) for c in (place.camera for place in places)]
    return {
        f"{name}_stamps": np.array([place.stamp_ns for place in places], np.int64),
        f"{name}_counts": np.array([len(place) for place in places], np.int64),
        f"{name}_cameras": np.array(cameras, np.float64).reshape(-1, 6),
        f"{name}_points": np.concatenate([np.zeros((0, 3), np.float32), *(place.points for place in places)]),
        f"{name}_descriptors": np.concatenate([np.zeros((0, 32), np.uint8), *(p.descriptors for p in places)]),
    }


def _unpacked(name: str, a: dict[str, np.ndarray]) -> list[Place]:
    cuts = np.cumsum(a[f"{name}_counts"])[:-1]
    points, descriptors = np.split(a[f"{name}_points"], cuts), np.split(a[f"{name}_descriptors"], cuts)
    cameras = [Camera(int(w), int(h), *map(float, k)) for w, h, *k in a[f"{name}_cameras"]]
    stamps = a[f"{name}_stamps"].tolist()
    return [Place(*parts) for parts in zip(stamps, cameras, points, descriptors, strict=True)] if stamps else []
