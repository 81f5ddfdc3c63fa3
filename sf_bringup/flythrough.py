"""A smooth flight through the map of a finished run, as a video or a sequence of images."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from PIL import Image
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, RotationSpline

from sf_bringup.looking import open_map
from sf_bringup.run_folder import RunFolder
from sf_interfaces.errors import ConfigError, FormatError
from sf_interfaces.types import Float64, UInt8

FPS = 25.0
_SMOOTH = 1.5  # keyframes, standard deviation of the smoothing
_METRE_PER_RADIAN = 1.0  # a turn counts as so much way, so that the picture moves evenly


def fly(run_path: Path, frames: int, out: Path) -> int:
    """Draw ``frames`` views along the smoothed way of the keyframes.

    Args:
        out: a name ending in .mp4 (MPEG-4, 25 frames a second) or .webp (moving, what a browser shows anywhere), or a
            folder for ``00000.png`` and so on.

    Returns:
        The number of frames written.

    Raises:
        ConfigError: fewer than two frames, or another kind of file.
        FormatError: no such run, no map in it, fewer than two keyframes, or the file cannot be written.
    """
    if frames < 2:
        raise ConfigError(f"a flight needs at least two frames, got --fly {frames}")
    if out.suffix not in ("", ".mp4", ".webp"):
        raise ConfigError(f"{out} is no .mp4, .webp or folder; choose --out flight.mp4, flight.webp or FOLDER")
    run = RunFolder.open(run_path)
    field, camera = open_map(run), run.camera()
    way = smooth_way(np.array(list(field.poses.values())), frames)
    drawn = (field.render(camera, T).image for T in way)
    if out.suffix == ".mp4":
        _write_video(drawn, out, (camera.width, camera.height))
    elif out.suffix == ".webp":
        first, *rest = (Image.fromarray(image) for image in drawn)
        out.parent.mkdir(parents=True, exist_ok=True)
        first.save(out, save_all=True, append_images=rest, duration=round(1e3 / FPS), loop=0, quality=70)
    else:
        out.mkdir(parents=True, exist_ok=True)
        for index, image in enumerate(drawn):
            cv2.imwrite(str(out / f"{index:05d}.png"), cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    return frames


def smooth_way(poses: Float64, count: int) -> Float64:
    """``count`` poses [count, 4, 4] evenly along the smoothed way through poses [N, 4, 4], N >= 2.

    Raises:
        FormatError: fewer than two poses, or the camera never moves.
    """
    if len(poses) < 2:
        raise FormatError("the map has fewer than two keyframes: there is no way to fly along")
    position = gaussian_filter1d(poses[:, :3, 3], _SMOOTH, axis=0, mode="nearest")
    quaternion = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    flips = np.sign(np.einsum("nc,nc->n", quaternion[1:], quaternion[:-1]))  # q and -q turn alike
    quaternion[1:] *= np.cumprod(np.where(flips == 0, 1, flips))[:, None]
    rotation = Rotation.from_quat(gaussian_filter1d(quaternion, _SMOOTH, axis=0, mode="nearest"))
    turns = (rotation[:-1].inv() * rotation[1:]).magnitude()
    steps = np.linalg.norm(np.diff(position, axis=0), axis=1) + _METRE_PER_RADIAN * turns
    moving = np.concatenate([[True], steps > 1e-9])
    if moving.sum() < 2:
        raise FormatError("the camera of this run never moves: there is no way to fly along")
    s = np.concatenate([[0.0], np.cumsum(steps)])[moving]
    at = np.linspace(0, s[-1], count)
    out = np.tile(np.eye(4), (count, 1, 1))
    out[:, :3, 3] = CubicSpline(s, position[moving])(at)
    out[:, :3, :3] = RotationSpline(s, rotation[moving])(at).as_matrix()
    return out


def _write_video(images: Iterator[UInt8], out: Path, size: tuple[int, int]) -> None:
    out.parent.mkdir(parents=True, exist_ok=True)
    video = cv2.VideoWriter(str(out), cv2.VideoWriter.fourcc(*"mp4v"), FPS, size)
    if not video.isOpened():
        raise FormatError(f"cannot write {out}; choose a folder that can be written, or --out FOLDER for images")
    try:
        for image in images:
            video.write(cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    finally:
        video.release()
