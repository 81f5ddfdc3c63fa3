"""``sf export``: the results of a run in the formats of other programs, one function per format."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import shutil
from collections.abc import Callable, Collection
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d

from sf_bringup import preflight
from sf_bringup.export_views import export_colmap, export_mvsnet, export_nerfstudio
from sf_bringup.measures import input_bag
from sf_bringup.run_folder import RunFolder
from sf_interfaces.errors import CalibrationError, ConfigError, FormatError
from sf_interfaces.geometry import se3
from sf_interfaces.io.trajectory import write_kitti, write_tum
from sf_interfaces.types import Float64, Trajectory

FRAMES = ("camera", "base_link", "lidar")


def export(
    run_path: Path, out: Path, formats: Collection[str], frame: str = "camera"
) -> tuple[list[Path], dict[str, str]]:
    """Write the chosen formats into ``out``; none chosen: all that the run has results for.

    Args:
        frame: whose motion the trajectories tell: ``camera``, ``base_link`` or ``lidar``.

    Returns:
        What was written, and why each format that was not chosen by name was left out.

    Raises:
        ConfigError: unknown format or frame.
        CalibrationError: the input does not say where that frame sits relative to the camera.
        FormatError: the run lacks what a chosen format needs.
    """
    if frame not in FRAMES:
        raise ConfigError(f"--frame {frame} is unknown; choose {', '.join(FRAMES)}")
    unknown = set(formats) - set(FORMATS)
    if unknown:
        raise ConfigError(f"unknown export format {', '.join(sorted(unknown))}; choose {', '.join(FORMATS)}")
    run = RunFolder.open(run_path)
    T_camera_frame = _mounting(run, frame)
    out.mkdir(parents=True, exist_ok=True)
    written: list[Path] = []
    left_out = {}
    for name in formats or FORMATS:
        try:
            written += FORMATS[name](run, out, T_camera_frame)
        except FormatError as error:
            if formats:
                raise
            left_out[name] = str(error)
    if not written:
        raise FormatError(f"{run_path} holds nothing that can be exported; the run estimated neither poses nor depth")
    return written, left_out


def _mounting(run: RunFolder, frame: str) -> Float64:
    """T_camera_frame from /tf_static of the input."""
    if frame == "camera":
        return np.eye(4)
    frames = run.info()["frames"]
    camera = frames.get("rgb", frames.get("depth", ""))
    target = frames.get("lidar", "lidar") if frame == "lidar" else frame
    bag = input_bag(run)
    T = preflight.inspect(bag, {}).static.lookup(camera, target, static_only=True)
    if T is None:
        raise CalibrationError(
            f"no transform from '{target}' to '{camera}' on /tf_static of {bag}; "
            "record it there, or export with --frame camera"
        )
    return T


def _trajectory(run: RunFolder, T_camera_frame: Float64) -> Trajectory:
    found = run.trajectory()
    return Trajectory(found.stamps_ns, found.poses @ T_camera_frame, found.scale)


def _tum(run: RunFolder, out: Path, T_camera_frame: Float64) -> list[Path]:
    write_tum(out / "trajectory.tum", _trajectory(run, T_camera_frame))
    return [out / "trajectory.tum"]


def _kitti(run: RunFolder, out: Path, T_camera_frame: Float64) -> list[Path]:
    write_kitti(out / "trajectory.kitti", _trajectory(run, T_camera_frame))
    return [out / "trajectory.kitti"]


def _euroc(run: RunFolder, out: Path, T_camera_frame: Float64) -> list[Path]:
    """The columns of EuRoC's state_groundtruth_estimate0/data.csv up to the quaternion (w first)."""
    trajectory = _trajectory(run, T_camera_frame)
    t, q = se3.to_quaternion(trajectory.poses)
    names = "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []"
    rows = np.hstack([t, q[:, 3:], q[:, :3]])
    lines = [f"{s}," + ",".join(f"{v:.9f}" for v in row) for s, row in zip(trajectory.stamps_ns.tolist(), rows)]
    (out / "trajectory.csv").write_text("\n".join([names, *lines]) + "\n")
    return [out / "trajectory.csv"]


def _ply(run: RunFolder, out: Path, _: Float64) -> list[Path]:
    """The coloured surface points, and the mesh where the run has one."""
    files = [p for p in (run.path / "surface.ply", run.path / "mesh.ply") if p.is_file()]
    if not files:
        raise FormatError(f"{run.path / 'surface.ply'} is missing: this line made no surface; run with --goal recon")
    return [Path(shutil.copy(file, out / file.name)) for file in files]


def _glb(run: RunFolder, out: Path, _: Float64) -> list[Path]:
    """The mesh with its vertex colours; glTF has y up and the map z up, so it is turned."""
    file = run.path / "mesh.ply"
    if not file.is_file():
        raise FormatError(f"{file} is missing: a GLB needs a mesh; run with --goal recon")
    import trimesh

    mesh = o3d.io.read_triangle_mesh(str(file))
    colours = (255 * np.asarray(mesh.vertex_colors)).round().astype(np.uint8) if mesh.has_vertex_colors() else None
    turned = np.asarray(mesh.vertices)[:, [0, 2, 1]] * (1, 1, -1)
    made = trimesh.Trimesh(turned, np.asarray(mesh.triangles), vertex_colors=colours, process=False)
    (out / "mesh.glb").write_bytes(made.export(file_type="glb"))
    return [out / "mesh.glb"]


def _depth(run: RunFolder, out: Path, _: Float64) -> list[Path]:
    """<stamp>.png (16 bit, mm, 0 = none or beyond 65.535 m) and <stamp>.npz (z, variance) of each keyframe."""
    folder, written = out / "depth", []
    for stamp, depth in run.depth_maps():
        folder.mkdir(exist_ok=True)
        millimetres = np.round(1000.0 * np.where(depth.valid, depth.z, 0.0))
        path = folder / f"{stamp:020d}.png"
        cv2.imwrite(str(path), np.where(millimetres <= 65535, millimetres, 0).astype(np.uint16))
        arrays = {"z": depth.z} if depth.variance is None else {"z": depth.z, "variance": depth.variance}
        np.savez_compressed(path.with_suffix(".npz"), **arrays)
        written += [path, path.with_suffix(".npz")]
    if not written:
        raise FormatError(f"{run.path / 'depth'} is empty: the line of this run made no depth")
    return written


Format = Callable[[RunFolder, Path, Float64], list[Path]]
FORMATS: dict[str, Format] = {
    "tum": _tum,
    "kitti": _kitti,
    "euroc": _euroc,
    "ply": _ply,
    "glb": _glb,
    "depth": _depth,
    "colmap": lambda run, out, _: export_colmap(run, out / "colmap"),
    "mvsnet": lambda run, out, _: export_mvsnet(run, out / "mvsnet"),
    "nerfstudio": lambda run, out, _: export_nerfstudio(run, out / "nerfstudio"),
}
