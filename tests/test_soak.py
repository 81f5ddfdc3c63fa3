"""The soak of benchmarks/soak.py: nothing is lost, nothing dies, memory is that of the map.

Two minutes; SF_SOAK=3600 makes it an hour.
"""

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
@pytest.mark.timeout(7200)
def test_a_live_line_loses_no_keyframe_and_keeps_its_memory(tmp_path: Path) -> None:
    environment = {**os.environ, "ROS_DOMAIN_ID": str(100 + os.getpid() % 100)}
    seconds, out = os.environ.get("SF_SOAK", "120"), tmp_path / "soak.json"
    command = [sys.executable, str(SOAK), "--seconds", seconds, "--out", str(out)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    result = json.loads(out.read_text())
    assert result["keyframes_taken"] == result["keyframes_sent"] > 0
    assert result["frames_tracked"] <= result["images_received"]
    tracking = result["memory"]["tracking"]
    assert tracking["end_mb"] < tracking["start_mb"] + 100
