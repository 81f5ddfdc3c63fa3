"""From whatever the user points at to one bag that both engines play: data sets are converted first."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import numpy as np
import yaml

from sf_interfaces.errors import CalibrationError, FormatError
from sf_interfaces.io.bag import BagReader, is_bag
from sf_interfaces.io.datasets import recognise
from sf_interfaces.io.sequence_writer import SequenceWriter
from sf_interfaces.io.trajectory import read_tum
from sf_interfaces.types import Camera, Float64, check_pose


def convert(dataset: Path, out: Path) -> dict[str, int]:
    """Write a data set folder as one mcap bag; returns messages per topic.

    Raises:
        FormatError: no such folder, or its layout is not known.
    """
    if not dataset.exists():
        raise FormatError(f"{dataset} does not exist; give a bag file or a data set folder")
    recognised = recognise(dataset)
    out.parent.mkdir(parents=True, exist_ok=True)
    with SequenceWriter(out) as writer:
        recognised.write(writer)
    with BagReader(out) as reader:
        return {name: info.count for name, info in sorted(reader.topics.items())}


def resolve(inputs: tuple[Path, ...], out: Path) -> Path:
    """The bag to play: the input itself, or the data set converted to ``out/input.mcap``.

    Raises:
        FormatError: nothing there, several inputs, or an unknown layout.
    """
    if len(inputs) != 1:
        raise FormatError(f"give exactly one input, got {len(inputs)}: {', '.join(map(str, inputs))}")
    path = inputs[0]
    if not path.exists():
        raise FormatError(f"{path} does not exist; give a bag file or a data set folder")
    if is_bag(path):
        return path
    converted = out / "input.mcap"
    convert(path, converted)
    return converted


def read_camera(path: Path) -> Camera:
    """Intrinsics from a YAML file in ROS camera_calibration format, without distortion.

    Raises:
        CalibrationError: unreadable, a key is missing, or the camera has distortion.
    """
    try:
        values = yaml.safe_load(path.read_text())
        k = [float(v) for v in values["camera_matrix"]["data"]]
        distortion = values.get("distortion_coefficients", {}).get("data", [])
        if np.any(np.asarray(distortion, dtype=np.float64) != 0):
            raise CalibrationError(
                f"{path} has distortion; record it in the bag's camera_info, where images are undistorted"
            )
        name = str(values.get("camera_name", "camera_optical_frame"))
        size = int(values["image_width"]), int(values["image_height"])
        return Camera(*size, k[0], k[4], k[2] + 0.5, k[5] + 0.5, name)
    except (OSError, yaml.YAMLError, KeyError, TypeError, IndexError, ValueError) as error:
        raise CalibrationError(
            f"cannot read calibration {path} ({error!r}); it needs image_width, image_height and camera_matrix.data"
        ) from error


def read_extrinsic(path: Path) -> Float64:
    """T_camera_lidar [4, 4] from a text file of 4x4 numbers.

    Raises:
        CalibrationError: unreadable or not a rigid motion.
    """
    try:
        return check_pose(np.loadtxt(path), f"extrinsic {path}")
    except (OSError, ValueError, FormatError) as error:
        raise CalibrationError(f"cannot read T_camera_lidar from {path}: {error}; give 4 rows of 4 numbers") from error


def with_given(
    bag: Path,
    out: Path,
    *,
    image_topic: str,
    camera: Camera | None,
    poses: Path | None,
    extrinsic: tuple[str, str, Float64] | None,
) -> Path:
    """A copy of the bag that also carries what the user gave beside it, so that every engine sees the same.

    Args:
        image_topic: the stream that ``camera`` belongs to.
        camera: published beside every image on the image's namespace, replacing camera_info there.
        poses: TUM file, published as /sf/pose.
        extrinsic: (camera frame, lidar frame, T_camera_lidar), published on /tf_static.

    Returns:
        The new bag ``out/input_with_given.mcap``, or ``bag`` itself when nothing was given.
    """
    if camera is None and poses is None and extrinsic is None:
        return bag
    target = out / "input_with_given.mcap"
    info_topic = image_topic.rsplit("/", 1)[0] + "/camera_info"
    with BagReader(bag) as reader, SequenceWriter(target) as writer:
        if extrinsic is not None:
            writer.tf_static(*extrinsic, stamp_ns=reader.start_ns)
        if poses is not None:
            given = read_tum(poses)
            for stamp, T in zip(given.stamps_ns.tolist(), given.poses, strict=True):
                writer.pose("/sf/pose", stamp, T, "map")
        for raw in reader.messages():
            if camera is not None and raw.topic == info_topic:
                continue
            writer.bag.write(raw.topic, raw.type, raw.stamp_ns, raw.data)
            if camera is not None and raw.topic == image_topic:
                writer.camera_info(info_topic, raw.stamp_ns, camera)
    return target
