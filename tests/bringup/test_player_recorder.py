"""Player and recorder: pure parts, and a bag played from one process into another's recording."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from sf_bringup.launcher_env import node_environment
from sf_bringup.player import Credits, PlayOptions, choose_head, header_stamp, parse, prefetch
from sf_bringup.player import main as play_main
from sf_bringup.recorder import main as record_main
from sf_interfaces.errors import ConfigError
from sf_interfaces.io.bag import BagReader
from sf_interfaces.io.sequence_writer import SequenceWriter
from sf_interfaces.types import DepthMap

START = 1_700_000_000_000_000_000


@pytest.fixture
def sample(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    with SequenceWriter(tmp_path / "in.mcap") as writer:
        writer.pose("/pose", START, np.eye(4), "map")
        for i in range(40):
            stamp = START + i * 25_000_000
            writer.depth("/camera/depth/image_raw", stamp, DepthMap(np.ones((20, 30))), "cam")
            color = rng.integers(0, 256, (20, 30, 3), dtype=np.uint8)
            writer.image("/camera/color/image_raw", stamp, color, "cam")
    return tmp_path / "in.mcap"


def test_head_and_stamps(sample: Path) -> None:
    with BagReader(sample) as bag:
        assert choose_head(bag, PlayOptions(sample)) == "/camera/color/image_raw"
        only = PlayOptions(sample, topics=("/camera/depth/image_raw",))
        assert choose_head(bag, only) == "/camera/depth/image_raw"
        messages = list(prefetch(bag.messages(["/camera/color/image_raw"]), size=3))
        assert [header_stamp(r.data) for r in messages] == [START + i * 25_000_000 for i in range(40)]


def test_prefetch_passes_errors_on_and_stops_early() -> None:
    def broken():  # type: ignore[no-untyped-def]
        yield 1
        raise ValueError("torn")

    with pytest.raises(ValueError, match="torn"):
        list(prefetch(broken()))
    endless = prefetch(iter(range(10**9)), size=2)  # type: ignore[arg-type]
    assert next(endless) == 0
    endless.close()


def test_credits_count_the_slowest_consumer() -> None:
    ledger = Credits(("/a", "/b"))
    for stamp in (10, 20, 30):
        ledger.sent(stamp)
    ledger.consumed("/a", 20)
    assert ledger.in_flight == 3
    ledger.consumed("/b", 30)
    assert ledger.in_flight == 1
    assert Credits(()).in_flight == 0


def test_bad_command_lines(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert play_main([str(tmp_path / "none.mcap")]) == 2
    assert "does not exist" in capsys.readouterr().err
    assert record_main([str(tmp_path / "a.mcap")]) == 2
    for words in (["--rate", "0"], ["--lossless"], ["--remap", "/a"], ["--in-flight", "0"]):
        with pytest.raises(ConfigError):
            parse(["bag", *words])
    assert parse(["bag", "--remap", "/a:=/b"]).remap == (("/a", "/b"),)


def start_recorder(out: Path, domain: int, *more: str) -> tuple[subprocess.Popen[str], dict[str, str]]:
    environment = node_environment(domain) | {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    command = [sys.executable, "-m", "sf_bringup.recorder", str(out), "--json", *more]
    process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)
    return process, environment


def play(bag: Path, environment: dict[str, str], *more: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "sf_bringup.player", str(bag), *more]
    return subprocess.run(command, env=environment, timeout=40, capture_output=True, text=True)


@pytest.mark.parametrize("as_folder", [False, True])
def test_a_bag_survives_playing_and_recording(sample: Path, tmp_path: Path, as_folder: bool) -> None:
    pytest.importorskip("rclpy")
    out = tmp_path / ("rec" if as_folder else "rec.mcap")
    (tmp_path / "info.json").write_text(json.dumps({"version": "1", "plan": ["a"]}))
    extra = ["--metadata", f"scenefactory={tmp_path / 'info.json'}", "--attach", str(tmp_path / "info.json")]
    recorder, environment = start_recorder(out, 60 + os.getpid() % 20, "--all", *extra)
    try:
        played = play(sample, environment, "--rate", "2", "--remap", "/pose:=/other")
        assert played.returncode == 0, played.stderr
        time.sleep(0.5)
        recorder.send_signal(signal.SIGTERM)
        result = json.loads(recorder.communicate(timeout=20)[0])
    finally:
        recorder.kill()
    assert recorder.returncode == 0
    assert result["topics"]["/camera/color/image_raw"]["count"] == 40
    topics = ["/camera/color/image_raw", "/camera/depth/image_raw"]
    with BagReader(sample) as before, BagReader(out) as after:
        for topic in topics:
            sent = [r.data for r in before.messages([topic])]
            assert [r.data for r in after.messages([topic])] == sent
        assert after.topics["/other"].count == 1 and "/clock" in after.topics


def test_a_killed_recorder_leaves_a_readable_file(sample: Path, tmp_path: Path) -> None:
    pytest.importorskip("rclpy")
    out = tmp_path / "rec.mcap"
    recorder, environment = start_recorder(out, 80 + os.getpid() % 20, "--topics", "/camera/color/image_raw")
    try:
        assert play(sample, environment, "--rate", "2").returncode == 0
        time.sleep(2.0)
    finally:
        recorder.kill()
        recorder.communicate()
    with BagReader(out) as bag:
        assert bag.torn and bag.topics["/camera/color/image_raw"].count == 40


def test_lossless_play_waits_for_credits(sample: Path) -> None:
    """A consumer that gives one credit per 20 ms never has more than N images waiting, and gets all."""
    rclpy = pytest.importorskip("rclpy")
    from builtin_interfaces.msg import Time
    from rclpy.executors import SingleThreadedExecutor
    from sensor_msgs.msg import Image

    domain = 40 + os.getpid() % 20
    environment = node_environment(domain) | {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    node = rclpy.create_node("consumer", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    waiting: list[Time] = []
    received, most = 0, 0
    topic = "/camera/color/image_raw"
    node.create_subscription(Image, topic, lambda msg: waiting.append(msg.header.stamp), 100)
    credit = node.create_publisher(Time, "/sf/test/consumed", 100)
    command = [sys.executable, "-m", "sf_bringup.player", str(sample), "--lossless", "--in-flight", "4"]
    player = subprocess.Popen([*command, "--consumed", "/sf/test/consumed"], env=environment)
    try:
        until = time.monotonic() + 30
        while player.poll() is None and time.monotonic() < until:
            executor.spin_once(timeout_sec=0.02)
            while len(waiting) > most and executor.spin_once(timeout_sec=0.02) is None and len(waiting) > most:
                most = len(waiting)
            if waiting:
                time.sleep(0.02)
                credit.publish(waiting.pop(0))
                received += 1
        assert player.wait(timeout=5) == 0
        assert received == 40 and 1 < most <= 4
    finally:
        player.kill()
        rclpy.try_shutdown(context=context)
