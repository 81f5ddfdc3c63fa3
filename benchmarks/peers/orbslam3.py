"""ORB-SLAM3 in RGB-D mode through the wheel pyorbslam3 (GPL-3: installed by hand, never with this project).

``$ORB_VOCABULARY`` names its vocabulary (ORBvoc.txt or another in DBoW2's text format), which the wheel lacks.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
import tempfile
from pathlib import Path

import cv2
import numpy as np
import pyorbslam3

from peers import PeerMissing, filled_depth
from sf_interfaces.types import Camera, Float64, Frame

_SETTINGS = """%YAML:1.0
File.version: "1.0"
Camera.type: "PinHole"
Camera1.fx: {fx}
Camera1.fy: {fy}
Camera1.cx: {cx}
Camera1.cy: {cy}
Camera1.k1: 0.0
Camera1.k2: 0.0
Camera1.p1: 0.0
Camera1.p2: 0.0
Camera.width: {width}
Camera.height: {height}
Camera.fps: 30
Camera.RGB: 1
Stereo.ThDepth: 40.0
Stereo.b: 0.075
RGBD.DepthMapFactor: 1.0
ORBextractor.nFeatures: 1000
ORBextractor.scaleFactor: 1.2
ORBextractor.nLevels: 8
ORBextractor.iniThFAST: 20
ORBextractor.minThFAST: 7
"""


class OrbSlam3:
    """Poses as they are known when a frame arrives (online)."""

    def __init__(self, camera: Camera) -> None:
        vocabulary = os.environ.get("ORB_VOCABULARY", "")
        if not Path(vocabulary).is_file():
            raise PeerMissing("skipped: its vocabulary is not in the wheel; set ORB_VOCABULARY to ORBvoc.txt")
        with tempfile.TemporaryDirectory() as folder:
            settings = Path(folder) / "settings.yaml"
            values = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx - 0.5, "cy": camera.cy - 0.5}
            settings.write_text(_SETTINGS.format(width=camera.width, height=camera.height, **values))
            self._slam = pyorbslam3.Slam(vocabulary, settings, pyorbslam3.Sensor.RGBD)

    def track(self, frame: Frame) -> Float64 | None:
        assert frame.image is not None
        grey = cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY)
        found = self._slam.track_rgbd(grey, filled_depth(frame), frame.stamp_ns * 1e-9)
        return np.array(found.pose_wc) if found.pose_valid else None


PEERS = {"ORB-SLAM3 RGB-D": OrbSlam3}
