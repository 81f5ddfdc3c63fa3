"""Posed keyframes as other programs read them: a COLMAP model, the MVSNet layout, nerfstudio's transforms.json."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from sf_bringup.run_folder import RunFolder
from sf_interfaces import topics
from sf_interfaces.errors import FormatError
from sf_interfaces.geometry import se3
from sf_interfaces.io.bag import BagReader
from sf_interfaces.ros.messages import decode_image, to_ns
from sf_interfaces.types import Camera, DepthMap, Float64, UInt8

MAX_POINTS = 20_000  # of a COLMAP model: sparse points guide view selection, the surface itself is the PLY
_SEEN_WITHIN = 0.02  # relative depth difference up to which a keyframe observes a point
_DEPTH_PLANES = 192  # MVSNet's usual number
_CV_TO_GL = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True, slots=True)
class View:
    """One keyframe: image, pose and depth where the run has it."""

    stamp_ns: int
    image: UInt8
    T_map_camera: Float64
    depth: DepthMap | None

    @property
    def name(self) -> str:
        return f"{self.stamp_ns:020d}.png"


def keyframe_views(run: RunFolder) -> list[View]:
    """The keyframes of a run in order of time.

    Raises:
        FormatError: it has no posed keyframe with an image.
    """
    poses = run.keyframe_poses()
    depths, images = dict(run.depth_maps()), {}
    with BagReader(run.result) as reader:
        if topics.KEYFRAME_IMAGE.name in reader.topics:
            for raw in reader.messages([topics.KEYFRAME_IMAGE.name]):
                message = reader.decode(raw)
                images[to_ns(message.header.stamp)] = decode_image(message)
    pairs = zip(poses.stamps_ns.tolist(), poses.poses, strict=True)
    views = [View(s, images[s], T, depths.get(s)) for s, T in pairs if s in images]
    if not views:
        raise FormatError(f"{run.result} holds no posed keyframe; views need the poses and images of a run")
    return views


def _write_images(views: list[View], folder: Path) -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    for view in views:
        image = view.image if view.image.ndim == 2 else cv2.cvtColor(view.image, cv2.COLOR_RGB2BGR)
        cv2.imwrite(str(folder / view.name), image)
    return [folder / view.name for view in views]


def _sparse_points(run: RunFolder) -> tuple[Float64, UInt8]:
    """At most ``MAX_POINTS`` surface points [N, 3] m with colour [N, 3], evenly chosen; none without a surface."""
    file = run.path / "surface.ply"
    if not file.is_file():
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    cloud = o3d.io.read_point_cloud(str(file))
    points = np.asarray(cloud.points)
    chosen = np.linspace(0, len(points) - 1, min(MAX_POINTS, len(points))).astype(int)
    colours = np.asarray(cloud.colors) if cloud.has_colors() else np.full_like(points, 0.5)
    return points[chosen], np.rint(255 * colours[chosen]).astype(np.uint8)


def _observed(camera: Camera, view: View, points: Float64) -> tuple[NDArray[np.int64], Float64]:
    """Indices of the points that a view's depth map agrees on, and their pixels [M, 2]."""
    if view.depth is None:
        return np.zeros(0, np.int64), np.zeros((0, 2))
    uv, z = camera.project(se3.transform(se3.inverse(view.T_map_camera), points))
    inside = np.flatnonzero((z > 0) & (uv >= 0).all(1) & (uv < (camera.width, camera.height)).all(1))
    col, row = np.floor(uv[inside]).astype(int).T
    agree = np.abs(view.depth.z[row, col] - z[inside]) < _SEEN_WITHIN * z[inside]
    return inside[agree], uv[inside[agree]]


