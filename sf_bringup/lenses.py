"""References in the input of a run, freed from the lens as the run has freed its images on input."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from sf_bringup.run_folder import RunFolder
from sf_interfaces.geometry.undistort import Distortion, undistort_depth, undistort_image
from sf_interfaces.io.bag import BagReader
from sf_interfaces.ros.messages import decode_camera_info, decode_depth, decode_image
from sf_interfaces.types import Camera, DepthMap, UInt8


def image_decoder(run: RunFolder, bag: Path) -> Callable[[Any], UInt8]:
    """Image messages of a bag that is, or belongs to, the input of a run -> images of a pinhole camera."""
    camera, lens = _lens(run, bag)
    if camera is None:
        return decode_image
    return lambda message: undistort_image(decode_image(message), camera, lens)


def depth_decoder(run: RunFolder, bag: Path) -> Callable[[Any], DepthMap]:
    """The same of depth in the camera of the images."""
    camera, lens = _lens(run, bag)
    if camera is None:
        return decode_depth
    return lambda message: undistort_depth(decode_depth(message), camera, lens)


def _lens(run: RunFolder, bag: Path) -> tuple[Camera | None, Distortion | None]:
    """The camera of the images, and its lens; None where the bag does not say or the images show none."""
    topic = run.info()["topics"].get("camera_info")
    with BagReader(bag) as reader:
        if topic not in reader.topics:
            return None, None
        first = next(iter(reader.messages([topic])), None)
        camera, lens = (None, None) if first is None else decode_camera_info(reader.decode(first))
    return (None, None) if lens is None else (camera, lens)
