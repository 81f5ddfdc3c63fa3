"""What can be made from a finished run: rendered views, a window on the surface."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d

from sf_bringup.pipeline import load_map
from sf_bringup.run_folder import RunFolder
from sf_interfaces.errors import ConfigError, FormatError
from sf_interfaces.io.trajectory import read_tum


def _surface_file(run: RunFolder) -> Path:
    path = run.path / "surface.ply"
    if not path.is_file():
        raise FormatError(f"{path} is missing: the line of this run made no surface; run with --goal recon")
    return path


def render_views(run_path: Path, poses: Path, out: Path) -> int:
    """Render the map at each pose of a TUM file: ``<stamp>.png`` and ``<stamp>.depth.png`` (16 bit, mm).

    Returns:
        The number of views written.

    Raises:
        FormatError: no such run, no map in it, or no poses.
    """
    run = RunFolder.open(run_path)
    if not run.map.is_file():
        raise FormatError(f"{run.map} is missing: the line of this run made no map; run with --goal recon")
    field, camera, views = load_map(run.map), run.camera(), read_tum(poses)
    out.mkdir(parents=True, exist_ok=True)
    for stamp, T in zip(views.stamps_ns.tolist(), views.poses, strict=True):
        view = field.render(camera, T)
        cv2.imwrite(str(out / f"{stamp}.png"), cv2.cvtColor(view.image, cv2.COLOR_RGB2BGR))
        millimetres = np.nan_to_num(1000.0 * view.depth.z, nan=0.0).clip(0, 65535).astype(np.uint16)
        cv2.imwrite(str(out / f"{stamp}.depth.png"), millimetres)
    return len(views)


def view(run_path: Path) -> None:
    """Open a window on the coloured surface.

    Raises:
        ConfigError: there is no display.
    """
    surface = _surface_file(RunFolder.open(run_path))
    if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise ConfigError(f"no display to open a window on; open {surface} or {run_path}/report.html elsewhere")
    o3d.visualization.draw_geometries([o3d.io.read_point_cloud(str(surface))], window_name=str(surface))
