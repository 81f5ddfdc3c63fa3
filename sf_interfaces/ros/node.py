"""The lifecycle node every block is: one thread receives, one worker decodes and runs the core.

The executor's thread only queues bytes. A lossless node drops nothing and decides nothing by the clock, so
what it computes is a function of its input alone.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import threading
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.publisher import Publisher
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription

from sf_interfaces import topics
from sf_interfaces.config import option
from sf_interfaces.errors import SceneFactoryError
from sf_interfaces.ros import messages, parameters
from sf_interfaces.ros.diagnostics import DiagnosticsPublisher, Health
from sf_interfaces.ros.inbox import Inbox
from sf_interfaces.ros.qos import qos_profile
from sf_interfaces.ros.stamps import stamp_of
from sf_interfaces.sync import SyncConfig
from sf_interfaces.topics import Topic

_RUNNING, _FINISHED = 0, 1  # sf_interfaces/msg/StreamState
_STALL_REPORTS = 5  # seconds without input after the end was announced, before the rest is given up


@dataclass(frozen=True, slots=True)
class NodeOptions:
    """What every node of the graph has beside its block's configuration."""

    source: str = option("sensors", "where bundles come from: sensors, tracking or depth")
    upstream: str = option("", "stream whose end ends this node (empty: player for sensors, else the source)")
    lossless: bool = option(False, "replay: drop nothing, decide nothing by waiting")
    autostart: bool = option(False, "configure and activate without an orchestrator")
    out: str = option("", "folder for this node's files, written at the end (empty: none)")
    resume: bool = option(False, "go on from the snapshot that a node of this name left in out/state")


