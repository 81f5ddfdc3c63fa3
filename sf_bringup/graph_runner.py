"""``sf run --engine ros``: a bag through the graph of processes, recorded to ``result.mcap``."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import rclpy
from rclpy.node import Node

from sf_bringup.launcher import Process, stop_all
from sf_bringup.launcher_env import node_environment
from sf_bringup.line import Line
from sf_bringup.pipeline import IMAGE_SET, untracked
from sf_bringup.planner import Plan
from sf_bringup.preflight import BagInput
from sf_bringup.progress import Progress
from sf_bringup.run_folder import RunFolder
from sf_bringup.wiring import NodeLaunch, launches
from sf_interfaces import topics
from sf_interfaces.blocks import Quantity
from sf_interfaces.config import ConfigFile
from sf_interfaces.errors import FormatError, SceneFactoryError
from sf_interfaces.ros import messages
from sf_interfaces.ros.qos import qos_profile

_FINISHED = 1  # sf_interfaces/msg/StreamState
_DISCOVERY_S = 60.0
_IN_FLIGHT = 24  # images: more than one LiDAR period at 30 Hz, little enough to bound memory
_RECORDED = [t.name for t in topics.TABLE if t.name.startswith("/sf/") and t not in topics.INPUTS]
_ALSO_RECORDED = [topics.TF.name, topics.TF_STATIC.name, topics.DIAGNOSTICS.name]
_DIAGNOSTICS_S = 5.0
_STALL_S = 180.0  # without any news from any node a replay has hung


class _Watch:
    """What the parent hears of the line: progress, ends of streams, errors in words."""

    def __init__(self, node: Node, line: tuple[NodeLaunch, ...]) -> None:
        self.finished: set[str] = set()
        self.poses = self.keyframes = 0
        self.news = time.monotonic()
        self.errors: list[str] = []
        make = messages.rclpy_factory
        for launch in line:
            topic = topics.stream(launch.name)
            node.create_subscription(
                make(topic.type),
                topic.name,
                lambda m, n=launch.name: self._state(n, m),
                qos_profile(topic.qos),
            )
        for topic, take in (
            (topics.TRACKING_POSE, self._pose),
            (topics.KEYFRAME_INFO, self._keyframe),
            (topics.DIAGNOSTICS, self._diagnostics),
        ):
            # Volatile, as a replay publishes keyframes: it fits latched publishers too.
            node.create_subscription(make(topic.type), topic.name, take, qos_profile(topic.qos, lossless=True))

    def _state(self, name: str, msg: Any) -> None:
        self.news = time.monotonic()
        if msg.state == _FINISHED:
            self.finished.add(name)

    def _pose(self, _: Any) -> None:
        self.poses += 1
        self.news = time.monotonic()

    def _keyframe(self, _: Any) -> None:
        self.keyframes += 1

    def _diagnostics(self, msg: Any) -> None:
        for status in msg.status:
            level = status.level[0] if isinstance(status.level, bytes) else status.level
            if level >= 2 and status.message not in self.errors:
                self.errors.append(status.message)


@contextmanager
def _parent_node() -> Iterator[Node]:
    rclpy.init()
    node = Node("sf_run")
    try:
        yield node
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


def run_graph(folder: RunFolder, given: BagInput, made: Plan, config: ConfigFile, rate: float) -> dict[str, int]:
    """Play the bag through the line's processes until the last node has finished; record everything.

    Args:
        rate: live playing speed; 0 plays lossless, as fast as the line takes it.

    Returns:
        Nothing dropped by this process itself; the nodes' counters are in the recorded diagnostics.

    Raises:
        SceneFactoryError: a process died, refused its configuration, or the line hangs.
    """
    out, compressed = str(folder.path.resolve()), given.mapping.compressed
    line = launches(made, given.mapping.roles, config, lossless=rate == 0, out=out, compressed=compressed)
    environment = node_environment()
    poses = folder.path / "trajectory.tum"

    def estimated() -> bool:
        """An image set is all or nothing: without depth of any image the node leaves no file."""
        return made.ids != (IMAGE_SET,) or poses.is_file()

    logs = folder.path / "log"
    with _parent_node() as node:
        watch = _Watch(node, line)
        graph = Line(node, logs, environment)
        helpers: list[Process] = []
        try:
            recorder = Process("recorder", _record_command(folder, made), logs / "recorder.log", environment)
            helpers.append(recorder)
            graph.apply(line)
            player = Process("player", _play_command(given, line, rate), logs / "player.log", environment)
            helpers.append(player)
            _wait(node, watch, graph, player, recorder, line, given)
            if not estimated():
                _hear_why(node, watch)
            graph.stop()
            _finish_recording(recorder)
        finally:
            stop_all([*graph.processes, *helpers])  # at once: each may take its whole patience
    for sentence in watch.errors:
        print(f"sf: {sentence}", file=sys.stderr)
    if not estimated():
        raise FormatError("; ".join(watch.errors) or f"no image of {given.bag} got depth")
    if poses.is_file() and not poses.stat().st_size:
        raise untracked(given)
    return {}


def _record_command(folder: RunFolder, made: Plan) -> list[str]:
    run = folder.path
    calibration = run / "calibration.json"
    info = folder.info()
    calibration.write_text(json.dumps({"frames": json.dumps(info["frames"]), "topics": json.dumps(info["topics"])}))
    recorded = [*_RECORDED, *_ALSO_RECORDED]
    recorded += [topics.stream(block.split(":")[0]).name for block in info["line"]]
    tracked = any(Quantity.POSE in step.spec.provides for step in made.steps)
    names = ("config.yaml", "trajectory.tum", "keyframes.tum") if tracked else ("config.yaml",)
    attached = [str(run / name) for name in names]
    return [
        sys.executable, "-m", "sf_bringup.recorder", str(folder.result), "--topics", *recorded,
        "--attach", *attached, "--metadata", f"scenefactory={run / 'run.json'}", f"calibration={calibration}",
    ]  # fmt: skip


def _play_command(given: BagInput, line: tuple[NodeLaunch, ...], rate: float) -> list[str]:
    roles = given.mapping.roles
    played = [*roles.values(), *given.transform_topics]
    command = [sys.executable, "-m", "sf_bringup.player", str(given.bag), "--topics", *played]
    command += ["--head", roles.get("rgb", roles.get("depth", ""))]
    if rate:
        return [*command, "--rate", str(rate)]
    heads = [topics.consumed(launch.name).name for launch in line if launch.head]
    # The nodes are active already: only discovery is still to come, which takes long where cores are scarce.
    command += ["--wait", f"{_DISCOVERY_S:g}"]
    return [*command, "--lossless", "--in-flight", str(_IN_FLIGHT), "--consumed", *heads]


def _wait(
    node: Node,
    watch: _Watch,
    graph: Line,
    player: Process,
    recorder: Process,
    line: tuple[NodeLaunch, ...],
    given: BagInput,
) -> None:
    """Spin until every node has finished its stream, and notice at once when something ends early."""
    with Progress("running", "frames") as progress:
        while not all(launch.name in watch.finished for launch in line):
            rclpy.spin_once(node, timeout_sec=0.1)
            progress.update(watch.poses, given.leading_messages, f"{watch.keyframes} keyframes")
            for name, code in graph.dead().items():
                raise SceneFactoryError(f"node {name} ended early with exit code {code}; see {logs_of(graph, name)}")
            for helper in (player, recorder):
                if helper.poll() not in (None, 0):
                    raise SceneFactoryError(
                        f"{helper.name} ended with exit code {helper.poll()}: {helper.last_lines(2)}"
                    )
            if time.monotonic() - watch.news > _STALL_S:
                waiting = sorted({launch.name for launch in line} - watch.finished)
                raise SceneFactoryError(
                    f"no news from {', '.join(waiting)} for {_STALL_S:g} s; see the logs beside the result"
                )


def _hear_why(node: Node, watch: _Watch) -> None:
    """Errors travel with the diagnostics, which come once a second and so after the end of a stream."""
    deadline = time.monotonic() + _DIAGNOSTICS_S
    while not watch.errors and time.monotonic() < deadline:
        rclpy.spin_once(node, timeout_sec=0.1)


def logs_of(graph: Line, name: str) -> Path:
    """The log file of one node."""
    return next(p.log for p in graph.processes if p.name == name)


def _finish_recording(recorder: Process) -> None:
    """Let the recorder write its index, metadata and attachments, however long the disk takes."""
    recorder.send(signal.SIGINT)
    deadline = time.monotonic() + 60.0
    while recorder.poll() is None and time.monotonic() < deadline:
        time.sleep(0.05)
    if recorder.poll() != 0:
        raise SceneFactoryError(f"the recorder ended with {recorder.poll()}: {recorder.last_lines(3)}")
