"""Some tens of depth images of a recording with the colour images around each, spread evenly over it.

Nothing but what is asked for is decoded, and no more than a few messages are in memory at a time.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sf_bringup import discovery, preflight
from sf_bringup.preflight import BagInput
from sf_interfaces.errors import CalibrationError, FormatError
from sf_interfaces.geometry.edge_views import Shot
from sf_interfaces.geometry.undistort import Distortion, undistort_depth, undistort_image
from sf_interfaces.io import datasets
from sf_interfaces.io.bag import BagReader, RawMessage, is_bag
from sf_interfaces.io.datasets import Dataset, Reader
from sf_interfaces.ros.messages import decode_camera_info, decode_depth, decode_image, to_ns
from sf_interfaces.types import Camera, DepthMap, Float64

_DEPTH_SLOP_NS = 100_000_000  # how far the stamp of a depth image may be from that of the colour image
_KEPT = 20  # depth messages that wait for their colour image


@dataclass(frozen=True, slots=True)
class Mounting:
    """The two cameras and ``T_color_depth`` as the recording claims them.

    Args:
        registered: depth is in the colour camera already, so that both are one.
    """

    color: Camera
    depth: Camera
    T_color_depth: Float64
    registered: bool


class Unchecked(Exception):
    """There is nothing to check, or not enough; says why in words."""


def recorded_shots(recording: Path, count: int) -> tuple[Mounting, Iterator[Shot]]:
    """How the cameras are mounted, and the shots.

    Raises:
        Unchecked: no depth, no colour, no calibration, or too few frames.
        SceneFactoryError: the recording cannot be read, or it does not say how its cameras are mounted.
    """
    return _of_bag(recording, count) if is_bag(recording) else _of_dataset(datasets.recognise(recording), count)


def _spread(frames: int, count: int) -> list[int]:
    """Numbers of frames that have one before and one after."""
    if frames < 3:
        raise Unchecked(f"{frames} frames are too few")
    return np.unique(np.linspace(1, frames - 2, min(count, frames - 2)).round().astype(int)).tolist()


# ---- data sets


def _of_dataset(dataset: Dataset, count: int) -> tuple[Mounting, Iterator[Shot]]:
    if dataset.goal != "auto":
        raise Unchecked(f"the frames of {dataset.name} have no order in time")
    readers = list(dataset.samples())
    chosen = _spread(len(readers), count)
    first = readers[chosen[0]]()
    if first.depth is None:
        raise Unchecked(f"{dataset.name}: no depth images")
    if first.camera is None:
        raise Unchecked(f"{dataset.name}: no calibration")
    mounting = Mounting(first.camera, first.camera, np.eye(4), True)
    return mounting, _dataset_shots(readers, chosen)


def _dataset_shots(readers: list[Reader], chosen: list[int]) -> Iterator[Shot]:
    for k in chosen:
        before, at, after = (readers[j]().undistorted() for j in (k - 1, k, k + 1))
        if at.depth is None or at.camera is None:
            continue
        stamp = at.stamp_ns if at.depth_ns is None else at.depth_ns
        stamps = (before.stamp_ns, at.stamp_ns, after.stamp_ns)
        yield Shot(stamps, (before.image, at.image, after.image), at.depth, stamp)


# ---- bags


def _of_bag(bag: Path, count: int) -> tuple[Mounting, Iterator[Shot]]:
    given = preflight.inspect(bag, {})
    for role, words in (("rgb", "colour"), ("depth", "depth")):
        if role not in given.mapping.roles:
            raise Unchecked(f"no {words} images")
    if "camera_info" not in given.mapping.roles:
        raise Unchecked("no camera_info of the colour images")
    cameras = _cameras(given)
    mounting = Mounting(cameras[0][0], cameras[1][0], _extrinsic(given), _registered(given))
    return mounting, _bag_shots(given, cameras, count)


Calibrated = tuple[Camera, Distortion | None]


def _registered(given: BagInput) -> bool:
    return given.frames["rgb"] == given.frames["depth"]


def _cameras(given: BagInput) -> tuple[Calibrated, Calibrated]:
    """Of colour and of depth."""
    own = given.mapping.roles["camera_info"]
    of_depth = own
    if not _registered(given):
        of_depth = discovery.namespace(given.mapping.roles["depth"]) + "/camera_info"
    with BagReader(given.bag) as reader:
        if of_depth not in reader.topics:
            raise CalibrationError(
                f"depth is in frame '{given.frames['depth']}', colour in '{given.frames['rgb']}', and {given.bag} has "
                f"no {of_depth}: record it, or let the driver register depth to colour"
            )
        color, depth = (decode_camera_info(reader.decode(next(iter(reader.messages([n]))))) for n in (own, of_depth))
    return color, depth


def _extrinsic(given: BagInput) -> Float64:
    if _registered(given):
        return np.eye(4)
    T = given.static.lookup(given.frames["rgb"], given.frames["depth"], static_only=True)
    if T is None:
        raise CalibrationError(
            f"/tf_static of {given.bag} does not connect '{given.frames['depth']}' to '{given.frames['rgb']}': record "
            "it, or let the driver register depth to colour"
        )
    return T


def _bag_shots(given: BagInput, cameras: tuple[Calibrated, Calibrated], count: int) -> Iterator[Shot]:
    image_topic, depth_topic = given.mapping.roles["rgb"], given.mapping.roles["depth"]
    with BagReader(given.bag) as reader:
        chosen = set(_spread(reader.topics[image_topic].count, count))
        images: deque[RawMessage] = deque(maxlen=4)
        depths: deque[RawMessage] = deque(maxlen=_KEPT)
        number = -1  # of the image last read
        for raw in reader.messages([image_topic, depth_topic]):
            if raw.topic == depth_topic:
                depths.append(raw)
                continue
            images.append(raw)
            number += 1
            # One image later than needed: the depth image may come behind its colour image.
            if number - 2 in chosen and len(images) == 4:
                yield from _shot(reader, list(images)[:3], depths, cameras)
        if number - 1 in chosen:
            yield from _shot(reader, list(images)[-3:], depths, cameras)


def _shot(
    reader: BagReader, raw_images: list[RawMessage], depths: deque[RawMessage], cameras: tuple[Calibrated, Calibrated]
) -> Iterator[Shot]:
    messages = [reader.decode(raw) for raw in raw_images]
    stamps = [to_ns(m.header.stamp) for m in messages]
    near = [reader.decode(raw) for raw in depths]
    if not near or not stamps[0] < stamps[1] < stamps[2]:
        return

    def apart(message: Any) -> int:
        return abs(to_ns(message.header.stamp) - stamps[1])

    nearest = min(near, key=apart)
    if apart(nearest) > _DEPTH_SLOP_NS:
        return
    (color, lens), (camera, depth_lens) = cameras
    images = [undistort_image(decode_image(m), color, lens) for m in messages]
    depth = undistort_depth(decode_depth(nearest), camera, depth_lens)
    _check_size(depth, camera)
    yield Shot((stamps[0], stamps[1], stamps[2]), (images[0], images[1], images[2]), depth, to_ns(nearest.header.stamp))


def _check_size(depth: DepthMap, camera: Camera) -> None:
    height, width = depth.z.shape
    if (width, height) != (camera.width, camera.height):
        raise FormatError(
            f"depth is {width}x{height}, its camera {camera.width}x{camera.height}; "
            "record the camera_info that belongs to it"
        )
