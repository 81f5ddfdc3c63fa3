"""From whatever the user points at to one bag that both engines play: data sets are converted first."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

from sf_bringup.progress import Progress
from sf_interfaces import topics
from sf_interfaces.errors import CalibrationError, FormatError
from sf_interfaces.geometry.undistort import Distortion
from sf_interfaces.io import datasets
from sf_interfaces.io.atomic import replace_file
from sf_interfaces.io.bag import BagReader, RawMessage, is_bag
from sf_interfaces.io.datasets import ReadOptions, Written
from sf_interfaces.io.sequence_writer import SHUTTER, SequenceWriter
from sf_interfaces.io.trajectory import read_tum
from sf_interfaces.types import Camera, Float64

PROBE = 3  # frames of a data set (messages per topic of a bag) that tell what a line would get


def convert(dataset: Path, out: Path, options: ReadOptions) -> tuple[Written, dict[str, int]]:
    """Write a data set as one mcap bag; returns what became of it and messages per topic.

    The file gets its name only when it is whole.

    Raises:
        SceneFactoryError: no such folder, its layout is not known, or a file of it is bad.
    """
    if out.suffix != ".mcap":
        raise FormatError(f"cannot write {out}: the bag must end in .mcap")
    recognised = datasets.recognise(dataset, options.depth_scale)
    with (
        replace_file(out) as unfinished,
        SequenceWriter(unfinished) as writer,
        Progress("reading", "frames") as progress,
    ):
        written = datasets.write(recognised, writer, options, progress.update)
    with BagReader(out) as reader:
        return written, {name: info.count for name, info in sorted(reader.topics.items())}


@dataclass(frozen=True, slots=True)
class Resolved:
    """The bag to play, how it was read (one sentence each), and the goal that suits it (``auto``: any)."""

    bag: Path
    notes: tuple[str, ...] = ()
    goal: str = "auto"


def resolve(inputs: tuple[Path, ...], out: Path, options: ReadOptions) -> Resolved:
    """The bag to play: the input itself, or the data set converted to ``out/input.mcap``.

    Raises:
        SceneFactoryError: nothing there, several inputs, an unknown layout, or a bad file.
    """
    if len(inputs) != 1:
        raise FormatError(f"give exactly one input, got {len(inputs)}: {', '.join(map(str, inputs))}")
    path = inputs[0]
    if not path.exists():
        raise FormatError(f"{path} does not exist; give a bag, a data set folder, a folder of photos or a video")
    if is_bag(path):
        return Resolved(path)
    converted = out / "input.mcap"
    written, _ = convert(path, converted, options)
    notes = written.sentences()
    if written.goal != "auto":
        notes.append(f"{written.dataset}: frames have no order in time; without --goal they get {written.goal}")
    return Resolved(converted, tuple(notes), written.goal)


def readout_of(bag: Path) -> float:
    """s from the first to the last row of its images, where the bag says so; else 0.

    Raises:
        FormatError: what it says is no number.
    """
    with BagReader(bag) as reader:
        said = reader.metadata().get(SHUTTER, {}).get("readout_s", "0")
    try:
        return float(said)
    except ValueError as error:
        raise FormatError(
            f"{bag}: metadata '{SHUTTER}' has readout_s '{said}', which is no number of seconds"
        ) from error


def with_given(
    bag: Path,
    out: Path,
    *,
    image_topic: str,
    camera: Camera | None,
    distortion: Distortion | None = None,
    poses: Path | None,
    extrinsic: tuple[str, str, Float64] | None,
    limit: int | None = None,
) -> Path:
    """A copy of the bag that also carries what the user gave beside it, so that every engine sees the same.

    Args:
        image_topic: the stream that ``camera`` belongs to.
        camera, distortion: published beside every image on the image's namespace, replacing camera_info there.
        poses: TUM file, published as /sf/pose.
        extrinsic: (camera frame, lidar frame, T_camera_lidar), published on /tf_static.
        limit: copy only the first so many messages of each topic.

    Returns:
        The new bag ``out/input_with_given.mcap``, or ``bag`` itself when nothing was given.

    Raises:
        CalibrationError: the images are not of the size of the given camera.
        FormatError: the poses cannot be read.
    """
    if camera is None and poses is None and extrinsic is None:
        return bag
    target = out / "input_with_given.mcap"
    info_topic = image_topic.rsplit("/", 1)[0] + "/camera_info"
    with replace_file(target) as unfinished, BagReader(bag) as reader, SequenceWriter(unfinished) as writer:
        if extrinsic is not None:
            writer.tf_static(*extrinsic, stamp_ns=reader.start_ns)
        if poses is not None:
            trajectory = read_tum(poses)
            for stamp, T in zip(trajectory.stamps_ns.tolist(), trajectory.poses, strict=True):
                writer.pose(topics.GIVEN_POSE.name, stamp, T, "map")
        for raw in _messages(reader, limit):
            if camera is not None and raw.topic == info_topic:
                continue
            writer.bag.write(raw.topic, raw.type, raw.stamp_ns, raw.data)
            if camera is not None and raw.topic == image_topic:
                own = _of_stream(camera, reader.decode(raw), bag)
                writer.camera_info(info_topic, raw.stamp_ns, own, distortion)
    return target


def _messages(reader: BagReader, limit: int | None) -> Iterator[RawMessage]:
    if limit is None:
        yield from reader.messages()
    else:
        for topic in sorted(reader.topics):
            yield from islice(reader.messages([topic]), limit)


def _of_stream(camera: Camera, image: Any, bag: Path) -> Camera:
    """The given camera in the frame of an image message, whose size it must have (a compressed one does not say)."""
    expected = camera.width, camera.height
    width, height = getattr(image, "width", expected[0]), getattr(image, "height", expected[1])
    if (width, height) != expected:
        raise CalibrationError(
            f"--calibration is for {camera.width}x{camera.height}, but the images of {bag} are {width}x{height}; "
            "give the calibration that belongs to this stream"
        )
    return replace(camera, frame_id=image.header.frame_id.lstrip("/"))
