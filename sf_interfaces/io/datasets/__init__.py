"""Data sets on disk -> bags. One class per layout, recognised by its files.

A new layout is a subclass of :class:`Dataset`, added to :data:`DATASETS`.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

from sf_interfaces.errors import FormatError
from sf_interfaces.io.bag import is_bag
from sf_interfaces.io.datasets.dataset import Dataset, Reader, Sample
from sf_interfaces.io.datasets.indoor import Replica, ScanNet, SevenScenes
from sf_interfaces.io.datasets.kitti import KittiOdometry, KittiStereo
from sf_interfaces.io.datasets.kitti_raw import KittiRaw
from sf_interfaces.io.datasets.multiview import Colmap, Eth3d, MvsNet, RobustMvd, Strecha
from sf_interfaces.io.datasets.pictures import Photos, Video
from sf_interfaces.io.datasets.tum import IclNuim, TumRgbd
from sf_interfaces.io.datasets.writing import ReadOptions, Written, write

__all__ = ["DATASETS", "Dataset", "ReadOptions", "Reader", "Sample", "Written", "recognise", "write"]

# In the order in which they are tried: what says most about itself first, any folder with pictures last.
DATASETS: tuple[type[Dataset], ...] = (
    SevenScenes,
    Replica,
    ScanNet,
    IclNuim,
    TumRgbd,
    KittiOdometry,
    KittiRaw,
    KittiStereo,
    Eth3d,
    MvsNet,
    Strecha,
    RobustMvd,
    Colmap,
    Video,
    Photos,
)


def recognise(path: Path, depth_scale: float | None = None) -> Dataset:
    """The data set in a folder, or the video in a file.

    Args:
        depth_scale: stored depth units in one metre, in place of the layout's own.

    Raises:
        FormatError: nothing there, or no known layout; says what is there instead.
    """
    if not path.exists():
        raise FormatError(f"data set {path} does not exist; check the path")
    for kind in DATASETS:
        if kind.matches(path) and not (kind is Photos and _bags(path)):  # pictures beside a bag are those of a run
            return kind(path, depth_scale)
    raise FormatError(f"{path} {_what_else(path)}")


def _bags(path: Path) -> list[str]:
    return [p.name for p in sorted(path.iterdir()) if is_bag(p)]


def _what_else(path: Path) -> str:
    """Why a path is no data set, and what to give instead."""
    if path.is_file():
        if path.suffix.lower() in (".txt", ".tum", ".csv", ".kitti"):
            return "is a text file, no recording: a trajectory is given with --poses (input) or --reference (eval)"
        return "is neither a bag nor a video nor a folder; give a recording"
    if bags := _bags(path):
        return f"is a folder with bags; give one of them: {', '.join(bags[:5])}"
    below = [p.name for p in sorted(path.iterdir()) if p.is_dir() and any(kind.matches(p) for kind in DATASETS)]
    if below:
        return f"holds several recordings or one below; give one of them: {', '.join(below[:5])}"
    known = ", ".join(kind.name for kind in DATASETS)
    return f"has the layout of no known data set ({known}); give its sequence folder, see docs/datasets.md"
