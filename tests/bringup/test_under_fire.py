"""Recordings under fire: full disk, slow disk, a killed writer, ten thousand messages a second, huge clouds."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from sf_bringup.launcher_env import node_environment
from sf_bringup.recorder import WriterThread, _Item
from sf_interfaces.io.bag import BagReader
from sf_interfaces.io.mcap_writer import McapWriter

TYPE = "std_msgs/msg/UInt8MultiArray"
HEAD = b"\x00\x01\x00\x00" + (0).to_bytes(4, "little") * 2  # CDR of an empty layout


def message(payload: bytes) -> bytes:
    return HEAD + len(payload).to_bytes(4, "little") + payload


def item(index: int, payload: bytes, topic: str = "/bytes") -> _Item:
    return _Item(topic, TYPE, 1 + index, 1 + index, "", message(payload))


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=8m", "tmpfs", str(disk)], capture_output=True)
    if mounted.returncode:
        pytest.skip(f"a small tmpfs cannot be mounted here: {mounted.stderr.decode().strip()}")
    yield disk
    subprocess.run(["umount", "-l", str(disk)], check=True)


def test_a_full_disk_keeps_what_was_written_and_counts_the_rest(small_disk: Path) -> None:
    rng = np.random.default_rng(0)
    payloads = [rng.bytes(300_000) for _ in range(60)]  # 18 MB that do not compress
    writer = McapWriter(small_disk / "full.mcap", chunk_bytes=1 << 20)
    sink = WriterThread(writer)
    for i, payload in enumerate(payloads):
        sink.put(item(i, payload))
    sink.finish()
    assert sink.error is not None and "space" in str(sink.error)
    with BagReader(small_disk / "full.mcap") as bag:
        read = [raw.data for raw in bag.messages()]
    assert len(read) > 20 and read == [message(p) for p in payloads[: len(read)]]
    assert len(read) + sink.dropped["/bytes"] >= len(payloads), "every message is in the file or counted"
    # The record that the disk cut short may hold whole messages that the count calls lost, never the reverse.
    assert len(read) + sink.dropped["/bytes"] <= len(payloads) + 4
    print(f"8 MB disk, 60 messages of 0.3 MB: {len(read)} readable, {sink.dropped['/bytes']} counted as lost")


def test_the_recorder_says_that_the_disk_is_full(small_disk: Path) -> None:
    rclpy = pytest.importorskip("rclpy")
    from std_msgs.msg import UInt8MultiArray

    domain = 120 + os.getpid() % 80
    environment = node_environment(domain) | {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    command = [sys.executable, "-m", "sf_bringup.recorder", str(small_disk / "r.mcap"), "--topics", "/bytes"]
    recorder = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    try:
        node = rclpy.create_node("source", context=context)
        publisher = node.create_publisher(UInt8MultiArray, "/bytes", 100)
        rng, deadline = np.random.default_rng(0), time.monotonic() + 60
        while recorder.poll() is None and time.monotonic() < deadline:
            publisher.publish(message(rng.bytes(400_000)))
            time.sleep(0.02)
        _, said = recorder.communicate(timeout=30)
    finally:
        recorder.kill()
        rclpy.try_shutdown(context=context)
    assert recorder.returncode == 2 and "free disk space" in said and "readable" in said and "Traceback" not in said
    with BagReader(small_disk / "r.mcap") as bag:
        assert bag.torn and bag.topics["/bytes"].count > 0


class SlowFile:
    """A disk that needs a moment for every write."""

    def __init__(self, file: object, gate: threading.Event) -> None:
        self._file, self._gate = file, gate

    def write(self, data: bytes) -> int:
        self._gate.wait()
        return self._file.write(data)  # type: ignore[attr-defined, no-any-return]

    def __getattr__(self, name: str) -> object:
        return getattr(self._file, name)


def test_a_slow_disk_drops_beyond_its_backlog_and_counts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    writer, gate = McapWriter(tmp_path / "slow.mcap", chunk_bytes=1000), threading.Event()
    writer._file = SlowFile(writer._file, gate)  # type: ignore[assignment]
    sink = WriterThread(writer, backlog=20_000)
    for i in range(100):
        sink.put(item(i, bytes(1000)))
    dropped = sink.dropped["/bytes"]
    assert 70 < dropped < 100 and "the disk is too slow" in capsys.readouterr().err
    gate.set()
    sink.finish()
    writer.close()
    with BagReader(tmp_path / "slow.mcap") as bag:
        assert bag.topics["/bytes"].count == 100 - dropped
    print(
        f"a disk that stands still, backlog of 20 kB, 100 messages of 1 kB: {100 - dropped} written, {dropped} counted"
    )


def test_a_killed_writer_loses_only_its_last_chunk(tmp_path: Path) -> None:
    code = (
        "import sys; sys.path.insert(0, sys.argv[2])\n"
        "from pathlib import Path; from test_under_fire import McapWriter, message, TYPE\n"
        "w = McapWriter(Path(sys.argv[1]), chunk_bytes=20000)\n"
        "for i in range(10**9):\n"
        "    w.write('/bytes', TYPE, i + 1, message(i.to_bytes(8, 'little') * 100)); print(i, flush=True)\n"
    )
    path = tmp_path / "killed.mcap"
    command = [sys.executable, "-c", code, str(path), str(Path(__file__).parent)]
    writer = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert writer.stdout is not None
    said = -1
    while said < 500:
        said = int(writer.stdout.readline())
    writer.send_signal(signal.SIGKILL)
    said = int((writer.stdout.read().split() or [said])[-1])
    writer.wait()
    with BagReader(path) as bag:
        read = [int.from_bytes(raw.data[16:24], "little") for raw in bag.messages()]
    assert read == list(range(len(read))) and said - len(read) < 2 * 20_000 // 800
    print(f"SIGKILL while writing chunks of 20 kB: {len(read)} of {said + 1} messages readable")


def test_ten_thousand_tiny_messages_are_recorded_or_counted(tmp_path: Path) -> None:
    rclpy = pytest.importorskip("rclpy")
    from std_msgs.msg import UInt8MultiArray

    domain, count = 120 + (os.getpid() + 7) % 80, 10_000
    environment = node_environment(domain) | {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    out = tmp_path / "tiny.mcap"
    command = [sys.executable, "-m", "sf_bringup.recorder", str(out), "--json", "--topics", "/tiny"]
    recorder = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    try:
        node = rclpy.create_node("source", context=context)
        publisher = node.create_publisher(UInt8MultiArray, "/tiny", 1000)
        deadline = time.monotonic() + 60
        while not publisher.get_subscription_count() and time.monotonic() < deadline:
            time.sleep(0.05)
        begin = time.monotonic()
        for i in range(count):
            publisher.publish(message(i.to_bytes(4, "little")))
            time.sleep(max(0.0, begin + i / 10_000 - time.monotonic()) if i % 50 == 0 else 0)
        publisher.wait_for_all_acked(rclpy.duration.Duration(seconds=30))
        recorder.send_signal(signal.SIGINT)
        result = json.loads(recorder.communicate(timeout=60)[0])["topics"]["/tiny"]
    finally:
        recorder.kill()
        rclpy.try_shutdown(context=context)
    assert result["count"] + result["dropped"] >= count * 0.999, result
    with BagReader(out) as bag:
        read = [int.from_bytes(raw.data[16:20], "little") for raw in bag.messages(["/tiny"])]
    assert read == sorted(read) and len(read) == result["count"]
    print(f"10,000 messages a second: {result['count']} recorded, {result['dropped']} counted as lost")


@pytest.mark.slow
def test_a_cloud_of_256_megabytes_survives_the_file(tmp_path: Path) -> None:
    """2 GB take the same path: all lengths in the file are 64 bit. SF_HUGE=1 tries them."""
    size = (2 << 30) if os.environ.get("SF_HUGE") else (256 << 20)
    payload = np.zeros(size, np.uint8)
    payload[:: 1 << 20] = np.arange(len(payload[:: 1 << 20])) % 251
    with McapWriter(tmp_path / "huge.mcap") as writer:
        writer.write("/huge", TYPE, 1, HEAD + size.to_bytes(4, "little") + payload.tobytes())
        writer.write("/small", TYPE, 2, message(b"after"))
    with BagReader(tmp_path / "huge.mcap") as bag:
        huge, small = bag.messages()
        np.testing.assert_array_equal(np.frombuffer(huge.data, np.uint8)[16:], payload)
        assert small.data == message(b"after")
    print(f"a message of {size >> 20} MB and one after it: both read back as they were")
