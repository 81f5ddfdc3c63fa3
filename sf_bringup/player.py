"""Play a bag into the graph: serialised bytes go out as they were recorded, nothing is decoded.

Paced by log time, or lossless: at most N images are in flight, so a bag plays as fast as its consumers
can take it and none is lost. Header stamps stay untouched; /clock carries log time.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import argparse
import queue
import signal
import struct
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sf_bringup.credits import Credits
from sf_interfaces.errors import ConfigError, FormatError, SceneFactoryError
from sf_interfaces.io.bag import BagReader, RawMessage
from sf_interfaces.ros.messages import COMPRESSED_IMAGE, rclpy_factory, to_ns, to_stamp
from sf_interfaces.topics import CLOCK, GROUND_TRUTH_PREFIX, stream

_IMAGES = ("sensor_msgs/msg/Image", COMPRESSED_IMAGE)
_TICK_NS = 10_000_000  # of simulated time between two /clock messages
_SETTLE_S = 1.0  # matched subscribers must have stopped changing for this long
_GONE_S = 10.0


@dataclass(frozen=True, slots=True)
class PlayOptions:
    """What to play and how.

    Args:
        bag: the bag.
        rate: speed factor; None: 1, or unpaced when lossless.
        loop: start again at the end.
        lossless: wait for credits on ``consumed``.
        consumed: topics of builtin_interfaces/Time on which heads tell what they have taken in.
        in_flight: most images of the head topic that are not yet consumed.
        head: bag topic whose images are counted; None: the first colour image topic.
        topics: bag topics to play; None: all.
        remap: bag topic -> topic to publish on.
        wait_s: longest wait for subscribers, s.
    """

    bag: Path
    rate: float | None = None
    loop: bool = False
    lossless: bool = False
    consumed: tuple[str, ...] = ()
    in_flight: int = 32
    head: str | None = None
    topics: tuple[str, ...] | None = None
    remap: tuple[tuple[str, str], ...] = ()
    wait_s: float = 10.0

    def __post_init__(self) -> None:
        if self.rate is not None and not 0 < self.rate < float("inf"):
            raise ConfigError(f"--rate {self.rate} must be positive")
        if self.in_flight < 1:
            raise ConfigError(f"--in-flight {self.in_flight} must be at least 1")
        if self.lossless and not self.consumed:
            raise ConfigError("--lossless needs --consumed TOPIC, where a head node tells what it has taken in")


def header_stamp(cdr: bytes) -> int:
    """The header stamp of a serialised message that begins with a Header, ns."""
    if len(cdr) < 12:
        raise FormatError("a message is too short to hold a header; record the bag again")
    sec, nanosec = struct.unpack_from("<iI" if cdr[1] & 1 else ">iI", cdr, 4)
    return int(sec) * 1_000_000_000 + int(nanosec)


def choose_head(bag: BagReader, options: PlayOptions) -> str | None:
    """The topic whose images are counted: as asked, else the first colour, else the first image topic."""
    if options.head is not None:
        if options.head not in bag.topics:
            raise FormatError(f"bag {bag.path} has no topic {options.head}; it has {', '.join(bag.topics)}")
        return options.head
    names = sorted(
        t.name
        for t in bag.topics.values()
        if t.type in _IMAGES
        and t.count
        and not t.name.startswith(GROUND_TRUTH_PREFIX)
        and (options.topics is None or t.name in options.topics)
    )
    color = [n for n in names if "depth" not in n]
    return next(iter(color + names), None)


def prefetch(messages: Iterator[RawMessage], size: int = 64) -> Iterator[RawMessage]:
    """The same messages, read ahead by a thread, so that decompression does not delay publication."""
    ahead: queue.Queue[RawMessage | BaseException | None] = queue.Queue(size)
    stop = threading.Event()

    def put(item: RawMessage | BaseException | None) -> None:
        while not stop.is_set():
            try:
                ahead.put(item, timeout=0.1)
                return
            except queue.Full:
                continue

    def read() -> None:
        try:
            for message in messages:
                put(message)
                if stop.is_set():
                    return
            put(None)
        except BaseException as error:
            put(error)

    thread = threading.Thread(target=read, name="prefetch", daemon=True)
    thread.start()
    try:
        while (item := ahead.get()) is not None:
            if isinstance(item, BaseException):
                raise item
            yield item
    finally:
        stop.set()
        thread.join()


class Player:
    """The node that plays. ``run`` returns how many messages went out per topic."""

    def __init__(self, node: Any, executor: Any, bag: BagReader, options: PlayOptions, stop: threading.Event):
        self._node, self._executor, self._bag, self._options, self._stop = node, executor, bag, options, stop
        self._names = dict(options.remap)
        self._head = choose_head(bag, options)
        self._credits = Credits(options.consumed)
        self._images = 0
        self._clock_ns = -(10**18)
        self._clock = self._publisher(CLOCK.name, "rosgraph_msgs/msg/Clock", depth=10)
        self._publishers = self._make_publishers()
        self._stream = self._make_stream()
        for topic in options.consumed:
            self._subscribe_credits(topic)

    def _publisher(self, topic: str, kind: str, depth: int = 200, latched: bool = False) -> Any:
        from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

        durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
        qos = QoSProfile(depth=depth, reliability=ReliabilityPolicy.RELIABLE, durability=durability)
        return self._node.create_publisher(rclpy_factory(kind), topic, qos)

    def _make_publishers(self) -> dict[str, Any]:
        publishers = {}
        for name in self._options.topics or self._bag.topics:
            info = self._bag.topics.get(name)
            if info is None:
                raise FormatError(f"bag {self._bag.path} has no topic {name}; it has {', '.join(self._bag.topics)}")
            if name == CLOCK.name:
                continue
            latched = name.endswith("/tf_static") or "durability: 1" in info.qos
            try:
                publishers[name] = self._publisher(self._names.get(name, name), info.type, latched=latched)
            except FormatError as error:
                print(f"player: leaving out {name}: {error}", file=sys.stderr, flush=True)
        return publishers

    def _make_stream(self) -> Any:
        topic = stream("player")
        try:
            return self._publisher(topic.name, topic.type, depth=1, latched=True)
        except FormatError:
            print(f"player: {topic.type} is not installed; the end is not announced", file=sys.stderr)
            return None

    def _announce(self, finished: bool) -> None:
        if self._stream is not None:
            stamp = to_stamp(rclpy_factory, max(0, self._clock_ns))
            kind = rclpy_factory(stream("player").type)
            self._stream.publish(kind(stamp=stamp, state=int(finished), count=self._images))

    def _subscribe_credits(self, topic: str) -> None:
        kind = rclpy_factory("builtin_interfaces/msg/Time")
        self._node.create_subscription(kind, topic, lambda msg: self._credits.consumed(topic, to_ns(msg)), 1000)

    def _check_stop(self) -> None:
        """End here when asked to. Raised by the signal itself, it would be lost inside a callback of DDS."""
        if self._stop.is_set():
            raise KeyboardInterrupt

    def _spin(self, seconds: float) -> None:
        self._check_stop()
        self._executor.spin_once(timeout_sec=max(0.0, seconds))

    def wait_for_subscribers(self) -> None:
        """Until the head topic (any topic, where there is none) has a subscriber, and lossless those who give credits.

        Raises:
            ConfigError: lossless, and nobody came.
        """
        head = self._publishers.get(self._head or "")
        deadline, last, since = time.monotonic() + self._options.wait_s, None, time.monotonic()
        while time.monotonic() < deadline:
            counts = [p.get_subscription_count() for p in self._publishers.values()]
            credits = [self._node.count_publishers(topic) for topic in self._options.consumed]
            if counts + credits != last:
                last, since = counts + credits, time.monotonic()
            there = head.get_subscription_count() if head is not None else sum(counts)
            if there and all(credits) and time.monotonic() - since > _SETTLE_S:
                return
            self._spin(0.05)
        missing = [f"published on {t}" for t in self._options.consumed if not self._node.count_publishers(t)]
        missing.append(f"subscribed to {self._head or 'any topic'}")
        words = f"nobody {missing[0]} within {self._options.wait_s:g} s"
        if self._options.lossless:
            raise ConfigError(f"{words}; start the consumer first, or raise --wait")
        print(f"player: {words}; playing all the same", file=sys.stderr, flush=True)

    def _tick(self, now_ns: int) -> None:
        if now_ns - self._clock_ns >= _TICK_NS or now_ns < self._clock_ns:
            self._clock_ns = now_ns
            self._clock.publish(rclpy_factory("rosgraph_msgs/msg/Clock")(clock=to_stamp(rclpy_factory, now_ns)))

    def _pace(self, stamp_ns: int, start_ns: int, start_wall: float) -> None:
        """Sleep until a log time is due, while the clock goes on."""
        rate = self._options.rate or (None if self._options.lossless else 1.0)
        while rate is not None:
            self._check_stop()
            elapsed = int((time.monotonic() - start_wall) * rate * 1e9)
            if start_ns + elapsed >= stamp_ns:
                break
            self._tick(start_ns + elapsed)
            left = (stamp_ns - start_ns - elapsed) / 1e9 / rate
            time.sleep(min(left, _TICK_NS / 1e9 / rate))
        self._tick(stamp_ns)

    def _wait_for_credit(self, limit: int) -> None:
        alone = time.monotonic()
        self._spin(0)
        while self._credits.in_flight > limit:
            self._spin(0.05)
            if all(self._node.count_publishers(topic) for topic in self._options.consumed):
                alone = time.monotonic()
            elif time.monotonic() - alone > _GONE_S:
                raise ConfigError(
                    f"no node has published on {', '.join(self._options.consumed)} for {_GONE_S:g} s with "
                    f"{self._credits.in_flight} images in flight; start the consumer again"
                )

    def _play_once(self, counts: Counter[str]) -> None:
        start_wall, start_ns = time.monotonic(), None
        for message in prefetch(self._bag.messages(list(self._publishers))):
            self._check_stop()
            start_ns = message.stamp_ns if start_ns is None else start_ns
            self._pace(message.stamp_ns, start_ns, start_wall)
            if message.topic == self._head:
                if self._options.lossless:
                    self._wait_for_credit(self._options.in_flight - 1)
                    self._credits.sent(header_stamp(message.data))
                self._images += 1
            self._publishers[message.topic].publish(message.data)
            counts[message.topic] += 1

    def run(self) -> Counter[str]:
        """Play to the end."""
        from rclpy.duration import Duration

        counts: Counter[str] = Counter()
        self.wait_for_subscribers()
        self._announce(finished=False)
        while True:
            self._play_once(counts)
            if not self._options.loop:
                break
        for publisher in self._publishers.values():
            publisher.wait_for_all_acked(Duration(seconds=5))
        if self._options.lossless:
            self._wait_for_credit(0)
        self._announce(finished=True)
        if self._stream is not None:
            self._stream.wait_for_all_acked(Duration(seconds=5))
        return counts


def parse(args: list[str] | None) -> PlayOptions:
    """Options from the command line."""
    parser = argparse.ArgumentParser(prog="sf play", description="Play a bag into the ROS graph.")
    parser.add_argument("bag", type=Path)
    parser.add_argument("--rate", type=float, help="speed factor (default 1; lossless: as fast as possible)")
    parser.add_argument("--loop", action="store_true")
    parser.add_argument("--lossless", action="store_true", help="keep at most N images in flight")
    parser.add_argument("--consumed", nargs="+", default=[], metavar="TOPIC", help="credit topics")
    parser.add_argument("--in-flight", type=int, default=32, metavar="N")
    parser.add_argument("--head", metavar="TOPIC", help="image topic that is counted")
    parser.add_argument("--topics", nargs="+", metavar="TOPIC")
    parser.add_argument("--remap", nargs="+", default=[], metavar="FROM:=TO")
    parser.add_argument("--wait", type=float, default=10.0, metavar="S", help="longest wait for subscribers")
    given = parser.parse_args(args)
    pairs = [tuple(rule.split(":=")) for rule in given.remap]
    if any(len(pair) != 2 or not all(pair) for pair in pairs):
        raise ConfigError("--remap rules must read FROM:=TO")
    return PlayOptions(
        given.bag, given.rate, given.loop, given.lossless, tuple(given.consumed), given.in_flight, given.head,
        tuple(given.topics) if given.topics else None, tuple((a, b) for a, b in pairs), given.wait,
    )  # fmt: skip


def play(options: PlayOptions) -> Counter[str]:
    """Play a bag in a node of its own; counts per bag topic.

    Raises:
        KeyboardInterrupt: SIGINT came, and this is the main thread.
    """
    import rclpy
    from rclpy.executors import SingleThreadedExecutor

    stop = threading.Event()
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, lambda *_: stop.set())
    with BagReader(options.bag) as bag:
        context = rclpy.Context()
        rclpy.init(context=context)
        try:
            node = rclpy.create_node("player", namespace="/sf", context=context)
            executor = SingleThreadedExecutor(context=context)
            executor.add_node(node)
            return Player(node, executor, bag, options, stop).run()
        finally:
            rclpy.try_shutdown(context=context)


def main(args: list[str] | None = None) -> int:
    """Command line; exit code 0 done, 2 bad input."""
    try:
        counts = play(parse(args))
    except SceneFactoryError as error:
        print(f"sf play: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 0
    print(f"played {sum(counts.values())} messages on {len(counts)} topics")
    return 0


if __name__ == "__main__":
    sys.exit(main())
