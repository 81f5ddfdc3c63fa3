"""``sf up`` on the topics of an independent driver: found, followed, and held through the death of every node."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from sf_bringup.shared_memory import orphaned_segments
from sf_interfaces.io.trajectory import read_tum
from tests.live_stage import Stage, make_frames

pytestmark = [pytest.mark.graph, pytest.mark.slow, pytest.mark.timeout(900)]
pytest.importorskip("rclpy")


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_frames(tmp_path_factory.mktemp("frames"))


@pytest.fixture
def stage(frames: Path, tmp_path: Path) -> Iterator[Stage]:
    made = Stage(frames, tmp_path / "run", 100 + os.getpid() % 100)
    yield made
    made.destroy()


def test_map_and_trajectory_outlive_the_nodes(stage: Stage) -> None:
    before_test = set(orphaned_segments())
    stage.up()
    stage.says("no line")  # nothing is there yet
    camera = stage.camera("/robot1/front", "--compressed")
    stage.says("started tracking, recon")
    assert "rgb from /robot1/front/color/image_raw/compressed, a colour image, compressed" in stage.log
    stage.until(lambda: stage.poses_saved() > 10, "a snapshot of the tracker")
    before, recon = stage.poses_saved(), stage.process("sf_recon.node")
    stage.kill("sf_tracking.node")
    stage.says("node tracking was killed by SIGKILL")
    stage.says("node tracking restarted")
    assert stage.process("sf_recon.node") == recon
    stage.until(lambda: stage.poses_saved() > before + 10, "a snapshot after the restart")
    stage.until(lambda: (stage.out / "state" / "recon.sfmap").is_file(), "a snapshot of the map")
    stage.kill("sf_recon.node")
    stage.says("node recon restarted")
    tracking = stage.process("sf_tracking.node")
    # A driver that restarts keeps the line as it is.
    camera.send_signal(signal.SIGINT)
    camera.wait(timeout=60)
    stage.says("is gone; the line waits")
    count = stage.poses_saved()
    stage.camera("/robot1/front", "--compressed")
    stage.until(lambda: stage.poses_saved() > count, "poses of the camera that came back")
    assert stage.process("sf_tracking.node") == tracking
    saved = stage.poses_saved()
    stage.end()
    trajectory = read_tum(stage.out / "trajectory.tum")
    assert len(trajectory) >= saved
    steps = np.linalg.norm(np.diff(trajectory.positions, axis=0), axis=1)
    assert steps.max() < 0.8, "the restarted tracker found its place in the map"
    assert (stage.out / "map.sfmap").stat().st_size > 0 and (stage.out / "surface.ply").is_file()
    assert not set(orphaned_segments()) - before_test, "shared memory of killed processes is removed"


def test_a_node_that_keeps_dying_is_given_up_and_the_line_goes_on(stage: Stage) -> None:
    stage.camera("/cam")
    up = stage.up()
    stage.says("started tracking, recon")
    for death in (1, 2, 3):
        stage.kill("sf_recon.node")
        stage.says("node recon was killed", death)
        stage.says("node recon restarted", death)
    stage.kill("sf_recon.node")
    stage.says("the line goes on without recon")
    count = stage.poses_saved()
    stage.until(lambda: stage.poses_saved() > count, "more poses")
    stage.end()
    assert up.returncode == 0
