"""Writes a simulated recording with its exact ground truth as a bag."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import open3d as o3d

from sf_bringup.simulate.render import Renderer
from sf_bringup.simulate.scenes import SCENES
from sf_bringup.simulate.sensors import LIDARS, SWEEP_PHASE, lidar_sweep, structured_light, time_of_flight
from sf_bringup.simulate.spec import SimulationSpec
from sf_bringup.simulate.trajectories import CameraPath, oval
from sf_interfaces.errors import ConfigError, FormatError
from sf_interfaces.geometry import se3
from sf_interfaces.io.sequence_writer import SequenceWriter
from sf_interfaces.types import DepthMap, Float32, Float64, PointCloud, UInt8

START_NS = 1_000_000_000_000
_SKY = 1e4  # m
_MOST = 90.0  # percent of the pixels
_BAND = 4  # rows that are read at the same time
_PARTS = ((-0.25, -0.25), (0.25, 0.25), (-0.25, 0.25), (0.25, -0.25))  # px, of a pixel's four quarters
OPTICAL, LIDAR = "camera_optical_frame", "lidar"
T_BASE_CAMERA_LINK = se3.exp(np.array([0.05, 0.0, 0.0, 0, 0, 0]))
T_BASE_LIDAR = se3.exp(np.array([0.0, 0.02, 0.09, 0, 0, 0]))
T_LINK_OPTICAL = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])
T_CAMERA_LIDAR = se3.inverse(T_BASE_CAMERA_LINK @ T_LINK_OPTICAL) @ T_BASE_LIDAR


@dataclass(frozen=True)
class SimulationSummary:
    """What was written and how long it took."""

    path: Path
    frames: int
    sweeps: int
    duration_s: float
    wall_s: float


class Simulator:
    """The scene, path and sensors of one specification; arrays out, no files."""

    def __init__(self, spec: SimulationSpec) -> None:
        self.spec = spec
        if spec.scene.endswith(".world"):
            from sf_bringup.simulate.world import load_world

            scene = load_world(Path(spec.scene))
        elif spec.scene in SCENES:
            scene = SCENES[spec.scene](spec.seed)
        else:
            raise ConfigError(f"scene '{spec.scene}' is unknown; choose a .world file or {', '.join(SCENES)}")
        self.renderer = Renderer(scene)
        self.path: CameraPath = oval(spec.path_plan, spec.seed)

    def frame(self, index: int) -> tuple[np.ndarray, Float32, Float64]:
        """Image, exact depth and T_map_camera of one frame."""
        T = self.path.pose(index / self.spec.fps)
        image, z = self.renderer.render(self.spec.camera, T, 1 if self.spec.blur else self.spec.supersampling)
        if self.spec.blur:
            image = self._exposed(index / self.spec.fps, z)
        elif self.spec.readout:
            image = self._rolled(index / self.spec.fps)
        rng = np.random.default_rng([self.spec.seed, 1, index])
        if self.spec.image_noise:
            noise = rng.standard_normal(image.shape, dtype=np.float32) * np.float32(self.spec.image_noise)
            image = np.clip(image + noise + 0.5, 0, 255).astype(np.uint8)
        return image, z, T

    def _exposed(self, middle: float, z: Float32) -> UInt8:
        """Mean of the images during an exposure round ``middle`` s, each through another part of the pixels.

        So many that from one to the next most pixels move by one or less.

        Args:
            z: depth at the middle, m.
        """
        spec, camera = self.spec, self.spec.camera
        first, last = self.path.pose(middle + np.array([-0.5, 0.5]) * spec.blur)
        grid = camera.pixel_grid()[::8, ::8].reshape(-1, 2)
        points = camera.unproject(grid, np.nan_to_num(z[::8, ::8], nan=_SKY).ravel().astype(np.float64))
        seen, _ = camera.project(se3.transform(se3.inverse(last) @ first, points))
        moved = float(np.nanpercentile(np.linalg.norm(seen - grid, axis=1), _MOST))
        count = len(_PARTS) * max(1, int(np.ceil(moved / len(_PARTS))))
        total = np.zeros((spec.height, spec.width, 3))
        for k in range(count):
            du, dv = _PARTS[k % len(_PARTS)]
            through = replace(camera, cx=camera.cx - du, cy=camera.cy - dv)
            T = self.path.pose(middle + ((k + 0.5) / count - 0.5) * spec.blur)
            total += self.renderer.render(through, T, 1)[0]
        return np.asarray(np.round(total / count), np.uint8)

    def _rolled(self, middle: float) -> UInt8:
        """The image of a rolling shutter that reads the row of the principal point at ``middle`` s."""
        spec, camera, bands = self.spec, self.spec.camera, []
        for first in range(0, spec.height, _BAND):
            rows = min(_BAND, spec.height - first)
            late = (first + rows / 2 - camera.cy) / spec.height * spec.readout
            band = replace(camera, height=rows, cy=camera.cy - first)
            bands.append(self.renderer.render(band, self.path.pose(middle + late), spec.supersampling)[0])
        return np.concatenate(bands)

    def novel_pose(self, index: int) -> Float64:
        """T_map_camera of a view off the path: up to half the free distance away, turned by up to 20 degrees."""
        T = self.path.pose(index / self.spec.fps)
        rng = np.random.default_rng([self.spec.seed, 4, index])
        reach = 0.5 * float(self.renderer.clearance(T[None, :3, 3])[0])
        direction = rng.standard_normal(3)
        offset = reach * rng.uniform(0.5, 1.0) * direction / np.linalg.norm(direction)
        turn = np.radians(rng.uniform(-20, 20, 3)) * (0.5, 1.0, 0.25)  # pitch, yaw, roll
        return T @ se3.exp(np.concatenate([offset, turn]))

    def sensor_depth(self, index: int, z: Float32) -> Float32:
        """The depth sensor's reading of exact depth ``z``."""
        rng = np.random.default_rng([self.spec.seed, 2, index])
        if self.spec.depth == "structured_light":
            return structured_light(z, self.spec.focal, rng)
        return time_of_flight(z, rng) if self.spec.depth == "tof" else z

    def sweep(self, index: int) -> tuple[PointCloud, Float32]:
        """Sweep number ``index``, stamped at its start, which lies 0.4 periods before its forward look."""
        period = 1 / self.spec.lidar_hz
        start = (index - SWEEP_PHASE) * period
        rng = np.random.default_rng([self.spec.seed, 3, index])
        cloud, intensity = lidar_sweep(
            self.renderer,
            LIDARS[self.spec.lidar],
            lambda t: self.path.pose(t) @ T_CAMERA_LIDAR,
            start,
            index,
            period,
            self.spec.lidar_fov_deg,
            rng,
        )
        stamp = START_NS + round(start * 1e9)
        return PointCloud(cloud.points, None, cloud.time_offset_ns, stamp, LIDAR), intensity