def export_colmap(run: RunFolder, out: Path) -> list[Path]:
    """``images/`` and ``sparse/0/{cameras,images,points3D}.txt``; COLMAP's pixel convention is ours.

    A point's track holds the keyframes whose depth agrees with it; points that one keyframe alone sees are left out.
    """
    views, camera = keyframe_views(run), run.camera()
    points, colours = _sparse_points(run)
    folder = out / "sparse" / "0"
    folder.mkdir(parents=True, exist_ok=True)
    intrinsics = f"{camera.width} {camera.height} {camera.fx} {camera.fy} {camera.cx} {camera.cy}"
    (folder / "cameras.txt").write_text(f"# CAMERA_ID MODEL WIDTH HEIGHT FX FY CX CY\n1 PINHOLE {intrinsics}\n")
    observed = [_observed(camera, view, points) for view in views]
    often = np.bincount(np.concatenate([index for index, _ in observed]), minlength=len(points)) > 1
    tracks: list[list[str]] = [[] for _ in points]
    lines = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then POINTS2D as X Y POINT3D_ID"]
    for number, (view, (index, uv)) in enumerate(zip(views, observed, strict=True), 1):
        t, q = se3.to_quaternion(se3.inverse(view.T_map_camera))
        pose = " ".join(f"{v:.12g}" for v in (q[3], *q[:3], *t))
        kept = often[index]
        for k, point in enumerate(index[kept].tolist()):
            tracks[point].append(f"{number} {k}")
        seen = " ".join(f"{u:.3f} {v:.3f} {i + 1}" for i, (u, v) in zip(index[kept].tolist(), uv[kept], strict=True))
        lines += [f"{number} {pose} 1 {view.name}", seen]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    rows = ["# POINT3D_ID X Y Z R G B ERROR TRACK as IMAGE_ID POINT2D_IDX"]
    for number, (p, c, track) in enumerate(zip(points, colours, tracks, strict=True), 1):
        if track or not often.any():  # without depth nothing says which view sees a point
            position = " ".join(f"{v:.6f}" for v in p)
            rows.append(f"{number} {position} {c[0]} {c[1]} {c[2]} 0 " + " ".join(track))
    (folder / "points3D.txt").write_text("\n".join(rows) + "\n")
    _write_images(views, out / "images")
    return [out]


def export_mvsnet(run: RunFolder, out: Path) -> list[Path]:
    """``images/``, ``cams/*_cam.txt`` (T_camera_map, K, depth range) and ``pair.txt`` (sources by shared view)."""
    views, camera = keyframe_views(run), run.camera()
    _write_images(views, out / "images")
    (out / "cams").mkdir(exist_ok=True)
    K = camera.K
    K[:2, 2] -= 0.5  # MVSNet's pixel centres lie at integers
    for view in views:
        low, high = _depth_range(view)
        extrinsic, intrinsic = ("\n".join(" ".join(f"{v:.9g}" for v in row) for row in M)
                                for M in (se3.inverse(view.T_map_camera), K))  # fmt: skip
        step = (high - low) / (_DEPTH_PLANES - 1)
        text = f"extrinsic\n{extrinsic}\n\nintrinsic\n{intrinsic}\n\n{low:.6g} {step:.6g} {_DEPTH_PLANES} {high:.6g}\n"
        (out / "cams" / f"{view.stamp_ns:020d}_cam.txt").write_text(text)
    (out / "pair.txt").write_text(_pairs(views))
    return [out]


def _depth_range(view: View) -> tuple[float, float]:
    """Depths between which 98 % of the view's pixels lie, with a margin.

    Raises:
        FormatError: the view has no depth, so there is no range to state.
    """
    if view.depth is None or not view.depth.valid.any():
        raise FormatError(f"keyframe {view.stamp_ns} has no depth: the MVSNet layout needs a depth range")
    low, high = np.percentile(view.depth.z[view.depth.valid], (1, 99))
    return 0.9 * float(low), 1.1 * float(high)


def _pairs(views: list[View], most: int = 10) -> str:
    """Source views of each view, best first: near in position and with almost the same viewing direction."""
    centres = np.array([v.T_map_camera[:3, 3] for v in views])
    ahead = np.array([v.T_map_camera[:3, 2] for v in views])
    distance = np.linalg.norm(centres[:, None] - centres, axis=2)
    score = (ahead @ ahead.T).clip(0) / (1 + distance)
    np.fill_diagonal(score, -1)
    lines = [str(len(views))]
    for k, row in enumerate(score):
        order = np.argsort(-row, kind="stable")[: min(most, len(views) - 1)]
        lines += [str(k), f"{len(order)} " + " ".join(f"{i} {row[i]:.4f}" for i in order)]
    return "\n".join(lines) + "\n"


def export_nerfstudio(run: RunFolder, out: Path) -> list[Path]:
    """``images/``, ``depths/`` (mm) and ``transforms.json`` with OpenGL camera axes (x right, y up, z back)."""
    views, camera = keyframe_views(run), run.camera()
    _write_images(views, out / "images")
    frames = []
    for view in views:
        frame = {
            "file_path": f"images/{view.name}",
            "transform_matrix": (view.T_map_camera @ _CV_TO_GL).tolist(),
        }
        if view.depth is not None:
            (out / "depths").mkdir(exist_ok=True)
            millimetres = np.nan_to_num(1000.0 * view.depth.z).clip(0, 65535).astype(np.uint16)
            cv2.imwrite(str(out / "depths" / view.name), millimetres)
            frame["depth_file_path"] = f"depths/{view.name}"
        frames.append(frame)
    document = {
        "camera_model": "OPENCV",
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "frames": frames,
    }
    (out / "transforms.json").write_text(json.dumps(document, indent=1) + "\n")
    return [out]
