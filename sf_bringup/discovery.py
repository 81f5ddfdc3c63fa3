"""From the topics that are there to the inputs of a line: pure decisions, each with its reason in words.

Works on the topic list of a bag and on the live graph alike; a probe is one message of a topic, reduced
to what decides about it.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from sf_interfaces import topics
from sf_interfaces.blocks import Quantity
from sf_interfaces.errors import ConfigError

IMAGE, INFO = topics.RGB_IMAGE.type, topics.RGB_INFO.type
CLOUD, POSE = topics.LIDAR_POINTS.type, topics.GIVEN_POSE.type
ROLES: Mapping[str, str] = {"rgb": IMAGE, "camera_info": INFO, "depth": IMAGE, "lidar": CLOUD, "pose": POSE}
DEPTH_ENCODINGS = frozenset({"16UC1", "32FC1", "mono16"})
DENSE_FRACTION = 0.2  # valid fraction above which depth counts as dense (the original's rule)
_OWN = ("/sf/", topics.GROUND_TRUTH_PREFIX, "/clock", "/tf", "/diagnostics", "/rosout", "/parameter_events")


@dataclass(frozen=True, slots=True)
class Probe:
    """One message of a topic: image encoding, frame, and for depth the fraction of valid pixels."""

    encoding: str = ""
    frame_id: str = ""
    valid_fraction: float = 1.0


@dataclass(frozen=True, slots=True)
class InputMapping:
    """Which topic plays which role, what that makes available, and why.

    Args:
        roles: role (rgb, camera_info, depth, lidar, pose) -> topic.
        available: the quantities the planner starts from.
        reasons: one sentence per decision, rejected candidates included.
    """

    roles: Mapping[str, str]
    available: frozenset[Quantity]
    reasons: tuple[str, ...]


def namespace(topic: str) -> str:
    """The camera namespace: ``/cam/color/image_raw`` -> ``/cam/color``."""
    return topic.rsplit("/", 1)[0]


def needs_probe(types: Mapping[str, str]) -> list[str]:
    """Topics whose type alone does not tell their role."""
    return sorted(name for name, kind in types.items() if kind == IMAGE and is_input(name))


def is_input(name: str) -> bool:
    """Whether a topic may feed a line: not our own, not a reference, not housekeeping."""
    return name.startswith(tuple(t.name for t in topics.INPUTS)) or not name.startswith(_OWN)


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
        if types[topic] != ROLES[role]:
            raise ConfigError(f"--map {role}={topic}: it has type {types[topic]}, {role} needs {ROLES[role]}")


def _preferred(names: list[str]) -> list[str]:
    """Rectified before raw, left and colour before others, then by name: a fixed order."""

    def rank(name: str) -> tuple[int, int, int, int, str]:
        low = name.lower()
        return (
            int("rect" not in low),
            int("color" not in low and "rgb" not in low),
            int("right" in low or "infra" in low),
            len(name),
            name,
        )

    return sorted(names, key=rank)


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
    images = [n for n, kind in inputs.items() if kind == IMAGE and n in probes]
    depth = [n for n in images if probes[n].encoding in DEPTH_ENCODINGS]
    color = [n for n in images if n not in depth]
    infos = {namespace(n): n for n, kind in sorted(inputs.items()) if kind == INFO}
    with_info = [n for n in color if namespace(n) in infos]
    decision.reasons += [
        f"{n} has no camera_info in {namespace(n)}" for n in sorted(color) if namespace(n) not in infos
    ]
    decision.choose("rgb", _preferred(with_info) or _preferred(color), "a colour image")
    decision.choose("depth", _preferred(depth), "a depth image")
    decision.choose("lidar", sorted(n for n, k in inputs.items() if k == CLOUD), "a point cloud")
    decision.choose("pose", sorted(n for n, k in inputs.items() if k == POSE), "a pose")
    leader = decision.roles.get("rgb", decision.roles.get("depth", ""))
    if leader and namespace(leader) in infos:
        decision.choose("camera_info", [infos[namespace(leader)]], f"in the namespace of {leader}")
    decision.reasons += [
        f"{n} ignored: no block takes {kind}" for n, kind in sorted(inputs.items()) if kind not in ROLES.values()
    ]
    return InputMapping(decision.roles, _available(decision.roles, probes), tuple(decision.reasons))


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
