"""The files of an image set: poses, a coloured cloud and a contact sheet."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from sf_interfaces.geometry import se3
from sf_interfaces.io.cloud import write_surface
from sf_interfaces.io.trajectory import write_tum
from sf_interfaces.types import DepthMap, Keyframe, PointCloud, Trajectory, UInt8

_TILE_WIDTH = 320  # px of the contact sheet
_CLOUD_POINTS = 2_000_000  # of surface.ply at most
_SURE = 0.05  # relative deviation beyond which a pixel is left out of the cloud, unless half of its image is no surer


def save(folder: Path, trajectory: Trajectory, observed: Sequence[Keyframe], completed: Sequence[Keyframe]) -> None:
    """``trajectory.tum``, ``keyframes.tum``, ``surface.ply`` and ``contact_sheet.png``."""
    write_tum(folder / "trajectory.tum", trajectory)
    write_tum(folder / "keyframes.tum", trajectory)
    write_surface(folder / "surface.ply", cloud(completed))
    contact_sheet(folder / "contact_sheet.png", observed, completed)


def cloud(keyframes: Sequence[Keyframe]) -> PointCloud:
    """The pixels whose depth is sure, coloured, in the map frame."""
    points, colors = [], []
    step = max(1, round((sum(k.image.shape[0] * k.image.shape[1] for k in keyframes) / _CLOUD_POINTS) ** 0.5))
    for keyframe in keyframes:
        depth, camera = keyframe.depth, keyframe.camera
        assert depth is not None
        keep = np.zeros(depth.z.shape, bool)
        keep[step // 2 :: step, step // 2 :: step] = True
        keep &= depth.valid
        if depth.variance is not None:
            with np.errstate(invalid="ignore"):
                deviation = np.sqrt(depth.variance) / depth.z
                # What all pixels share, as an unsure focal length, must not empty the cloud.
                keep &= deviation <= max(_SURE, float(np.nanmedian(deviation)))
        own = camera.unproject(camera.pixel_grid()[keep], depth.z[keep].astype(np.float64))
        points.append(se3.transform(keyframe.T_map_camera, own))
        color = keyframe.image[keep]
        colors.append(color if color.ndim == 2 else np.repeat(color[:, None], 3, axis=1))
    return PointCloud(np.concatenate(points), np.concatenate(colors))


def contact_sheet(path: Path, observed: Sequence[Keyframe], completed: Sequence[Keyframe]) -> None:
    """One row an image: the image, triangulated depth, completed depth, relative deviation."""
    rows = []
    for seen, full in zip(observed, completed, strict=True):
        assert seen.depth is not None and full.depth is not None
        z = full.depth.z
        low, high = np.nanpercentile(z, [2, 98])
        image = seen.image if seen.image.ndim == 3 else np.repeat(seen.image[..., None], 3, axis=2)
        tiles = [image, _colored(seen.depth.z, low, high), _colored(z, low, high), _deviation(full.depth)]
        rows.append(np.hstack([_tile(tile) for tile in tiles]))
    cv2.imwrite(str(path), np.vstack(rows)[..., ::-1])


def _tile(image: UInt8) -> UInt8:
    height = round(image.shape[0] * _TILE_WIDTH / image.shape[1])
    return np.asarray(cv2.resize(image, (_TILE_WIDTH, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _colored(z: np.ndarray, low: float, high: float) -> UInt8:
    """Inverse depth in colour, near is warm; black where there is none."""
    with np.errstate(invalid="ignore", divide="ignore"):
        near = (1 / z - 1 / high) / max(1 / low - 1 / high, 1e-9)
    values = (255 * np.clip(np.nan_to_num(near), 0, 1)).astype(np.uint8)
    out = cv2.applyColorMap(values, cv2.COLORMAP_TURBO)[..., ::-1].copy()
    out[~np.isfinite(z)] = 0
    return np.asarray(out, dtype=np.uint8)


def _deviation(depth: DepthMap) -> UInt8:
    """Relative deviation in grey, white = 20 %."""
    assert depth.variance is not None
    with np.errstate(invalid="ignore"):
        share = np.nan_to_num(np.sqrt(depth.variance) / depth.z / 0.2, nan=1.0)
    return np.repeat((255 * np.clip(share, 0, 1)).astype(np.uint8)[..., None], 3, axis=2)
