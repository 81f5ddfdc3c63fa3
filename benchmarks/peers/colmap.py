"""COLMAP through pycolmap: poses and intrinsics of a folder of photos."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pycolmap

from peers import PeerMissing
from sf_interfaces.types import Camera, Float64


class Colmap:
    """SIFT, exhaustive matching, incremental mapping; one unknown camera for all photos."""

    def __init__(self, camera: Camera | None) -> None:
        pass

    def solve(self, folder: Path) -> tuple[Mapping[str, Float64], float]:
        with tempfile.TemporaryDirectory() as scratch:
            database = Path(scratch) / "database.db"
            pycolmap.extract_features(database, folder, camera_mode=pycolmap.CameraMode.SINGLE)
            pycolmap.match_exhaustive(database)
            models = pycolmap.incremental_mapping(database, folder, Path(scratch))
        if not models:
            raise PeerMissing(f"found no model of {folder}")
        model = max(models.values(), key=lambda m: m.num_reg_images())
        poses = {}
        for image in model.images.values():
            T = np.eye(4)
            T[:3] = image.cam_from_world().inverse().matrix()
            poses[image.name] = T
        return poses, float(next(iter(model.cameras.values())).mean_focal_length())


PEERS = {"COLMAP": Colmap}
