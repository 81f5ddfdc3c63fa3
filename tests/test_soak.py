"""The soak of benchmarks/soak.py, two minutes long: nothing is lost, nothing dies, memory is that of the map."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

SOAK = Path(__file__).resolve().parents[1] / "benchmarks" / "soak.py"


@pytest.mark.graph
@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.skipif("SF_SOAK" not in os.environ, reason="two minutes of live line; set SF_SOAK=seconds to run it")
def test_a_live_line_loses_no_keyframe_and_keeps_its_memory(tmp_path: Path) -> None:
    environment = {**os.environ, "ROS_DOMAIN_ID": str(100 + os.getpid() % 100)}
    command = [sys.executable, str(SOAK), "--seconds", os.environ["SF_SOAK"], "--out", str(tmp_path / "soak.json")]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    result = json.loads((tmp_path / "soak.json").read_text())
    assert result["keyframes_taken"] + result["keyframe_queue"] >= result["keyframes_sent"] - 1
    assert result["frames_tracked"] <= result["images_received"]
    tracking = result["memory"]["tracking"]
    assert tracking["end_mb"] < tracking["start_mb"] + 100
