"""Does the shutter roll? A known readout is found from a shaking camera; where nothing can be told, that is said."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from sf_bringup.doctor_shutter import READOUTS, judge_shutter, shutter_checks
from sf_interfaces.io.sequence_writer import SequenceWriter
from sf_interfaces.types import Frame
from tests.interfaces import layouts

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))

import readout

COLOR, INFO, DEPTH = "/camera/color/image_raw", "/camera/color/camera_info", "/camera/depth/image_raw"


def cost(best: float, gain: float) -> np.ndarray:
    """A parabola [READOUTS] with its minimum at ``best`` s, ``gain`` below a global shutter."""
    return gain * ((np.array(READOUTS) - best) / best) ** 2


def test_parts_that_agree_tell_the_readout_and_how_to_set_it() -> None:
    found = judge_shutter(np.array([cost(0.022, 0.4), cost(0.018, 0.6)]), said=0.0)
    assert not found.ok and "about 20 ms" in found.detail and "22 and 18 ms" in found.detail
    assert found.mend == "--set tracking.readout_s=0.020"
    known = judge_shutter(np.array([cost(0.022, 0.4), cost(0.018, 0.6)]), said=0.024)
    assert known.ok and "the recording says 24 ms" in known.detail
    assert not judge_shutter(np.array([cost(0.022, 0.4), cost(0.018, 0.6)]), said=0.005).ok


@pytest.mark.parametrize(
    "costs, words",
    [
        ([cost(0.02, 0.4), cost(0.02, 0.02)], "nothing shows that it rolls"),
        ([[0.0, 0.1, 0.2, 0.3]] * 2, "nothing shows that it rolls"),
        ([cost(0.01, 0.4), cost(0.028, 0.4)], "cannot tell: it seems to roll"),
        ([cost(0.02, 0.4), [np.nan] * 4], "cannot tell: too few frames"),
    ],
)
def test_what_is_not_sure_is_no_finding(costs: list[np.ndarray], words: str) -> None:
    found = judge_shutter(np.array(costs), said=0.0)
    assert found.ok and words in found.detail


def write(path: Path, frames: list[Frame]) -> Path:
    with SequenceWriter(path) as writer:
        for frame in frames:
            assert frame.image is not None and frame.camera is not None and frame.depth is not None
            writer.image(COLOR, frame.stamp_ns, frame.image, frame.camera.frame_id)
            writer.camera_info(INFO, frame.stamp_ns, frame.camera)
            writer.depth(DEPTH, frame.stamp_ns, frame.depth, frame.camera.frame_id, "32FC1")
    return path


def test_a_shaking_camera_shows_its_readout(tmp_path: Path) -> None:
    (found,) = shutter_checks(write(tmp_path / "shaken.mcap", readout.shaken()))
    assert not found.ok and found.mend.startswith("--set tracking.readout_s=")
    assert float(found.mend.split("=")[1]) == pytest.approx(readout.SIMULATED, abs=0.004)


def test_what_has_no_order_or_calibration_is_not_looked_at(tmp_path: Path) -> None:
    assert not shutter_checks(layouts.colmap(tmp_path / "photos", 3))
    with SequenceWriter(tmp_path / "bare.mcap") as writer:
        writer.image(COLOR, 1_000_000_000, np.zeros((12, 16), np.uint8), "camera")
    assert not shutter_checks(tmp_path / "bare.mcap")
