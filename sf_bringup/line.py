"""A production line as processes: brought up in order, watched, restarted, changed by difference, stopped."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import signal
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import rclpy
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.node import Node

from sf_bringup.launcher import Process, node_command, stop_all
from sf_bringup.shared_memory import sweep_shared_memory
from sf_bringup.wiring import NodeLaunch
from sf_interfaces.errors import ConfigError, SceneFactoryError

_START_S = 180.0  # importing torch on a busy machine takes a while; a node that dies meanwhile is noticed at once
_TRANSITION_S = 120.0
_ANSWER_S = 5.0
_NICE = 10
_TRANSITIONS = (
    (Transition.TRANSITION_CONFIGURE, State.PRIMARY_STATE_INACTIVE),
    (Transition.TRANSITION_ACTIVATE, State.PRIMARY_STATE_ACTIVE),
)
_BACK_OFF_S = (1.0, 2.0, 4.0)  # before each of the at most three restarts


_HEALTHY_S = 60.0  # a node that has run this long has recovered: its earlier deaths are forgotten


@dataclass(slots=True)
class _Running:
    launch: NodeLaunch
    process: Process
    restarts: int = 0
    restart_at: float | None = None
    since: float = 0.0


class Line:
    """The nodes of one plan under one parent.

    Args:
        node: the parent's node, for lifecycle services; the caller does not spin it meanwhile.
        folder: where logs and parameter files go.
        environment: of the children.
    """

    def __init__(self, node: Node, folder: Path, environment: Mapping[str, str]) -> None:
        self._node, self._folder, self._environment = node, folder, environment
        self._running: dict[str, _Running] = {}

    @property
    def names(self) -> tuple[str, ...]:
        """Short names of the nodes, in the order of the plan."""
        return tuple(self._running)

    @property
    def processes(self) -> list[Process]:
        """All children."""
        return [r.process for r in self._running.values()]

    def apply(self, wanted: Iterable[NodeLaunch]) -> tuple[list[str], list[str]]:
        """Start what is new, stop what is no longer wanted; nodes that stay the same keep running.

        Returns:
            Names of started and of stopped nodes.

        Raises:
            SceneFactoryError: a new node did not come up.
        """
        plan = {launch.name: launch for launch in wanted}
        stopped = [n for n, r in self._running.items() if plan.get(n) != r.launch]
        stop_all([self._running.pop(n).process for n in stopped])
        started = [n for n in plan if n not in self._running]
        for name in started:
            self._running[name] = _Running(plan[name], self._spawn(plan[name]), since=time.monotonic())
        self._running = {n: self._running[n] for n in plan}
        # A replay waits for nobody: everybody downstream has to listen before its head becomes active. A live
        # head is wanted soon, and its keyframes are kept for those that come later.
        replay = any(launch.parameters.get("lossless") for launch in plan.values())
        for name in reversed(started) if replay else started:
            self.bring_up(name)
        return started, stopped

    def bring_up(self, name: str) -> None:
        """Configure and activate one node.

        Raises:
            ConfigError: the node refused; the sentence is the node's own.
            SceneFactoryError: it died or did not answer in time.
        """
        for transition, reached in _TRANSITIONS:
            request = ChangeState.Request(transition=Transition(id=transition))
            deadline = time.monotonic() + _TRANSITION_S
            answer = self._call(name, "change_state", ChangeState, request)
            # The request can overtake the discovery of the way back, and its answer is then lost; or the node is busy
            # with it, and silent. Only a node that answers and has not moved is asked again.
            while answer is None and (state := self._state(name)) != reached:
                if time.monotonic() > deadline:
                    log = self._running[name].process.log
                    raise SceneFactoryError(f"node {name} does not answer its lifecycle services; see {log}")
                if state is not None:
                    answer = self._call(name, "change_state", ChangeState, request)
            if answer is not None and not answer.success and self._state(name) != reached:
                said = self._running[name].process.last_lines(3)
                raise ConfigError(f"node {name} refused to start: {said}")

    def _state(self, name: str) -> int | None:
        """Lifecycle state of a node, None if it did not answer."""
        answer = self._call(name, "get_state", GetState, GetState.Request())
        return None if answer is None else int(answer.current_state.id)

    def dead(self) -> dict[str, int]:
        """Exit codes of nodes that ended."""
        return {n: code for n, r in self._running.items() if (code := r.process.poll()) is not None}

    def supervise(self, now: float) -> list[str]:
        """Restart nodes that died, with growing pauses and at most three times in a row; returns what was done.

        A node goes on from its last snapshot. One that keeps dying is given up with all nodes after it: the
        line goes on without them.

        Raises:
            SceneFactoryError: the first node of the line keeps dying, so nothing is left.
        """
        said = []
        for name, code in self.dead().items():
            running = self._running.get(name)
            if running is None:
                continue  # given up a moment ago together with the node before it
            if now - running.since > _HEALTHY_S and running.restart_at is None:
                running.restarts = 0
            if running.restarts >= len(_BACK_OFF_S):
                said.append(self._give_up(name, code))
            elif running.restart_at is None:
                running.restart_at = now + _BACK_OFF_S[running.restarts]
                said.append(f"node {name} {_ended(code)}, restart in {_BACK_OFF_S[running.restarts]:g} s")
            elif now >= running.restart_at:
                said.append(self._restart(name, running, now))
        return said

    def _restart(self, name: str, running: _Running, now: float) -> str:
        sweep_shared_memory()
        running.restarts, running.restart_at, running.since = running.restarts + 1, None, now
        running.process = self._spawn(running.launch, resume=True)
        try:
            self.bring_up(name)
        except SceneFactoryError as error:
            stop_all([running.process])  # the next look counts it as another death
            return f"node {name} did not come back: {error}"
        return f"node {name} restarted"

    def _give_up(self, name: str, code: int) -> str:
        """Stop a node that keeps dying and everything downstream of it."""
        names = list(self._running)
        lost = names[names.index(name) :]
        why = f"node {name} died {self._running[name].restarts + 1} times in a row, last it {_ended(code)}"
        log = self._running[name].process.log
        stop_all([self._running.pop(n).process for n in lost])
        if not self._running:
            raise SceneFactoryError(f"{why}; see {log}")
        return f"{why}; the line goes on without {', '.join(lost)}; see {log}"

    def stop(self, save_s: float = 0.0) -> list[str]:
        """End all nodes; they are gone when this returns, and so is the shared memory of those that were killed.

        Args:
            save_s: how long live nodes may take to write their results; 0: no longer than a moment.

        Returns:
            Names of nodes that had not written everything by then.
        """
        cut_short = stop_all(self.processes, interrupt_s=save_s) if save_s else stop_all(self.processes)
        self._running.clear()
        sweep_shared_memory()
        return cut_short

    def _spawn(self, launch: NodeLaunch, *, resume: bool = False) -> Process:
        if resume:
            launch = replace(launch, parameters={**launch.parameters, "resume": True})
        log = self._folder / f"{launch.name}.log"
        # What follows the sensors can catch up later; the head cannot, and so goes first where cores are scarce.
        nice = 0 if launch.head else _NICE
        return Process(launch.name, node_command(launch, self._folder), log, self._environment, nice)

    def _call(self, name: str, service: str, kind: Any, request: Any) -> Any:
        """The answer of a node's service, None if none came in time."""
        client = self._node.create_client(kind, f"/sf/{name}/{service}")
        process = self._running[name].process
        try:
            deadline = time.monotonic() + _START_S
            while not client.wait_for_service(timeout_sec=0.2):
                if process.poll() is not None:
                    raise ConfigError(
                        f"node {name} ended with exit code {process.poll()} while starting: {process.last_lines(3)}"
                    )
                if time.monotonic() > deadline:
                    raise SceneFactoryError(f"node {name} did not start within {_START_S:g} s; see {process.log}")
            future = client.call_async(request)
            rclpy.spin_until_future_complete(self._node, future, timeout_sec=_ANSWER_S)
            return future.result() if future.done() else None
        finally:
            self._node.destroy_client(client)


def _ended(code: int) -> str:
    return f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
