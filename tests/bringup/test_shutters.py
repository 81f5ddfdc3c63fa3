"""Images that views are compared with lose their rolling shutter as those of the run did."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import numpy as np
from run_sample import CAMERA, STAMPS, depth_of, image_of, make_run

from sf_bringup.shutters import Unroller
from sf_interfaces.geometry import se3
from sf_interfaces.types import DepthMap

READOUT = 0.1  # s


def pose(k: float) -> np.ndarray:
    """T_map_camera of the sample run, also between its frames, which lie 0.1 s apart."""
    return se3.exp(np.array([0.05 * k, 0.01 * k, 0.0, 0.0, 0.02 * k, 0.0]))


def rolled(k: int) -> np.ndarray:
    """What a rolling shutter sees of the wall."""
    late = (np.arange(CAMERA.height) + 0.5 - CAMERA.cy) / CAMERA.height * READOUT
    return np.stack([image_of(pose(k + dt / 0.1))[row] for row, dt in enumerate(late)])


def test_rows_that_were_read_late_are_put_right_where_the_run_did_so(tmp_path: Path) -> None:
    run = make_run(tmp_path)
    depth, true = DepthMap(depth_of(pose(3))), image_of(pose(3)).astype(float)
    image = rolled(3)
    assert Unroller(run)(STAMPS[3], image, depth) is image
    (run.path / "config.yaml").write_text(f"tracking: {{readout_s: {READOUT}}}")
    found = Unroller(run)(STAMPS[3], image, depth)
    before, after = (np.abs(seen.astype(float) - true)[2:-2, 2:-2].mean() for seen in (image, found))
    assert after < 0.35 * before
    untracked = Unroller(run)(STAMPS[-1] + 10**12, image, depth)
    assert untracked.shape == image.shape
