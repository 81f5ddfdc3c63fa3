"""Mode ``depth:calibrate``: intrinsics from the first images of a bag, before its line starts.

Both engines then play a copy of the bag that carries the estimated camera_info, so that both see the same.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from sf_bringup import inputs, preflight
from sf_bringup.pipeline import make_part
from sf_bringup.planner import Plan
from sf_bringup.preflight import BagInput
from sf_interfaces.blocks import Quantity
from sf_interfaces.config import ConfigFile
from sf_interfaces.errors import CalibrationError, SceneFactoryError
from sf_interfaces.io.bag import BagReader
from sf_interfaces.ros.messages import decode_image, to_ns
from sf_interfaces.types import Camera, UInt8

CALIBRATE = "depth:calibrate"


def bag_images(given: BagInput) -> Iterator[tuple[int, UInt8]]:
    """Stamp and image of every colour image of a bag, as recorded."""
    with BagReader(given.bag) as reader:
        for raw in reader.messages([given.mapping.roles["rgb"]]):
            message = reader.decode(raw)
            yield to_ns(message.header.stamp), decode_image(message)


def calibrate(given: BagInput, config: ConfigFile) -> Camera:
    """Intrinsics from as many of the first images as they take.

    Raises:
        CalibrationError: the images do not constrain them.
    """
    part = make_part(CALIBRATE, config)
    camera: Camera | None = None
    try:
        for _, image in bag_images(given):
            camera = part.add(image)
            if camera is not None:
                break
        camera = camera or part.finish()
    except SceneFactoryError as error:
        raise CalibrationError(
            f"{given.bag} has no camera_info, and {CALIBRATE} cannot estimate it: {error}; "
            "add camera_info or --calibration"
        ) from error
    return replace(camera, frame_id=given.frames["rgb"])


def calibrated(given: BagInput, made: Plan, config: ConfigFile, out: Path) -> tuple[BagInput, Plan]:
    """The bag with estimated intrinsics, and the plan without the step that estimated them."""
    if CALIBRATE not in made.ids:
        return given, made
    camera = calibrate(given, config)
    topic = given.mapping.roles["rgb"]
    bag = inputs.with_given(given.bag, out, image_topic=topic, camera=camera, poses=None, extrinsic=None)
    mapping = {role: name for role, name in given.mapping.roles.items() if role != "camera_info"}
    steps = tuple(
        replace(step, sources={q: "input" if who == CALIBRATE else who for q, who in step.sources.items()})
        for step in made.steps
        if step.spec.id != CALIBRATE
    )
    rest = Plan(made.goal, made.available | {Quantity.INTRINSICS}, steps)
    return preflight.inspect(bag, mapping), rest
