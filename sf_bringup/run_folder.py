"""The folder a run leaves behind: what lies where, and how to read it back."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from sf_interfaces import topics
from sf_interfaces.errors import FormatError
from sf_interfaces.geometry import se3
from sf_interfaces.io.bag import BagReader
from sf_interfaces.io.trajectory import read_tum
from sf_interfaces.ros.clouds import decode_cloud
from sf_interfaces.ros.messages import decode_camera_info, decode_depth, decode_pose, decode_variance, to_ns
from sf_interfaces.types import Camera, DepthMap, Float32, Scale, Trajectory


@dataclass(frozen=True, slots=True)
class RunFolder:
    """Paths and readers of one run."""

    path: Path

    @staticmethod
    def open(path: Path) -> RunFolder:
        """An existing run.

        Raises:
            FormatError: the folder holds no ``run.json``.
        """
        if not (path / "run.json").is_file():
            raise FormatError(f"{path} is not the output of a run (no run.json); give the --out folder of 'sf run'")
        return RunFolder(path)

    @property
    def result(self) -> Path:
        """The recorded messages."""
        return self.path / "result.mcap"

    @property
    def map(self) -> Path:
        """The neural points and colour field."""
        return self.path / "map.sfmap"

    def info(self) -> dict[str, Any]:
        """What was run: input, goal, engine, plan, topics, times."""
        loaded: dict[str, Any] = json.loads((self.path / "run.json").read_text())
        return loaded

    def timing(self) -> dict[str, dict[str, Any]] | None:
        """Stage -> seconds, calls, median_ms, each_ms; None where the run did not measure them."""
        path = self.path / "timing.json"
        return json.loads(path.read_text()) if path.is_file() else None

    @property
    def scale(self) -> Scale:
        """Metric where depth, a LiDAR or poses were given; images alone leave the unit of length open."""
        metric = {"depth", "lidar", "pose"} & self.info()["topics"].keys()
        return Scale.METRIC if metric else Scale.ARBITRARY

    def trajectory(self) -> Trajectory:
        """Final pose of every frame, T_map_camera.

        Raises:
            FormatError: the line of this run had no tracker.
        """
        return self._estimated("trajectory.tum")

    def keyframes(self) -> Trajectory:
        """Final pose of every keyframe, T_map_camera.

        Raises:
            FormatError: the line of this run had no tracker.
        """
        return self._estimated("keyframes.tum")

    def _estimated(self, name: str) -> Trajectory:
        path = self.path / name
        if not path.is_file():
            raise FormatError(f"{path} is missing: this run estimated no poses")
        return read_tum(path, self.scale)

    def keyframe_poses(self) -> Trajectory:
        """T_map_camera of every keyframe, estimated or given.

        Raises:
            FormatError: this run had neither.
        """
        if (self.path / "keyframes.tum").is_file():
            return self.keyframes()
        pairs = []
        with BagReader(self.result) as reader:
            if topics.KEYFRAME_POSE.name in reader.topics:
                for raw in reader.messages([topics.KEYFRAME_POSE.name]):
                    stamp, _, T = decode_pose(reader.decode(raw))
                    pairs.append((stamp, T))
        if not pairs:
            raise FormatError(f"{self.path} has no keyframe poses: this run estimated none and was given none")
        return Trajectory.from_pairs(pairs, self.scale)

    def landmarks(self) -> Float32:
        """Landmarks of all keyframes in the map, [N, 3] m, as their keyframes were sent.

        Raises:
            FormatError: the line of this run had no tracker.
        """
        found = [np.zeros((0, 3), np.float32)]
        poses = dict(zip((k := self.keyframe_poses()).stamps_ns.tolist(), k.poses, strict=True))
        with BagReader(self.result) as reader:
            if topics.KEYFRAME_LANDMARKS.name not in reader.topics:
                raise FormatError(f"{self.path} has no landmarks: this run estimated no poses")
            for raw in reader.messages([topics.KEYFRAME_LANDMARKS.name]):
                cloud = decode_cloud(reader.decode(raw))
                if (T := poses.get(cloud.stamp_ns)) is not None:
                    found.append(se3.transform(T, cloud.points).astype(np.float32))
        return np.concatenate(found)

    def depth_maps(self) -> Iterator[tuple[int, DepthMap]]:
        """Depth with variance of each keyframe, by stamp."""
        for path in sorted((self.path / "depth").glob("*.npz")):
            with np.load(path) as data:
                yield int(path.stem), DepthMap(data["z"], data.get("variance"), self.scale)

    def camera(self) -> Camera:
        """The camera of the run.

        Raises:
            FormatError: no keyframe was made, so there is none.
        """
        if not (self.path / "camera.yaml").is_file():
            raise FormatError(f"{self.path} has no camera.yaml: the run made no keyframe")
        values = yaml.safe_load((self.path / "camera.yaml").read_text())
        k = values["camera_matrix"]["data"]
        width, height = values["image_width"], values["image_height"]
        return Camera(width, height, k[0], k[4], k[2] + 0.5, k[5] + 0.5, values["camera_name"])


def write_camera(path: Path, camera: Camera) -> None:
    """Write intrinsics in the layout of ROS camera_calibration (pixel centres at integers there)."""
    k = [camera.fx, 0.0, camera.cx - 0.5, 0.0, camera.fy, camera.cy - 0.5, 0.0, 0.0, 1.0]
    document = {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_name": camera.frame_id,
        "camera_matrix": {"rows": 3, "cols": 3, "data": k},
        "distortion_model": "plumb_bob",
        "distortion_coefficients": {"rows": 1, "cols": 5, "data": [0.0] * 5},
        "rectification_matrix": {"rows": 3, "cols": 3, "data": np.eye(3).ravel().tolist()},
        "projection_matrix": {"rows": 3, "cols": 4, "data": [*k[:3], 0.0, *k[3:6], 0.0, *k[6:], 0.0]},
    }
    path.write_text(yaml.safe_dump(document, sort_keys=False))


def unpack(run: RunFolder) -> None:
    """Write ``depth/<stamp>.npz`` (z, variance) and ``camera.yaml`` from the recorded messages."""
    depth_topic, variance_topic = topics.DENSE_IMAGE.name, topics.DENSE_VARIANCE.name
    wanted = [depth_topic, variance_topic, topics.KEYFRAME_DEPTH.name, topics.KEYFRAME_INFO.name]
    maps: dict[str, dict[int, np.ndarray]] = {name: {} for name in wanted[:3]}
    camera: Camera | None = None
    with BagReader(run.result) as reader:
        wanted = [name for name in [*wanted, topics.DENSE_INFO.name] if name in reader.topics]
        for raw in reader.messages(wanted):
            message = reader.decode(raw)
            if raw.topic in maps:
                read = decode_variance if raw.topic == variance_topic else lambda m: decode_depth(m).z
                maps[raw.topic][to_ns(message.header.stamp)] = read(message)
            elif camera is None:
                camera, _ = decode_camera_info(message)
    if camera is not None:
        write_camera(run.path / "camera.yaml", camera)
    folder = run.path / "depth"
    folder.mkdir(exist_ok=True)
    for stamp, z in (maps[depth_topic] or maps[topics.KEYFRAME_DEPTH.name]).items():
        arrays = {"z": z}
        if stamp in maps[variance_topic]:
            arrays["variance"] = maps[variance_topic][stamp]
        np.savez_compressed(folder / f"{stamp:020d}.npz", **arrays)