def simulate(
    spec: SimulationSpec,
    out: Path,
    progress: Callable[[int, int], None] | None = None,
    mesh: Path | None = None,
) -> SimulationSummary:
    """Write the recording of ``spec`` to the bag ``out``; ``progress`` gets (frames done, frames).

    Args:
        mesh: also write the true surface there, see :func:`write_mesh`.
    """
    begun = time.perf_counter()
    simulator = Simulator(spec)
    if mesh is not None:
        write_mesh(simulator, mesh)
    sweeps = 0
    novel = set(np.linspace(0, spec.frames - 1, spec.novel_views + 2).astype(int)[1:-1].tolist())
    with SequenceWriter(out) as writer:
        if spec.readout:
            writer.shutter(spec.readout)
        first = START_NS - round(1e9 / spec.lidar_hz)
        writer.tf_static("base_link", "camera_link", T_BASE_CAMERA_LINK, first)
        writer.tf_static("camera_link", OPTICAL, T_LINK_OPTICAL, first)
        if spec.lidar != "none":
            writer.tf_static("base_link", LIDAR, T_BASE_LIDAR, first)
        for k in range(spec.frames):
            # sweeps that start up to this image; the last image also gets its own sweep
            while spec.lidar != "none" and (sweeps - SWEEP_PHASE) / spec.lidar_hz <= k / spec.fps:
                writer.cloud("/lidar/points", *simulator.sweep(sweeps))
                sweeps += 1
            _write_frame(writer, simulator, k)
            if k in novel:
                _write_novel(writer, simulator, k)
            if progress is not None:
                progress(k + 1, spec.frames)
    return SimulationSummary(out, spec.frames, sweeps, spec.frames / spec.fps, time.perf_counter() - begun)


def write_mesh(simulator: Simulator, path: Path) -> int:
    """Write the scene's triangles as PLY, in the map frame of the recording; returns how many.

    Raises:
        FormatError: the file cannot be written.
    """
    corners = simulator.renderer.scene.corners.reshape(-1, 3).astype(np.float64)
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(corners), o3d.utility.Vector3iVector(np.arange(len(corners)).reshape(-1, 3))
    )
    mesh.remove_duplicated_vertices()
    path.parent.mkdir(parents=True, exist_ok=True)
    if not o3d.io.write_triangle_mesh(str(path), mesh):
        raise FormatError(f"cannot write {path}; give the name of a .ply file in a folder that can be written")
    return len(mesh.triangles)


def _write_novel(writer: SequenceWriter, simulator: Simulator, index: int) -> None:
    stamp = START_NS + round(index / simulator.spec.fps * 1e9)
    T = simulator.novel_pose(index)
    image, _ = simulator.renderer.render(simulator.spec.camera, T, simulator.spec.supersampling)
    writer.image("/ground_truth/novel/image", stamp, image, OPTICAL)
    writer.pose("/ground_truth/novel/pose", stamp, T, "map")


def _write_frame(writer: SequenceWriter, simulator: Simulator, index: int) -> None:
    spec = simulator.spec
    stamp = START_NS + round(index / spec.fps * 1e9)
    image, z, T = simulator.frame(index)
    if spec.rgb:
        writer.image("/camera/color/image_raw", stamp, image, OPTICAL)
    writer.camera_info("/camera/color/camera_info", stamp, spec.camera)
    if spec.depth != "none":
        encoding = "32FC1" if spec.depth == "exact" else "16UC1"
        depth = DepthMap(simulator.sensor_depth(index, z))
        writer.depth("/camera/depth/image_raw", stamp, depth, OPTICAL, encoding)
    writer.pose("/ground_truth/pose", stamp, T, "map")
    if spec.ground_truth_depth:
        writer.depth("/ground_truth/depth/image", stamp, DepthMap(z), OPTICAL, "32FC1")
