"""The .sfmap file: a zip of numpy arrays and one JSON header. No pickle, so loading runs no code."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sf_interfaces.config import build, to_dict
from sf_interfaces.errors import FormatError
from sf_interfaces.types import Scale
from sf_recon.config import ReconConfig
from sf_recon.core.color_field import ColorField
from sf_recon.core.neural_points import NeuralPoints

VERSION = 1


@dataclass(frozen=True, slots=True)
class SavedMap:
    """The content of a map file."""

    config: ReconConfig
    resolution: float
    scale: Scale
    arrays: Mapping[str, np.ndarray]


def write(
    path: Path, config: ReconConfig, resolution: float, scale: Scale, points: NeuralPoints, field: ColorField
) -> None:
    """Write points, features, network, configuration."""
    header = {
        "format": "sfmap",
        "version": VERSION,
        "resolution": resolution,
        "scale": scale.value,
        "config": to_dict(config),
    }
    arrays = {f"network.{k}": v.numpy() for k, v in field.network.state_dict().items()}
    for i, (level, features) in enumerate(zip(points.levels, field.features, strict=True)):
        arrays |= {f"level{i}.points": level.points, f"level{i}.colors": level.colors}
        arrays[f"level{i}.features"] = features.numpy()
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
    return SavedMap(config, header["resolution"], Scale(header["scale"]), arrays)


def restore(saved: SavedMap, points: NeuralPoints, field: ColorField) -> None:
    """Put saved arrays into freshly built points and field.

    Raises:
        FormatError: an array is missing or has the wrong shape.
    """
    a = saved.arrays
    try:
        for i, level in enumerate(points.levels):
            level.restore(a[f"level{i}.points"], a[f"level{i}.colors"])
            field.features[i] = torch.from_numpy(a[f"level{i}.features"])
        state = {k.removeprefix("network."): torch.from_numpy(v) for k, v in a.items() if k.startswith("network.")}
        field.network.load_state_dict(state)
    except (KeyError, RuntimeError, TypeError) as error:
        raise FormatError(f"the map file lacks data or has arrays of the wrong shape: {error}") from error
