"""From a plan to processes: which node listens to what, with which parameters. Pure."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from sf_bringup.planner import INPUT, Plan, Step
from sf_interfaces import topics
from sf_interfaces.blocks import Quantity
from sf_interfaces.config import ConfigFile

Q = Quantity
_ROLE_TOPIC = {
    "rgb": topics.RGB_IMAGE.name,
    "camera_info": topics.RGB_INFO.name,
    "depth": topics.DEPTH_IMAGE.name,
    "lidar": topics.LIDAR_POINTS.name,
    "pose": topics.GIVEN_POSE.name,
}
_STREAM = {"rgb": "image", "depth": "depth"}  # role -> stream that may come compressed


@dataclass(frozen=True, slots=True)
class NodeLaunch:
    """One process of the line.

    Args:
        name: short node name; the node is /sf/<name>.
        module: run as ``python -m <module>``.
        remaps: topic the node uses -> topic that exists.
        parameters: ROS parameters.
        head: it takes in sensor messages, and so gives credits.
    """

    name: str
    module: str
    remaps: Mapping[str, str] = field(default_factory=dict)
    parameters: Mapping[str, Any] = field(default_factory=dict)
    head: bool = False


def sync_values(plan: Plan, roles: Mapping[str, str], step: Step) -> dict[str, bool]:
    """Which sensor streams a head of the line joins (fields of SyncConfig)."""
    given = plan.available
    uses = frozenset(step.spec.requires | step.spec.optional)
    return {
        "image": True,
        "camera": Q.INTRINSICS in given | step.spec.requires,
        "depth": "depth" in roles and bool(uses & {Q.DEPTH, Q.SPARSE_DEPTH}),
        "lidar": "lidar" in roles and Q.DEPTH not in given and bool(uses & {Q.SPARSE_DEPTH}),
        "pose": Q.GIVEN_POSE in given,
    }


def launches(
    plan: Plan,
    roles: Mapping[str, str],
    config: ConfigFile,
    *,
    lossless: bool,
    out: str = "",
    compressed: Collection[str] = (),
) -> tuple[NodeLaunch, ...]:
    """The processes of a plan, in its order.

    Args:
        roles: role -> topic of the input (rgb, camera_info, depth, lidar, pose).
        config: sections that become node parameters.
        lossless: replay without dropping.
        out: folder for the nodes' files, empty for none.
        compressed: roles whose topic carries CompressedImage.
    """
    plan.check_runnable()
    streams = [_STREAM[role] for role in roles if role in compressed]
    return tuple(_launch(plan, step, roles, config, lossless, out, streams) for step in plan.steps)


def _source(step: Step) -> str:
    """Which stream a node takes in: keyframes completed (depth) or tracked, whoever provides them, or the sensors'."""
    if _provider(step, Q.DEPTH) and Q.DEPTH in step.spec.requires:
        return "depth"
    return "tracking" if _provider(step, Q.POSE) else "sensors"


def _provider(step: Step, quantity: Quantity) -> str:
    """Name of the node upstream that completes a quantity; empty where it is given or not used."""
    source = step.sources.get(quantity, INPUT)
    return "" if source == INPUT else source.partition(":")[0]


def _launch(
    plan: Plan,
    step: Step,
    roles: Mapping[str, str],
    config: ConfigFile,
    lossless: bool,
    out: str,
    compressed: Sequence[str],
) -> NodeLaunch:
    source = _source(step)
    made_image = _provider(step, Q.IMAGE) if source == "sensors" else ""
    parameters: dict[str, Any] = {"source": source, "lossless": lossless, "out": out}
    remaps: dict[str, str] = {}
    upstream = made_image or _provider(step, Q.DEPTH if source == "depth" else Q.POSE)
    if upstream and upstream != source:
        parameters["upstream"] = upstream
    if made_image:
        remaps[topics.RGB_IMAGE.name] = topics.FLEXION_IMAGE.name
    if step.spec.mode:
        parameters["mode"] = step.spec.mode
    parameters |= dict(config.sections.get(step.spec.name, {}))
    if source == "sensors":
        carried = [stream for stream in compressed if not (made_image and stream == "image")]
        sync = {**sync_values(plan, roles, step), "compressed": carried, **config.sections.get("sync", {})}
        parameters |= {f"sync.{key}": value for key, value in sync.items()}
        remaps |= {
            own: roles[role]
            for role, own in _ROLE_TOPIC.items()
            if role in roles and own not in remaps and own != roles[role]
        }
    assert step.spec.executable is not None
    return NodeLaunch(step.spec.name, step.spec.executable, remaps, parameters, source == "sensors")
