"""Everything that can be wrong with an input is found before a single process starts."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sf_bringup import discovery
from sf_bringup.discovery import InputMapping, Probe
from sf_interfaces import topics
from sf_interfaces.blocks import Quantity
from sf_interfaces.errors import CalibrationError, FormatError
from sf_interfaces.io.bag import BagReader, RawMessage
from sf_interfaces.ros.frames import FrameTree
from sf_interfaces.ros.messages import decode_tf


@dataclass(frozen=True, slots=True)
class BagInput:
    """A bag whose topics have found their roles."""

    bag: Path
    mapping: InputMapping
    frames: Mapping[str, str]  # role -> frame_id of its first message
    static: FrameTree
    transform_topics: tuple[str, ...]
    seconds: float
    leading_messages: int  # images, or depth images where there are none: the frames of the run


def _first(reader: BagReader, topic: str) -> RawMessage | None:
    return next(iter(reader.messages([topic])), None)


def _probe(reader: BagReader, topic: str) -> Probe | None:
    raw = _first(reader, topic)
    if raw is None:
        return None
    return discovery.probe(reader.decode(raw))


def static_frames(reader: BagReader) -> FrameTree:
    """How the sensors are mounted, as /tf_static of a bag says."""
    tree = FrameTree()
    if "/tf_static" in reader.topics:
        for raw in reader.messages(["/tf_static"]):
            for parent, child, stamp, T in decode_tf(reader.decode(raw)):
                tree.add(parent, child, T, stamp, static=True)
    return tree


def inspect(bag: Path, user: Mapping[str, str]) -> BagInput:
    """Read the topic list, probe what the types leave open, and choose the inputs.

    Raises:
        FormatError: the bag is missing, truncated beyond use, or holds nothing a line can start from.
        ConfigError: the user's mapping does not fit the bag.
    """
    with BagReader(bag) as reader:
        types = {name: info.type for name, info in reader.topics.items() if info.count}
        wanted = {*discovery.needs_probe(types), *user.values()} & set(types)
        probes = {name: p for name in sorted(wanted) if (p := _probe(reader, name)) is not None}
        mapping = discovery.discover(types, probes, user)
        if not mapping.roles:
            raise FormatError(
                f"{bag} has no image, depth, point cloud or pose to start from; its topics are "
                f"{', '.join(f'{n} ({k})' for n, k in sorted(types.items())) or 'none'}"
            )
        frames = {}
        for role, topic in mapping.roles.items():
            raw = _first(reader, topic)
            if raw is not None:
                frames[role] = reader.decode(raw).header.frame_id.lstrip("/")
        leader = mapping.roles.get("rgb") or mapping.roles.get("depth", "")
        count = reader.topics[leader].count if leader else 0
        seconds = (reader.end_ns - reader.start_ns) * 1e-9
        transforms = tuple(t for t in (topics.TF_STATIC.name, topics.TF.name) if t in reader.topics)
        return BagInput(bag, mapping, frames, static_frames(reader), transforms, seconds, count)


def check_extrinsic(given: BagInput) -> None:
    """The line uses the LiDAR: its place relative to the camera has to be known.

    Raises:
        CalibrationError: /tf_static does not connect the two frames. It is never taken as identity.
    """
    roles = given.mapping.roles
    if "lidar" not in roles or Quantity.SPARSE_DEPTH not in given.mapping.available:
        return
    camera, lidar = given.frames["rgb" if "rgb" in roles else "depth"], given.frames["lidar"]
    T = given.static.lookup(camera, lidar, static_only=True)
    if T is None or not np.isfinite(T).all():
        raise CalibrationError(
            f"no transform from '{lidar}' to '{camera}' on /tf_static of {given.bag}; "
            "record it there or pass --extrinsic FILE with T_camera_lidar as 4x4 numbers"
        )