class BlockNode(LifecycleNode):
    """Base of all nodes. A block fills in :meth:`setup`, :meth:`take` and :meth:`finish`.

    Attributes:
        short: name of the node below /sf, and of its topics.
        config_class: configuration dataclass of the block.
        defaults: node options that differ for this block.
        leader: kind of message whose consumption is credited and whose number the upstream announces.
        counted: further kinds of which the upstream announces the same number (the parts of a bundle).
    """

    short: ClassVar[str]
    config_class: ClassVar[type]
    defaults: ClassVar[dict[str, Any]] = {}

    def __init__(self) -> None:
        super().__init__(self.short, namespace="sf")
        self.health = Health()
        self.leader = ""
        self.counted: set[str] = set()
        self.exit_code: int | None = None
        self._subscriptions_wanted: list[tuple[Topic, str, int | None]] = []
        self._active: list[tuple[Subscription, Callable[[bytes], None]]] = []
        self._types: dict[str, Any] = {}
        self._outputs: dict[Topic, Publisher] = {}
        self._inbox = Inbox(self._dropped)
        self._worker: threading.Thread | None = None
        self._received: Counter[str] = Counter()
        self._sent = self._stalled = 0
        self._announced: int | None = None
        self._ended = self._finished = False
        parameters.declare(self, NodeOptions, defaults=self.defaults)
        parameters.declare(self, self.config_class)
        parameters.declare(self, SyncConfig, "sync")
        parameters.refuse_unknown(self)
        self.options = parameters.read(self, NodeOptions)
        self._diagnostics = DiagnosticsPublisher(self, self.health, self._refresh)

    # ---- for the block

    def setup(self) -> None:
        """Build the core and declare inputs with :meth:`listen` (executor thread, on configure)."""
        raise NotImplementedError

    def take(self, kind: str, msg: Any) -> None:
        """Take one decoded message (worker thread)."""
        raise NotImplementedError

    def finish(self) -> None:
        """The input has ended: complete and write everything (worker thread)."""

    def refresh(self) -> None:
        """Bring :attr:`health` up to date before a report (executor thread)."""

    def config(self) -> Any:
        """The block's configuration from the parameters."""
        return parameters.read(self, self.config_class)

    def sync_config(self) -> SyncConfig:
        """The configuration of the sensor inputs from the parameters ``sync.*``."""
        return parameters.read(self, SyncConfig, "sync")

    @property
    def out(self) -> Path | None:
        """The folder for this node's files, made on demand."""
        if not self.options.out:
            return None
        path = Path(self.options.out)
        path.mkdir(parents=True, exist_ok=True)
        return path

    def state(self, name: str) -> Path | None:
        """Where a live node keeps a file that a successor process needs; None: replays keep none."""
        return None if self.out is None or self.options.lossless else self.out / "state" / name

    def snapshot(self, name: str) -> Path | None:
        """The file that a predecessor of this process left under :meth:`state`, if it is to be gone on from."""
        path = self.state(name)
        return path if self.options.resume and path is not None and path.is_file() else None

    def listen(self, topic: Topic, kind: str, keep: int | None = None) -> None:
        """Take in a topic while active; ``keep`` bounds the queue (latest wins), None never drops."""
        self._types[kind] = messages.rclpy_factory(topic.type)
        self._subscriptions_wanted.append((topic, kind, keep))

    def output(self, topic: Topic) -> Publisher:
        """The publisher of a topic, made on the first call."""
        if topic not in self._outputs:
            cls, qos = (
                messages.rclpy_factory(topic.type),
                qos_profile(topic.qos, lossless=self.options.lossless),
            )
            self._outputs[topic] = self.create_publisher(cls, topic.name, qos)
        return self._outputs[topic]

    def wanted(self, topic: Topic) -> bool:
        """Whether anybody listens to an output."""
        return self.output(topic).get_subscription_count() > 0

    def sent(self, stamp_ns: int, count: int = 1) -> None:
        """Count images or bundles sent and let the stream's state say so (0: work goes on)."""
        self._sent += count
        self._publish_state(_RUNNING, stamp_ns)

    def enqueue(self, kind: str, data: Any) -> None:
        """Give the worker a job of its own kind (not a serialised message)."""
        self._inbox.put(kind, data)

    def service(self, kind: type, name: str, callback: Callable[..., Any]) -> None:
        """Offer a service below the node's name; its callback may be a coroutine."""
        self.create_service(kind, f"~/{name}", callback, callback_group=ReentrantCallbackGroup())

    # ---- lifecycle

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Read the parameters and build the core; a configuration error fails the transition."""
        try:
            self.options = parameters.read(self, NodeOptions)
            self._subscriptions_wanted.clear()
            self.setup()
            self.output(topics.stream(self.short))
            if self.options.source == "sensors":
                self.output(topics.consumed(self.short))  # a player looks for it before it sends anything
        except SceneFactoryError as error:
            return self._refuse(str(error))
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Subscribe and start the worker."""
        lossless = self.options.lossless
        self._inbox = Inbox(self._dropped)
        self._received.clear()
        self._sent = self._stalled = 0
        self._announced, self._ended, self._finished = None, False, False
        self._worker = threading.Thread(target=self._work, name=f"{self.short}-worker", daemon=True)
        self._worker.start()
        for topic, kind, keep in self._subscriptions_wanted:
            take = self._receiver(kind, None if lossless else keep)
            qos = qos_profile(topic.qos, lossless=lossless)
            made = self.create_subscription(self._types[kind], topic.name, take, qos, raw=True)
            self._active.append((made, take))
        upstream = topics.stream(self.options.upstream or self._default_upstream())
        state_type = messages.rclpy_factory(upstream.type)
        self._state_subscription = self.create_subscription(
            state_type, upstream.name, self._on_upstream, qos_profile(upstream.qos)
        )
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop listening, let the worker complete what it has, and wait for it."""
        self._unsubscribe()
        self._end_input()
        if self._worker is not None:
            self._worker.join()
        return super().on_deactivate(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Give up the input."""
        self._unsubscribe()
        self.exit_code = self.exit_code or 0
        return TransitionCallbackReturn.SUCCESS

    def stop(self, timeout_s: float) -> bool:
        """End at once: discard the queue, complete the rest; False if that takes longer than the timeout."""
        if self._worker is None or not self._worker.is_alive():
            return True
        if not self._ended:
            self._ended = True
            self._inbox.end(discard=True)
        self._worker.join(timeout_s)
        return not self._worker.is_alive()

    # ---- executor thread

    def _default_upstream(self) -> str:
        return "player" if self.options.source == "sensors" else self.options.source

    def _refuse(self, sentence: str) -> TransitionCallbackReturn:
        self.health.fail(sentence)
        self.get_logger().error(sentence)
        if self.options.autostart:
            self.exit_code = 2
        return TransitionCallbackReturn.FAILURE

    def _receiver(self, kind: str, keep: int | None) -> Callable[[bytes], None]:
        def take(raw: bytes) -> None:
            self._inbox.put(kind, raw, keep)
            self.health.count(f"{kind} received")
            self._received[kind] += 1
            self._stalled = 0
            self._end_if_complete()

        return take

    def _dropped(self, kind: str, raw: bytes, reason: str) -> None:
        self.health.drop(reason)
        if kind == self.leader:
            self._credit(stamp_of(raw))

    def _on_upstream(self, msg: Any) -> None:
        if msg.state != _FINISHED or self._announced is not None:
            return
        self._announced = int(msg.count)
        # The end may overtake messages that already lie in the readers: take them first.
        for subscription, take in self._active:
            while True:
                with subscription.handle:
                    taken = subscription.handle.take_message(subscription.msg_type, True)
                if taken is None:
                    break
                take(taken[0])
        self._end_if_complete()

    def _end_if_complete(self) -> None:
        if self._announced is None or self._ended:
            return
        if self._least_received() >= self._announced:
            self._end_input()

    def _least_received(self) -> int:
        return min((self._received[kind] for kind in self.counted | {self.leader}), default=0)

    def _end_input(self) -> None:
        if not self._ended:
            self._ended = True
            self._inbox.end()

    def _unsubscribe(self) -> None:
        for subscription, _ in self._active:
            self.destroy_subscription(subscription)
        if self._active:
            self.destroy_subscription(self._state_subscription)
        self._active.clear()

    def _refresh(self) -> None:
        if self._announced is not None and not self._ended:
            self._stalled += 1
            lost = self._announced - self._least_received()
            if self._stalled >= _STALL_REPORTS or not self.options.lossless:
                if not self.options.resume:  # what came before the restart was another process's
                    self.health.drop(f"{self.leader} announced by upstream but never received", lost)
                self._end_input()
        self.health.value("queue", len(self._inbox))
        self.health.value("stream", "finished" if self._finished else "running" if self._active else "inactive")
        self.refresh()

    # ---- worker thread

    def _work(self) -> None:
        try:
            while True:
                job = self._inbox.get()
                if job is None:
                    continue
                kind, data = job
                if kind == Inbox.END:
                    break
                self.guarded(lambda kind=kind, data=data: self._handle_raw(kind, data))  # type: ignore[misc]
            self.guarded(self.finish)
            self._finished = True
            self._publish_state(_FINISHED, 0)
        except Exception:
            self.health.fail("this node met a bug and stopped; its log has the details")
            self.get_logger().fatal(traceback.format_exc())
            self.exit_code = 1

    def guarded(self, job: Callable[[], None]) -> None:
        """Run a job; an error that input can cause is reported, and the node goes on."""
        try:
            job()
        except SceneFactoryError as error:
            self.health.error(str(error))
            self.get_logger().error(str(error), throttle_duration_sec=1.0)

    def _handle_raw(self, kind: str, data: Any) -> None:
        if kind not in self._types:
            self.take(kind, data)
            return
        try:
            self.take(kind, deserialize_message(data, self._types[kind]))
        finally:
            if kind == self.leader:
                self._credit(stamp_of(data))

    def _credit(self, stamp_ns: int) -> None:
        if self.options.source == "sensors":
            self.output(topics.consumed(self.short)).publish(messages.to_stamp(messages.rclpy_factory, stamp_ns))

    def _publish_state(self, state: int, stamp_ns: int) -> None:
        topic = topics.stream(self.short)
        stamp = messages.to_stamp(messages.rclpy_factory, stamp_ns)
        message = messages.rclpy_factory(topic.type)(stamp=stamp, state=state, count=self._sent)
        self.output(topic).publish(message)
