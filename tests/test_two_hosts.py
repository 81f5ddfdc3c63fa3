"""A line on two hosts: two network namespaces with shared memory of their own, and a link that is cut for a while."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import os
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.live_stage import Stage, make_frames

pytestmark = [pytest.mark.graph, pytest.mark.slow, pytest.mark.timeout(900)]
pytest.importorskip("rclpy")
ROBOT, STATION = f"sf_a{os.getpid()}", f"sf_b{os.getpid()}"
CUT_S = 5.0


def ip(*words: str, check: bool = True) -> subprocess.CompletedProcess[str]:
    try:
        return subprocess.run(["ip", *words], capture_output=True, text=True, check=check)
    except (OSError, subprocess.CalledProcessError) as error:
        pytest.skip(f"network namespaces are not permitted here: {getattr(error, 'stderr', error)}")


def inside(namespace: str, *words: str) -> None:
    ip("netns", "exec", namespace, "ip", *words)


def plug(namespace: str, end: str) -> None:
    inside(namespace, "link", "set", end, "up")
    inside(namespace, "route", "replace", "224.0.0.0/4", "dev", end)


@contextmanager
def host(namespace: str) -> Iterator[list[str]]:
    """Words that run a command on a host: a network namespace with one /dev/shm for all its processes."""
    ready = "mount -t tmpfs -o size=1g tmpfs /dev/shm && echo ready && exec sleep infinity"
    command = ["ip", "netns", "exec", namespace, "unshare", "-m", "sh", "-c", ready]
    holder = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert holder.stdout is not None
    try:
        if holder.stdout.readline().strip() != "ready":
            pytest.skip("a /dev/shm per host cannot be mounted here")
        yield ["nsenter", "-t", str(holder.pid), "-m", "-n"]
    finally:
        holder.kill()
        holder.wait()


@pytest.fixture
def hosts() -> Iterator[tuple[list[str], list[str]]]:
    if os.geteuid() != 0:
        pytest.skip("network namespaces need root")
    try:
        for namespace in (ROBOT, STATION):
            ip("netns", "add", namespace)
        ip("link", "add", "sf_a", "netns", ROBOT, "type", "veth", "peer", "name", "sf_b", "netns", STATION)
        for namespace, end, address in ((ROBOT, "sf_a", "10.99.0.1/24"), (STATION, "sf_b", "10.99.0.2/24")):
            inside(namespace, "link", "set", "lo", "up")
            inside(namespace, "addr", "add", address, "dev", end)
            plug(namespace, end)
        with host(ROBOT) as robot, host(STATION) as station:
            yield robot, station
    finally:
        for namespace in (ROBOT, STATION):
            ip("netns", "del", namespace, check=False)


def newest(stage: Stage) -> int:
    """Stamp of the last keyframe in the map of a host, ns."""
    path = stage.out / "state" / "recon.json"
    return int(json.loads(path.read_text())["stamp_ns"]) if path.is_file() else 0


def test_a_line_on_two_hosts_survives_a_cut_link(hosts: tuple[list[str], list[str]], tmp_path: Path) -> None:
    frames, domain = make_frames(tmp_path), 100 + os.getpid() % 100
    config = tmp_path / "two_hosts.yaml"
    config.write_text("hosts: {recon: station}\n")
    robot = Stage(frames, tmp_path / "robot", domain, hosts[0], "SUBNET")
    station = Stage(frames, tmp_path / "station", domain, hosts[1], "SUBNET")
    try:
        robot.camera("/robot/cam", "--compressed")
        robot.up("--config", str(config))
        station.up("--config", str(config), "--only", "recon")
        robot.says("started tracking, stopped")
        station.says("started recon, stopped")
        station.until(lambda: newest(station) > 0, "keyframes from the other host in the map")
        process = station.process("sf_recon.node")
        inside(ROBOT, "link", "set", "sf_a", "down")
        time.sleep(CUT_S)  # not a synchronisation: this is how long the link is cut
        cut = time.time_ns()
        plug(ROBOT, "sf_a")
        station.until(lambda: newest(station) > cut, "keyframes taken after the cut")
        back = (time.time_ns() - cut) / 1e9
        print(f"link cut for {CUT_S:g} s: a new keyframe is in the map {back:.1f} s after its return")
        assert station.process("sf_recon.node") == process and "restart" not in station.log + robot.log
        station.end()
        robot.end()
        assert (station.out / "map.sfmap").is_file() and not (robot.out / "map.sfmap").is_file()
        assert (robot.out / "trajectory.tum").is_file()
    finally:
        robot.destroy()
        station.destroy()
