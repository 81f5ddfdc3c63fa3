"""From the topics that are there to the inputs of a line: pure decisions, each with its reason in words.

Works on the topic list of a bag and on the live graph alike; a probe is one message of a topic, reduced
to what decides about it.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from sf_interfaces import topics
from sf_interfaces.blocks import Quantity
from sf_interfaces.errors import ConfigError, FormatError
from sf_interfaces.ros.messages import COMPRESSED_IMAGE, decode_depth, decode_image, encoding_of

IMAGE, INFO = topics.RGB_IMAGE.type, topics.RGB_INFO.type
CLOUD, POSE = topics.LIDAR_POINTS.type, topics.GIVEN_POSE.type
ROLES: Mapping[str, str] = {"rgb": IMAGE, "camera_info": INFO, "depth": IMAGE, "lidar": CLOUD, "pose": POSE}
DEPTH_ENCODINGS = frozenset({"16UC1", "32FC1"})
_TRANSPORTS = ("compressed", "compressedDepth")  # image_transport appends them to the topic of the image
DENSE_FRACTION = 0.2  # valid fraction above which depth counts as dense (the original's rule)
_OWN = ("/sf/", topics.GROUND_TRUTH_PREFIX, "/clock", "/tf", "/diagnostics", "/rosout", "/parameter_events")


@dataclass(frozen=True, slots=True)
class Probe:
    """One message of a topic: image encoding, frame, for depth the fraction of valid pixels, and why it is unusable."""

    encoding: str = ""
    frame_id: str = ""
    valid_fraction: float = 1.0
    problem: str = ""


@dataclass(frozen=True, slots=True)
class InputMapping:
    """Which topic plays which role, what that makes available, and why.

    Args:
        roles: role (rgb, camera_info, depth, lidar, pose) -> topic.
        available: the quantities the planner starts from.
        reasons: one sentence per decision, rejected candidates included.
        compressed: roles whose topic is a CompressedImage.
    """

    roles: Mapping[str, str]
    available: frozenset[Quantity]
    reasons: tuple[str, ...]
    compressed: frozenset[str] = frozenset()


def namespace(topic: str) -> str:
    """The camera namespace: ``/cam/color/image_raw`` and ``/cam/color/image_raw/compressed`` -> ``/cam/color``."""
    base, _, last = topic.rpartition("/")
    return base.rpartition("/")[0] if last in _TRANSPORTS else base


def probe(msg: Any) -> Probe:
    """What one message of a topic says about it. Never raises: what cannot be read is the finding."""
    frame = msg.header.frame_id.lstrip("/")
    if not hasattr(msg, "encoding") and not hasattr(msg, "format"):
        return Probe("", frame)
    try:
        encoding = encoding_of(msg)
        if encoding in DEPTH_ENCODINGS or (encoding == "mono16" and hasattr(msg, "encoding")):
            return Probe(encoding, frame, decode_depth(msg).density)
        decode_image(msg)
    except FormatError as error:
        return Probe("", frame, problem=str(error))
    return Probe(encoding, frame)


def needs_probe(types: Mapping[str, str]) -> list[str]:
    """Topics whose type alone does not tell their role."""
    return sorted(name for name, kind in types.items() if is_image(kind) and is_input(name))


def is_input(name: str) -> bool:
    """Whether a topic may feed a line: not our own, not a reference, not housekeeping."""
    return name.startswith(tuple(t.name for t in topics.INPUTS)) or not name.startswith(_OWN)


def takes(role: str, kind: str) -> bool:
    """Whether a role can be played by topics of a type; compressed images serve wherever images do."""
    return kind == ROLES[role] or (ROLES[role] == IMAGE and kind == COMPRESSED_IMAGE)


def is_wanted(kind: str) -> bool:
    """Whether any role takes topics of a type."""
    return any(takes(role, kind) for role in ROLES)


def is_image(kind: str) -> bool:
    """Whether a message type is an image, raw or compressed."""
    return takes("rgb", kind)


@dataclass(slots=True)
class _Decision:
    roles: dict[str, str] = field(default_factory=dict)
    reasons: list[str] = field(default_factory=list)

    def choose(self, role: str, candidates: list[str], why: str) -> None:
        if role in self.roles or not candidates:
            return
        best = candidates[0]
        self.roles[role] = best
        others = f"; {', '.join(candidates[1:])} left out (choose with --map {role}=TOPIC)" if candidates[1:] else ""
        self.reasons.append(f"{role} from {best}, {why}{others}")


def _check_user(user: Mapping[str, str], types: Mapping[str, str]) -> None:
    for role, topic in user.items():
        if role not in ROLES:
            raise ConfigError(f"--map {role}={topic}: unknown role; roles are {', '.join(ROLES)}")
        if topic not in types:
            raise ConfigError(f"--map {role}={topic}: no such topic; there are {', '.join(sorted(types)) or 'none'}")
        if not takes(role, types[topic]):
            raise ConfigError(f"--map {role}={topic}: it has type {types[topic]}, {role} needs {ROLES[role]}")


def _preferred(names: list[str]) -> list[str]:
    """Rectified before raw, left and colour before others, uncompressed first, then by name: a fixed order."""

    def rank(name: str) -> tuple[int, int, int, int, int, str]:
        low = name.lower()
        return (
            int("rect" not in low),
            int("color" not in low and "rgb" not in low),
            int("right" in low or "infra" in low),
            int(name.endswith(_TRANSPORTS)),
            len(name),
            name,
        )

    return sorted(names, key=rank)


def _related(one: str, other: str, probes: Mapping[str, Probe]) -> int:
    """How surely two topics belong to one camera: 100 = the same frame, else the segments their names share."""
    frame = probes[one].frame_id
    if frame and frame == probes[other].frame_id:
        return 100
    pairs = zip(one.split("/")[1:-1], other.split("/")[1:-1], strict=False)
    shared = [a == b for a, b in pairs]
    return shared.index(False) if False in shared else len(shared)


def discover(
    types: Mapping[str, str], probes: Mapping[str, Probe], user: Mapping[str, str] | None = None
) -> InputMapping:
    """Choose the input topics.

    Args:
        types: topic -> message type.
        probes: topic -> what one message of it says; topics without a probe are judged by type alone.
        user: role -> topic, wins over every rule.

    Raises:
        ConfigError: the user names an unknown role, an absent topic or one of the wrong type.
    """
    user = dict(user or {})
    _check_user(user, types)
    decision = _Decision(dict(user), [f"{role} from {topic}, as you asked" for role, topic in user.items()])
    inputs = {name: kind for name, kind in types.items() if is_input(name)}
    images = [n for n, kind in inputs.items() if is_image(kind) and n in probes]
    decision.reasons += [f"{n} left out: {probes[n].problem}" for n in sorted(images) if probes[n].problem]
    images = [n for n in images if not probes[n].problem]
    depth = [n for n in images if _is_depth(n, probes[n])]
    color = [n for n in images if n not in depth]
    infos = {namespace(n): n for n, kind in sorted(inputs.items()) if kind == INFO}
    with_info = [n for n in color if namespace(n) in infos]
    decision.reasons += [
        f"{n} has no camera_info in {namespace(n)}" for n in sorted(color) if namespace(n) not in infos
    ]
    # Of several cameras the one that also sees depth gives the richer line; a stable sort keeps the order else.
    candidates = sorted(
        _preferred(with_info) or _preferred(color), key=lambda n: not any(_related(n, d, probes) for d in depth)
    )
    decision.choose("rgb", candidates, "a colour image" + _transport(candidates[:1], inputs))
    rgb = decision.roles.get("rgb", "")
    if rgb in probes:
        depth = sorted(_preferred(depth), key=lambda n: -_related(rgb, n, probes))
    depth = depth if rgb in probes else _preferred(depth)
    decision.choose("depth", depth, "a depth image" + _transport(depth[:1], inputs))
    decision.choose("lidar", sorted(n for n, k in inputs.items() if k == CLOUD), "a point cloud")
    decision.choose("pose", sorted(n for n, k in inputs.items() if k == POSE), "a pose")
    leader = decision.roles.get("rgb", decision.roles.get("depth", ""))
    if leader and namespace(leader) in infos:
        decision.choose("camera_info", [infos[namespace(leader)]], f"in the namespace of {leader}")
    decision.reasons += [
        f"{n} ignored: no block takes {kind}" for n, kind in sorted(inputs.items()) if not is_wanted(kind)
    ]
    compressed = frozenset(role for role, topic in decision.roles.items() if types[topic] == COMPRESSED_IMAGE)
    return InputMapping(decision.roles, _available(decision.roles, probes), tuple(decision.reasons), compressed)


def _is_depth(name: str, found: Probe) -> bool:
    """By encoding; 16 bit grey may be a picture or depth, there the name decides."""
    return found.encoding in DEPTH_ENCODINGS or (found.encoding == "mono16" and "depth" in name.lower())


def _transport(chosen: list[str], types: Mapping[str, str]) -> str:
    return ", compressed" if chosen and types[chosen[0]] == COMPRESSED_IMAGE else ""


def _available(roles: Mapping[str, str], probes: Mapping[str, Probe]) -> frozenset[Quantity]:
    found = set()
    if "rgb" in roles:
        found.add(Quantity.IMAGE)
    if "camera_info" in roles:
        found.add(Quantity.INTRINSICS)
    if "pose" in roles:
        found.add(Quantity.GIVEN_POSE)
    if "depth" in roles:
        dense = probes.get(roles["depth"], Probe()).valid_fraction > DENSE_FRACTION
        found.add(Quantity.DEPTH if dense else Quantity.SPARSE_DEPTH)
    if "lidar" in roles and Quantity.DEPTH not in found:
        found.add(Quantity.SPARSE_DEPTH)
    return frozenset(found)
