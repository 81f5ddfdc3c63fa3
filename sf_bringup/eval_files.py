"""Files that can be measured without a run: trajectories, depth maps, surfaces and images."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d

from sf_bringup.evaluation.mesh import Samples
from sf_interfaces.errors import FormatError
from sf_interfaces.io.trajectory import read_kitti, read_tum
from sf_interfaces.types import DepthMap, Float32, Trajectory, UInt8

DEPTH_SUFFIXES = (".npz", ".npy", ".png")
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
_SURFACE_SUFFIXES = (".ply", ".glb", ".obj", ".stl", ".off")


def read_trajectory(path: Path) -> Trajectory:
    """A TUM file (8 values a line) or a KITTI file (12 values, stamps 0.1 s apart), told by its first line.

    Raises:
        FormatError: unreadable.
    """
    try:
        lines = path.read_text().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise FormatError(f"cannot read trajectory {path}: {error}; give a TUM or KITTI text file") from error
    first = next((line for line in lines if line.strip() and not line.lstrip().startswith("#")), "")
    return read_kitti(path) if len(first.split()) == 12 else read_tum(path)


def read_depth(path: Path) -> DepthMap:
    """Depth of a .npz (z in m, variance if there), a .npy (m) or a 16-bit .png (mm, 0 = none).

    Raises:
        FormatError: unreadable, or not a depth map.
    """
    try:
        if path.suffix == ".npz":
            with np.load(path) as data:
                return DepthMap(data["z"], data.get("variance"))
        if path.suffix == ".npy":
            return DepthMap(_nan_for_zero(np.load(path)))
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    except Exception as error:  # numpy's header is a piece of Python, and its parser raises what that raises
        raise FormatError(f"cannot read depth {path} ({error}); give .npz with z, .npy or 16-bit PNG") from error
    if image is None or image.dtype != np.uint16 or image.ndim != 2:
        raise FormatError(f"{path} is no depth image; a PNG must have one channel of 16 bits, in millimetres")
    return DepthMap(_nan_for_zero(image / 1000.0))


def _nan_for_zero(z: np.ndarray) -> Float32:
    return np.where(z > 0, z, np.nan).astype(np.float32)


def read_image(path: Path) -> UInt8:
    """RGB [H, W, 3].

    Raises:
        FormatError: unreadable.
    """
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise FormatError(f"cannot read image {path}; give a PNG or JPEG file")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def read_surface(path: Path) -> Samples:
    """A mesh (PLY, GLB, OBJ, STL, OFF), or a PLY of points where it has no triangles.

    Raises:
        FormatError: missing, unreadable or empty.
    """
    if not path.is_file():
        raise FormatError(f"{path} does not exist; give a mesh or point file ({', '.join(_SURFACE_SUFFIXES)})")
    if path.suffix not in _SURFACE_SUFFIXES:
        raise FormatError(f"{path} is no surface file; its name must end with {', '.join(_SURFACE_SUFFIXES)}")
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):  # points alone are no fault
        mesh = o3d.io.read_triangle_mesh(str(path))
    vertices, triangles = np.asarray(mesh.vertices), np.asarray(mesh.triangles, dtype=np.int64)
    if len(triangles) == 0 and path.suffix == ".ply":
        vertices = np.asarray(o3d.io.read_point_cloud(str(path)).points)
    if len(vertices) == 0:
        raise FormatError(f"{path} is empty: it has neither triangles nor points")
    return Samples(vertices, triangles)


def files_by_name(folder: Path, suffixes: tuple[str, ...]) -> dict[str, Path]:
    """Name without suffix -> file; where a name has several, the suffix listed first wins."""
    return {p.stem: p for suffix in reversed(suffixes) for p in folder.glob(f"*{suffix}")}


def paired(found: Path, reference: Path, suffixes: tuple[str, ...]) -> Iterator[tuple[Path, Path]]:
    """Two files, or the files of two folders whose names without suffix are equal.

    Raises:
        FormatError: one is missing, one is a folder and one is not, or no names are equal.
    """
    for path in (found, reference):
        if not path.exists():
            raise FormatError(f"{path} does not exist; give a file or a folder of {', '.join(suffixes)} files")
    if found.is_file() and reference.is_file():
        yield found, reference
        return
    if found.is_file() or reference.is_file():
        raise FormatError(f"{found} and {reference} must both be files or both be folders")
    files, known = (files_by_name(folder, suffixes) for folder in (found, reference))
    pairs = [(path, known[name]) for name, path in sorted(files.items()) if name in known]
    if not pairs:
        raise FormatError(f"no file of {found} has the name of one in {reference} ({', '.join(suffixes)})")
    yield from pairs
