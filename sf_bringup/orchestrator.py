"""``sf up``: read the topics that are there, plan the line they allow, run it, and follow their changes."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import argparse
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from sf_bringup import discovery
from sf_bringup.discovery import InputMapping, Probe
from sf_bringup.launcher_env import node_environment
from sf_bringup.line import Line
from sf_bringup.planner import GOALS, Plan, plan
from sf_bringup.wiring import launches
from sf_interfaces import topics
from sf_interfaces.blocks import load_blocks
from sf_interfaces.config import ConfigFile
from sf_interfaces.errors import ConfigError, PlanError, SceneFactoryError
from sf_interfaces.ros import messages
from sf_interfaces.ros.qos import qos_profile

HOSTS = "hosts"  # section of the configuration: node -> host that runs it with --only
_LOOK_S = 0.25  # between two looks at the graph
_SETTLE_S = 1.0  # topics must have stayed the same this long before the line is planned anew
_SAVE_S = 1.5  # at the end, for results to be written: with SIGTERM after it, all are gone within three seconds
_VIEW_PORT = 8080
_GONE_S = 30.0  # an input of the running line may be silent this long (a driver restarts) before the line changes


class Orchestrator(Node):
    """Discovers inputs, plans, and keeps the planned processes running.

    Args:
        goal: what the line is for.
        user: role -> topic, wins over discovery.
        config: sections that become node parameters.
        folder: logs and, when the line ends, results.
        replay: nodes drop nothing (a lossless player feeds the line).
        use: blocks preferred whatever their cost.
        only: nodes to run on this host; empty: all that ``hosts`` of the configuration does not place elsewhere.
        save_s: how long nodes may take at the end to write their results.

    Raises:
        ConfigError: an unknown section or node name.
    """

    def __init__(
        self,
        goal: str,
        user: dict[str, str],
        config: ConfigFile,
        folder: Path,
        *,
        replay: bool = False,
        use: Sequence[str] = (),
        only: Sequence[str] = (),
        save_s: float = _SAVE_S,
    ) -> None:
        super().__init__("_".join(["sf_orchestrator", *only]))
        config.check_sections({spec.name for spec in load_blocks()} | {"sync", HOSTS})
        self._goal, self._user, self._config, self._folder, self._replay = goal, user, config, folder, replay
        self._use, self._only, self._save_s = tuple(use), frozenset(only), save_s
        self._elsewhere = frozenset(config.sections.get(HOSTS, {})) - self._only
        self._inputs: frozenset[str] = frozenset()  # topics the running line takes in
        self._last_seen: dict[str, tuple[str, float]] = {}
        self._line = Line(self, folder / "log", node_environment())
        self._probes: dict[str, Probe] = {}
        self._probing: dict[str, Any] = {}
        self._seen: dict[str, str] = {}
        self._changed_at = time.monotonic()
        self._planned: dict[str, str] | None = None
        self._said = ""
        self.plan: Plan | None = None
        state = topics.PRODUCTION_LINE
        self._state = self.create_publisher(messages.rclpy_factory(state.type), state.name, qos_profile(state.qos))
        self._offer_plan_service()

    def step(self) -> None:
        """Look at the graph once; plan and change the line when its topics have settled; supervise.

        Raises:
            SceneFactoryError: a node does not come up or keeps dying.
        """
        now = time.monotonic()
        types = self._present(now)
        if types != self._seen:
            self._seen, self._changed_at = types, now
        self._probe(types)
        settled = now - self._changed_at > _SETTLE_S and not self._probing
        if settled and types != self._planned:
            self._planned = types
            self._replan(types)
        for sentence in self._line.supervise(now):
            self.get_logger().warning(sentence)

    def stop(self) -> None:
        """End all nodes, when they have written their results; say which of them had not."""
        for name in self._line.stop(self._save_s):
            self.get_logger().warning(
                f"{name} had not written all its results after {self._save_s:g} s: give it time with --save-s 60; "
                f"what it saved on the way is in {self._folder / 'state'}"
            )

    # ---- inside

    def _topics(self) -> dict[str, str]:
        """Input topics that somebody outside this line publishes."""
        return {
            name: kinds[0]
            for name, kinds in self.get_topic_names_and_types()
            if discovery.is_input(name) and discovery.is_wanted(kinds[0]) and self.count_publishers(name)
        }

    def _present(self, now: float) -> dict[str, str]:
        """The input topics, and for a while those of the running line that have vanished."""
        found = self._topics()
        self._last_seen |= {name: (kind, now) for name, kind in found.items()}
        waited = {
            name: kind
            for name, (kind, seen) in self._last_seen.items()
            if name in self._inputs and name not in found and now - seen < _GONE_S
        }
        for name in waited:
            self._say(f"{name} is gone; the line waits {_GONE_S:g} s for it to come back")
        return found | waited

    def _probe(self, types: dict[str, str]) -> None:
        """Ask each new image topic for one message; drop probes of topics that went away."""
        for name in discovery.needs_probe(types):
            if name in self._probes or name in self._probing:
                continue
            kind = messages.rclpy_factory(types[name])
            take = self._probed(name)
            self._probing[name] = self.create_subscription(kind, name, take, qos_profile(topics.RGB_IMAGE.qos))
        for name in [n for n in self._probing if n in self._probes or n not in types]:
            self.destroy_subscription(self._probing.pop(name))
        self._probes = {n: p for n, p in self._probes.items() if n in types}

    def _probed(self, name: str) -> Any:
        def take(msg: Any) -> None:
            self._probes[name] = discovery.probe(msg)

        return take

    def _replan(self, types: dict[str, str]) -> None:
        """Apply the difference between the running line and the one these topics allow."""
        try:
            user = {role: topic for role, topic in self._user.items() if topic in types}
            mapping = discovery.discover(types, self._probes, user)
            made = plan(mapping.available, self._goal, load_blocks(), self._use)
            wanted = launches(
                made, mapping.roles, self._config,
                lossless=self._replay, out=str(self._folder.resolve()), compressed=mapping.compressed,
            )  # fmt: skip
        except PlanError as error:
            self._say(f"no line: {error}")
            self._line.apply(())
            self.plan, self._inputs = None, frozenset()
            self._publish(None, str(error))
            return
        self._explain(mapping, made)
        started, stopped = self._line.apply(launch for launch in wanted if self._is_here(launch.name))
        self.plan, self._inputs = made, frozenset(mapping.roles.values())
        self._publish(made, "active")
        self._say(f"started {', '.join(started) or 'nothing'}, stopped {', '.join(stopped) or 'nothing'}")

    def _is_here(self, name: str) -> bool:
        return name in self._only if self._only else name not in self._elsewhere

    def _explain(self, mapping: InputMapping, made: Plan) -> None:
        self._say("\n".join([*mapping.reasons, made.explain()]))

    def _say(self, text: str) -> None:
        if text != self._said:
            self._said = text
            self.get_logger().info(text)

    def _publish(self, made: Plan | None, state: str) -> None:
        self._state.publish(self._message(made, state))

    def _message(self, made: Plan | None, state: str) -> Any:
        make = messages.rclpy_factory
        blocks = [
            make("sf_interfaces/msg/LineBlock")(
                id=step.spec.id,
                executable=step.spec.executable or "",
                reason=step.reason,
                provides=sorted(q.value for q in step.spec.provides),
                requires=sorted(q.value for q in step.spec.requires),
                state=state,
            )
            for step in (made.steps if made else ())
        ]
        stamp = self.get_clock().now().to_msg()
        kind = make(topics.PRODUCTION_LINE.type)
        return kind(stamp=stamp, goal=made.goal if made else self._goal, state=state, blocks=blocks)

    def _offer_plan_service(self) -> None:
        from sf_interfaces.srv import Plan as PlanService

        def answer(request: Any, response: Any) -> Any:
            try:
                mapping = discovery.discover(self._topics(), self._probes, self._user)
                made = plan(mapping.available, request.goal or self._goal, load_blocks(), self._use)
                response.line, response.message = self._message(made, "planned"), made.explain()
            except SceneFactoryError as error:
                response.message = str(error)
            return response

        self.create_service(PlanService, "/sf/plan", answer)


def parse(args: Sequence[str] | None) -> argparse.Namespace:
    """Arguments of ``sf up``."""
    parser = argparse.ArgumentParser(prog="sf up", description="Orchestrate a line on live topics.")
    parser.add_argument("--goal", choices=GOALS, default="auto")
    parser.add_argument("--map", action="append", default=[], metavar="ROLE=TOPIC")
    parser.add_argument("--config", type=Path)
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument(
        "--use", action="append", default=[], metavar="BLOCK", help="prefer this block, see 'sf blocks'"
    )
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="NODE", help="run only these nodes of the line on this host"
    )
    parser.add_argument(
        "--save-s",
        type=float,
        default=_SAVE_S,
        help="seconds the nodes may take after Ctrl-C to write their results (large maps take more than the default)",
    )
    parser.add_argument(
        "--view",
        nargs="?",
        type=int,
        const=_VIEW_PORT,
        metavar="PORT",
        help=f"serve a page on this machine that shows the map while it grows (default port: {_VIEW_PORT})",
    )
    parser.add_argument("--replay", action="store_true", help="drop nothing: a lossless player feeds the line")
    return parser.parse_args(args)


def _pairs(given: Sequence[str], option: str) -> dict[str, str]:
    pairs = dict(pair.partition("=")[::2] for pair in given)
    for key, value in pairs.items():
        if not value:
            raise ConfigError(f"{option} {key}: write it as KEY=VALUE")
    return pairs


def main(args: Sequence[str] | None = None) -> int:
    """Run until Ctrl-C; exit code 0 done, 2 bad configuration or a node that keeps dying.

    A second signal ends it without waiting for results: the nodes die with their parent.
    """
    stopping: list[int] = []

    def stop(number: int, _: Any) -> None:
        stopping.append(number)
        if len(stopping) > 1:
            raise KeyboardInterrupt

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    try:
        given = parse(args)
        shown = {} if given.view is None else {"recon.view_port": str(given.view)}
        config = ConfigFile.load(given.config, shown | _pairs(given.set, "--set"))
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        node = Orchestrator(
            given.goal, _pairs(given.map, "--map"), config, given.out,
            replay=given.replay, use=given.use, only=given.only, save_s=given.save_s,
        )  # fmt: skip
        try:
            while not stopping:
                node.step()
                rclpy.spin_once(node, timeout_sec=_LOOK_S)
        finally:
            node.stop()
            node.destroy_node()
            rclpy.try_shutdown()
    except SceneFactoryError as error:
        print(f"sf up: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
