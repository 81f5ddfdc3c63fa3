"""A tiny finished run with known contents, written without running a line: a wall seen by three keyframes."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import open3d as o3d

from sf_bringup.run_folder import RunFolder, unpack
from sf_interfaces.geometry import se3
from sf_interfaces.io.sequence_writer import SequenceWriter
from sf_interfaces.io.trajectory import write_tum
from sf_interfaces.types import Camera, DepthMap, Keyframe, PointCloud, Trajectory

CAMERA = Camera(48, 36, 40.0, 41.0, 24.5, 17.5)
STAMPS = [1_000_000_000, 1_100_000_000, 1_200_000_000, 1_300_000_000, 1_400_000_000]
T_BASE_CAMERA = se3.exp(np.array([0.1, 0.0, 0.2, 0.0, np.pi / 2, 0.0]))
WALL, SIGMA = 2.0, 0.05  # m: z of the wall in the map, and the predicted deviation of depth


def poses() -> np.ndarray:
    """T_map_camera [5, 4, 4]: sideways along x with a little yaw, looking at the wall."""
    return np.array([se3.exp(np.array([0.05 * k, 0.01 * k, 0.0, 0.0, 0.02 * k, 0.0])) for k in range(5)])


def depth_of(T: np.ndarray) -> np.ndarray:
    """Exact depth [H, W] m of the wall."""
    rays = CAMERA.unproject(CAMERA.pixel_grid(), np.ones((CAMERA.height, CAMERA.width)))
    return (WALL - T[2, 3]) / (rays @ T[2, :3])


def image_of(T: np.ndarray) -> np.ndarray:
    """Colour of the wall: its own coordinates."""
    points = se3.transform(T, CAMERA.unproject(CAMERA.pixel_grid(), depth_of(T)))
    channels = [127 + 60 * np.sin(9 * points[..., 0]), 127 + 60 * np.cos(7 * points[..., 1]), 90 + 20 * points[..., 0]]
    return np.clip(np.stack(channels, -1), 0, 255).astype(np.uint8)


def make_run(root: Path) -> RunFolder:
    """Input bag with references and static frames, result, trajectories, surface and mesh; poses are exact."""
    from sf_bringup.result_writer import ResultWriter

    run = RunFolder(root / "run")
    run.path.mkdir(parents=True)
    bag, track = root / "input.mcap", Trajectory(np.array(STAMPS), poses())
    optical = CAMERA.frame_id
    with SequenceWriter(bag) as writer:
        writer.tf_static("base_link", optical, T_BASE_CAMERA, STAMPS[0])
        for stamp, T in zip(STAMPS, track.poses, strict=True):
            writer.image("/camera/color/image_raw", stamp, image_of(T), optical)
            writer.camera_info("/camera/color/camera_info", stamp, CAMERA)
            writer.depth("/camera/depth/image_raw", stamp, DepthMap(depth_of(T)), optical, "32FC1")
            writer.pose("/ground_truth/pose", stamp, T, "map")
            writer.depth("/ground_truth/depth/image", stamp, DepthMap(depth_of(T)), optical, "32FC1")
    keyframes = Trajectory(track.stamps_ns[::2], track.poses[::2])
    variance = np.full((CAMERA.height, CAMERA.width), SIGMA**2)
    with ResultWriter(SequenceWriter(run.result)) as results:
        for stamp, T in zip(keyframes.stamps_ns.tolist(), keyframes.poses, strict=True):
            keyframe = Keyframe(stamp, CAMERA, image_of(T), T, DepthMap(depth_of(T), variance))
            results.keyframe(keyframe)
            results.dense(keyframe)
    write_tum(run.path / "trajectory.tum", track)
    write_tum(run.path / "keyframes.tum", keyframes)
    facts = {
        "bag": str(bag), "engine": "inproc", "line": ["tracking", "recon"], "seconds": 1.0, "explanation": "",
        "topics": {"rgb": "/camera/color/image_raw", "depth": "/camera/depth/image_raw"},
        "frames": {"rgb": optical, "depth": optical},
    }  # fmt: skip
    (run.path / "run.json").write_text(json.dumps(facts))
    unpack(run)
    _write_surfaces(run)
    return run


def _write_surfaces(run: RunFolder) -> None:
    from sf_interfaces.io.cloud import write_surface

    x, y = (g.ravel() for g in np.meshgrid(np.linspace(-2, 2, 60), np.linspace(-0.8, 0.8, 50)))
    points = np.stack([x, y, np.full_like(x, WALL)], axis=1)
    colours = np.rint(127 * (points / (2, 0.8, WALL) + 1)).astype(np.uint8)
    write_surface(run.path / "surface.ply", PointCloud(points, colours))
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(points[[0, 59, 2999, 2940]]), o3d.utility.Vector3iVector([[0, 2, 1], [0, 3, 2]])
    )
    mesh.vertex_colors = o3d.utility.Vector3dVector(colours[[0, 59, 2999, 2940]] / 255)
    o3d.io.write_triangle_mesh(str(run.path / "mesh.ply"), mesh)
