"""Looking at the map of a finished run: images rendered from given poses, and the viewer's page."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sf_bringup.pipeline import load_map
from sf_bringup.run_folder import RunFolder
from sf_interfaces.errors import FormatError
from sf_interfaces.io.trajectory import read_tum


def open_map(run: RunFolder) -> Any:
    """The reconstruction of a run.

    Raises:
        FormatError: the run has none.
    """
    if not run.map.is_file():
        raise FormatError(f"{run.map} is missing: the line of this run made no map; run with --goal recon")
    return load_map(run.map)


def render_views(run_path: Path, poses: Path, out: Path) -> int:
    """Render the map at each pose of a TUM file into ``out``.

    Per pose ``<stamp>.png`` (colour), ``.depth.png`` (16 bit, mm, 0 = none), ``.normal.png`` (x, y, z of the optical
    frame from -1..1 to 0..255, black = none) and ``.sigma.png`` (16 bit, tenths of a millimetre, 0 = none).

    Returns:
        The number of views written.

    Raises:
        FormatError: no such run, no map in it, or no poses.
    """
    run = RunFolder.open(run_path)
    field, camera, views = open_map(run), run.camera(), read_tum(poses)
    out.mkdir(parents=True, exist_ok=True)
    for stamp, T in zip(views.stamps_ns.tolist(), views.poses, strict=True):
        view = field.render(camera, T, full=True)
        images = {
            "png": cv2.cvtColor(view.image, cv2.COLOR_RGB2BGR),
            "depth.png": _steps(1e3 * view.depth.z),
            "normal.png": np.rint(np.nan_to_num(127.5 * (view.normal[..., ::-1] + 1))).astype(np.uint8),
            "sigma.png": _steps(1e4 * np.sqrt(view.depth.variance)),
        }
        for name, image in images.items():
            cv2.imwrite(str(out / f"{stamp}.{name}"), image)
    return len(views)


def _steps(values: np.ndarray) -> np.ndarray:
    """Rounded to uint16, 0 where there is none."""
    return np.rint(np.nan_to_num(values, nan=0.0)).clip(0, 65535).astype(np.uint16)


def view(run_path: Path, host: str, port: int, ready: Callable[[str], None]) -> None:
    """Serve a page that shows the map until interrupted; ``ready`` gets its address.

    Raises:
        ConfigError: the viewer is not installed.
        FormatError: no such run, or no map in it.
    """
    page = open_map(RunFolder.open(run_path)).serve(host, port)
    ready(page.url)
    try:
        threading.Event().wait()
    finally:
        page.stop()
