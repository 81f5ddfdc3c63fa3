"""Record topics into an mcap bag: serialised bytes are written as they come, nothing is decoded.

Log time is the time of reception on the node's clock (simulated time with ``--use-sim-time``). The file is
finished on SIGINT and SIGTERM; after SIGKILL, or on a full disk, everything but the last second is readable.
What the network or a slow disk loses is counted per topic and said.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import argparse
import json
import queue
import signal
import sys
import threading
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sf_bringup.bag_metadata import write_bag_metadata
from sf_interfaces.errors import ConfigError, FormatError, SceneFactoryError
from sf_interfaces.io.mcap_writer import McapWriter, qos_yaml
from sf_interfaces.ros.messages import rclpy_factory

_FLUSH_S = 1.0
_DISCOVER_S = 0.25
_BACKLOG_BYTES = 1 << 30  # messages waiting for the disk; beyond it they are dropped and counted


@dataclass(frozen=True, slots=True)
class RecordOptions:
    """What to record and where.

    Args:
        out: a .mcap file, or a folder, which becomes a rosbag2 bag with metadata.yaml.
        topics: topics to record; None: every topic, also those that appear later.
        compression: "zstd" or "" (none).
        level: zstd level.
        attach: files to attach at the end.
        metadata: record name -> JSON file of strings, written at the end.
        use_sim_time: log time is simulated time.
        duration_s: stop after this long; None: until a signal.
    """

    out: Path
    topics: tuple[str, ...] | None = None
    compression: str = "zstd"
    level: int = 1
    attach: tuple[Path, ...] = ()
    metadata: tuple[tuple[str, Path], ...] = ()
    use_sim_time: bool = False
    duration_s: float | None = None


@dataclass(frozen=True, slots=True)
class _Item:
    topic: str
    type: str
    stamp_ns: int
    publish_ns: int
    qos: str
    data: bytes


class WriterThread:
    """Writes to disk beside the executor, which only enqueues. Drops, counted, beyond the backlog.

    Args:
        backlog: bytes that may wait for the disk.
    """

    def __init__(self, writer: McapWriter, backlog: int = _BACKLOG_BYTES):
        self._writer, self._backlog = writer, backlog
        self._items: queue.SimpleQueue[_Item | None] = queue.SimpleQueue()
        self._waiting = 0
        self._lock = threading.Lock()
        self.dropped: Counter[str] = Counter()
        self.error: OSError | None = None
        self._thread = threading.Thread(target=self._run, name="writer", daemon=True)
        self._thread.start()

    def put(self, item: _Item) -> None:
        """Hand over one message."""
        with self._lock:
            # One message may be larger than the whole backlog; alone it passes.
            full = self._waiting and self._waiting + len(item.data) > self._backlog
            if full or self.error is not None:
                self.lost(item.topic, 1, "the disk is too slow" if self.error is None else "the disk failed")
                return
            self._waiting += len(item.data)
        self._items.put(item)

    def lost(self, topic: str, count: int, why: str) -> None:
        """Count messages that are not in the file, and say so at the first of a topic."""
        if not self.dropped[topic]:
            print(f"recorder: losing messages of {topic}: {why}", file=sys.stderr, flush=True)
        self.dropped[topic] += count

    def _run(self) -> None:
        flushed = time.monotonic()
        try:
            while True:
                try:
                    item = self._items.get(timeout=_FLUSH_S / 2)
                    if item is None:
                        return
                    self._writer.write(
                        item.topic, item.type, item.stamp_ns, item.data,
                        qos=item.qos, publish_time_ns=item.publish_ns,
                    )  # fmt: skip
                    with self._lock:
                        self._waiting -= len(item.data)
                except queue.Empty:
                    pass
                if time.monotonic() - flushed > _FLUSH_S:
                    self._writer.flush()
                    flushed = time.monotonic()
        except OSError as error:
            self.error = error
            self.dropped.update(self._writer.unwritten)
            while not self._items.empty():
                waiting = self._items.get()
                if waiting is not None:
                    self.dropped[waiting.topic] += 1

    def finish(self) -> None:
        """Write what waits and stop."""
        self._items.put(None)
        self._thread.join()


class Recorder:
    """The node that records."""

    def __init__(self, node: Any, sink: WriterThread, options: RecordOptions):
        self._node, self._sink, self._options = node, sink, options
        self._subscriptions: dict[str, Any] = {}
        self._refused: set[str] = set()
        node.create_timer(_DISCOVER_S, self.discover)
        self.discover()

    def discover(self) -> None:
        """Subscribe to wanted topics that have a publisher by now."""
        for name, types in self._node.get_topic_names_and_types():
            wanted = self._options.topics is None or name in self._options.topics
            if not wanted or name in self._subscriptions or name in self._refused:
                continue
            publishers = self._node.get_publishers_info_by_topic(name)
            if publishers:
                self._subscribe(name, types[0], [p.qos_profile for p in publishers])

    def _subscribe(self, topic: str, kind: str, offered: list[Any]) -> None:
        from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

        try:
            rclpy_factory(kind)
        except FormatError as error:
            self._refused.add(topic)
            print(f"recorder: leaving out {topic}: {error}", file=sys.stderr, flush=True)
            return
        reliable = all(q.reliability == ReliabilityPolicy.RELIABLE for q in offered)
        latched = all(q.durability == DurabilityPolicy.TRANSIENT_LOCAL for q in offered)
        qos = QoSProfile(
            depth=1000,
            reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        )
        self._subscriptions[topic] = _Intake(self._node, self._sink, topic, kind, qos, self._options.use_sim_time)
        print(f"recorder: recording {topic} ({kind})", file=sys.stderr, flush=True)


class _Intake:
    """One subscription: takes serialised messages as fast as they come, and notices those that never came."""

    def __init__(self, node: Any, sink: WriterThread, topic: str, kind: str, qos: Any, sim_time: bool) -> None:
        from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

        self._node, self._sink, self._topic, self._kind, self._sim_time = node, sink, topic, kind, sim_time
        self._profiles = qos_yaml(
            qos.reliability == ReliabilityPolicy.RELIABLE, qos.durability == DurabilityPolicy.TRANSIENT_LOCAL
        )
        self._sequence = 0  # of the publisher's messages, where there is one publisher
        self._subscription = node.create_subscription(rclpy_factory(kind), topic, self._take, qos, raw=True)

    def _take(self, data: bytes, info: dict[str, Any]) -> None:
        self._put(data, info)
        # The executor looks at everything between two messages; at thousands a second they have to be taken at once.
        while True:
            with self._subscription.handle:
                taken = self._subscription.handle.take_message(self._subscription.msg_type, True)
            if taken is None:
                return
            self._put(*taken)

    def _put(self, data: bytes, info: dict[str, Any]) -> None:
        stamp = self._node.get_clock().now().nanoseconds
        published = int(info.get("source_timestamp", 0))
        if self._sim_time or published <= 0:
            published = stamp
        self._count_gap(int(info.get("publication_sequence_number") or 0))
        self._sink.put(_Item(self._topic, self._kind, stamp, published, self._profiles, bytes(data)))

    def _count_gap(self, sequence: int) -> None:
        """Numbers of several publishers interleave and say nothing; a publisher that starts again begins at 1."""
        missing = sequence - self._sequence - 1
        if self._sequence and missing > 0 and self._node.count_publishers(self._topic) == 1:
            self._sink.lost(self._topic, missing, "they did not arrive in time")
        self._sequence = sequence


def _strings(path: Path) -> dict[str, str]:
    """A JSON object as strings: text stays text, everything else is JSON again."""
    try:
        values = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise FormatError(f"cannot read metadata {path}: {error}; give a JSON object") from error
    if not isinstance(values, dict):
        raise FormatError(f"metadata {path} must hold one JSON object")
    return {k: v if isinstance(v, str) else json.dumps(v) for k, v in values.items()}


def _finish(writer: McapWriter, options: RecordOptions) -> None:
    """Metadata and attachments at the end; files that are missing by then are named, the bag is kept."""
    problems = []
    for name, path in options.metadata:
        try:
            writer.metadata(name, _strings(path))
        except FormatError as error:
            problems.append(str(error))
    for path in options.attach:
        try:
            writer.attachment(path.name, path.read_bytes())
        except OSError as error:
            problems.append(f"cannot attach {path}: {error.strerror}; give an existing file")
    writer.close()
    if options.out.suffix != ".mcap":
        write_bag_metadata(options.out, writer)
    if problems:
        raise FormatError("; ".join(problems))


def record(options: RecordOptions) -> dict[str, Any]:
    """Record until SIGINT, SIGTERM or the duration; statistics per topic.

    Raises:
        FormatError: the file cannot be written, or something to attach is missing.
    """
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.parameter import Parameter
    from rclpy.signals import SignalHandlerOptions

    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    path = options.out if options.out.suffix == ".mcap" else options.out / f"{options.out.name}_0.mcap"
    writer = McapWriter(path, options.compression, options.level)
    sink = WriterThread(writer)
    context = rclpy.Context()
    rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
    began = time.monotonic()
    try:
        overrides = [Parameter("use_sim_time", Parameter.Type.BOOL, options.use_sim_time)]
        node = rclpy.create_node("recorder", namespace="/sf", context=context, parameter_overrides=overrides)
        Recorder(node, sink, options)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        while not stop.is_set() and sink.error is None:
            executor.spin_once(timeout_sec=0.1)
            if options.duration_s is not None and time.monotonic() - began > options.duration_s:
                break
        until = time.monotonic() + 0.3  # what has arrived by now is still taken
        while time.monotonic() < until:
            executor.spin_once(timeout_sec=0.02)
    finally:
        rclpy.try_shutdown(context=context)
        sink.finish()
    if sink.error is not None:
        raise FormatError(
            f"cannot write {path}: {sink.error.strerror}; {sum(sink.dropped.values())} messages after that are lost, "
            "what was written before is readable; free disk space"
        )
    _finish(writer, options)
    seconds = max((writer.end_ns - writer.start_ns) / 1e9, 1e-9)
    topics = {
        t: {"count": n, "bytes": writer.bytes[t], "hz": n / seconds, "dropped": sink.dropped[t]}
        for t, n in sorted(writer.counts.items())
    }
    return {"file": str(path), "seconds": seconds, "file_bytes": path.stat().st_size, "topics": topics}


def table(result: dict[str, Any]) -> str:
    """The statistics as a table."""
    rows = [f"{'topic':40} {'count':>8} {'MB':>9} {'Hz':>8} {'dropped':>8}"]
    for name, s in result["topics"].items():
        rows.append(f"{name:40} {s['count']:8} {s['bytes'] / 1e6:9.1f} {s['hz']:8.1f} {s['dropped']:8}")
    rows.append(f"{result['file']}: {result['file_bytes'] / 1e6:.1f} MB, {result['seconds']:.1f} s")
    return "\n".join(rows)


def parse(args: list[str] | None) -> tuple[RecordOptions, bool]:
    """Options from the command line, and whether JSON is wanted."""
    parser = argparse.ArgumentParser(prog="sf record", description="Record topics into an mcap bag.")
    parser.add_argument("out", type=Path, help=".mcap file, or folder for a rosbag2 bag")
    parser.add_argument("--topics", nargs="+", metavar="TOPIC")
    parser.add_argument("--all", action="store_true", help="every topic, also later ones")
    parser.add_argument("--compression", choices=("zstd", "none"), default="zstd")
    parser.add_argument("--level", type=int, default=1, help="zstd level")
    parser.add_argument("--attach", nargs="+", type=Path, default=[], metavar="FILE")
    parser.add_argument("--metadata", nargs="+", default=[], metavar="NAME=FILE.json")
    parser.add_argument("--use-sim-time", action="store_true")
    parser.add_argument("--duration", type=float, metavar="S")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args(args)
    if bool(given.topics) == given.all:
        raise ConfigError("say what to record: --topics TOPIC ... or --all")
    pairs = [rule.partition("=") for rule in given.metadata]
    if not all(name and file for name, _, file in pairs):
        raise ConfigError("--metadata must read NAME=FILE.json")
    options = RecordOptions(
        given.out, None if given.all else tuple(given.topics), "" if given.compression == "none" else "zstd",
        given.level, tuple(given.attach), tuple((name, Path(file)) for name, _, file in pairs),
        given.use_sim_time, given.duration,
    )  # fmt: skip
    return options, given.json


def main(args: list[str] | None = None) -> int:
    """Command line; exit code 0 done, 2 bad input."""
    try:
        options, as_json = parse(args)
        result = record(options)
    except SceneFactoryError as error:
        print(f"sf record: {error}", file=sys.stderr)
        return 2
    print(json.dumps(result) if as_json else table(result))
    return 0


if __name__ == "__main__":
    sys.exit(main())
