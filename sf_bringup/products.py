"""What can be made from a finished run: exported files."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import shutil
from pathlib import Path

from sf_bringup.run_folder import RunFolder
from sf_interfaces.errors import ConfigError, FormatError
from sf_interfaces.io.trajectory import write_kitti


def _surface_file(run: RunFolder) -> Path:
    path = run.path / "surface.ply"
    if not path.is_file():
        raise FormatError(f"{path} is missing: the line of this run made no surface; run with --goal recon")
    return path


def export(run_path: Path, out: Path, *, tum: bool, kitti: bool, ply: bool) -> list[Path]:
    """Write the trajectory (TUM, KITTI) and the coloured surface (PLY) of a run into ``out``.

    Raises:
        ConfigError: no format was asked for.
        FormatError: the run lacks what a format needs.
    """
    if not (tum or kitti or ply):
        raise ConfigError("export needs at least one of --tum, --kitti, --ply")
    run = RunFolder.open(run_path)
    out.mkdir(parents=True, exist_ok=True)
    written = []
    if tum:
        written.append(Path(shutil.copy(run.path / "trajectory.tum", out / "trajectory.tum")))
    if kitti:
        write_kitti(out / "trajectory.kitti", run.trajectory())
        written.append(out / "trajectory.kitti")
    if ply:
        written.append(Path(shutil.copy(_surface_file(run), out / "surface.ply")))
    return written
