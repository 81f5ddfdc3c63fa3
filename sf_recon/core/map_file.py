"""The .sfmap file: a zip of numpy arrays and one JSON header. No pickle, so loading runs no code."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from sf_interfaces.config import build, to_dict
from sf_interfaces.errors import FormatError
from sf_interfaces.types import Camera, Float64, Scale
from sf_recon.config import ReconConfig
from sf_recon.core.keyframe_view import KeyframeView
from sf_recon.core.neural_points import NeuralPoints
from sf_recon.core.trainer import Trainer

VERSION = 2


@dataclass(frozen=True, slots=True)
class SavedMap:
    """The content of a map file."""

    config: ReconConfig
    resolution: float
    scale: Scale
    views: list[dict[str, Any]]  # camera, depth step and turns of the kept keyframes
    arrays: Mapping[str, np.ndarray]

    @property
    def poses(self) -> dict[int, Float64]:
        """T_map_camera of every keyframe, by stamp in ns.

        Raises:
            FormatError: they are missing.
        """
        try:
            return dict(zip(self.arrays["keyframe.stamps"].tolist(), self.arrays["keyframe.poses"], strict=True))
        except (KeyError, ValueError) as error:
            raise FormatError(f"the map file lacks the poses of its keyframes: {error}") from error

    @property
    def units(self) -> dict[int, float]:
        """Units of the map per unit in which a keyframe came, by stamp; empty where no loop was closed."""
        stamps = self.arrays["keyframe.stamps"].tolist()
        return dict(zip(stamps, self.arrays.get("keyframe.units", np.ones(len(stamps))).tolist(), strict=True))


def write(
    path: Path,
    config: ReconConfig,
    resolution: float,
    scale: Scale,
    poses: Mapping[int, Float64],
    units: Sequence[float],
    points: NeuralPoints,
    trainer: Trainer,
) -> None:
    """Write points, features, network, keyframes, configuration. Images and depth are packed without loss."""
    field = trainer.field
    arrays = {f"network.{k}": v.cpu().numpy() for k, v in field.network.state_dict().items()}
    arrays["keyframe.stamps"] = np.array(list(poses), np.int64)
    arrays["keyframe.poses"] = np.array(list(poses.values())).reshape(-1, 4, 4)
    arrays["keyframe.units"] = np.array(units, np.float64)
    for i, (level, features) in enumerate(zip(points.levels, field.features, strict=True)):
        arrays |= {f"level{i}.points": level.points, f"level{i}.sigmas": level.sigmas}
        arrays[f"level{i}.runs"] = np.array(level.runs, np.int64).reshape(-1, 2)
        arrays[f"level{i}.features"] = features.cpu().numpy()
    for i, view in enumerate(trainer.views):
        arrays |= {f"view{i}.image": _packed(view.image), f"view{i}.z": _packed(view.z)}
        if view.weights is not None:
            arrays[f"view{i}.weights"] = view.weights
    header = {
        "format": "sfmap",
        "version": VERSION,
        "resolution": resolution,
        "scale": scale.value,
        "config": to_dict(config),
        "views": [
            {"stamp": v.stamp_ns, "camera": asdict(v.camera), "step": v.step, "turns": v.turns} for v in trainer.views
        ],
    }
    arrays["header"] = np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)
    with path.open("wb") as file:  # an open file keeps numpy from appending .npz to the name
        np.savez(file, allow_pickle=False, **arrays)


def read(path: Path) -> SavedMap:
    """Read and check a map file.

    Raises:
        FormatError: missing, damaged, or of another version.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        header: dict[str, Any] = json.loads(arrays.pop("header").tobytes())
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise FormatError(f"{path} is not a SceneFactory map: {error}") from error
    if header.get("format") != "sfmap" or header.get("version") != VERSION:
        raise FormatError(f"{path} has map version {header.get('version')}, this program reads {VERSION}")
    config = build(ReconConfig, header["config"], where=str(path))
    return SavedMap(config, header["resolution"], Scale(header["scale"]), header["views"], arrays)


def restore(saved: SavedMap, points: NeuralPoints, trainer: Trainer) -> None:
    """Put saved arrays into freshly built points and trainer.

    Raises:
        FormatError: an array is missing or has the wrong shape.
    """
    a, field, poses = saved.arrays, trainer.field, saved.poses
    try:
        for i, level in enumerate(points.levels):
            runs = [(int(stamp), int(count)) for stamp, count in a[f"level{i}.runs"]]
            level.replace(a[f"level{i}.points"], a[f"level{i}.sigmas"], runs)
            field.features[i] = field.sent(a[f"level{i}.features"])
        state = {k.removeprefix("network."): torch.from_numpy(v) for k, v in a.items() if k.startswith("network.")}
        field.network.load_state_dict(state)
        for i, v in enumerate(saved.views):
            image, z = _unpacked(a[f"view{i}.image"]), _unpacked(a[f"view{i}.z"])
            T, weights = poses[v["stamp"]], a.get(f"view{i}.weights")
            view = KeyframeView(v["stamp"], Camera(**v["camera"]), T, image, z, v["step"], weights, v["turns"])
            trainer.views.append(view)
    except (KeyError, RuntimeError, TypeError, cv2.error) as error:
        raise FormatError(f"the map file lacks data or has arrays of the wrong shape: {error}") from error


def _packed(image: np.ndarray) -> np.ndarray:
    """PNG bytes of an image, uint8 [H, W, 3] or uint16 [H, W]."""
    return cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1]


def _unpacked(packed: np.ndarray) -> np.ndarray:
    image = cv2.imdecode(packed, cv2.IMREAD_UNCHANGED)
    if image is None:
        raise FormatError("the map file holds a keyframe image that cannot be read")
    return image
