"""What to simulate: the specification and its presets."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass

from sf_bringup.simulate.scenes import ROOMS
from sf_bringup.simulate.sensors import LIDARS
from sf_bringup.simulate.trajectories import PathPlan
from sf_interfaces.errors import ConfigError
from sf_interfaces.types import Camera

DEPTHS = ("none", "exact", "structured_light", "tof")


@dataclass(frozen=True)
class SimulationSpec:
    """One simulated recording.

    Args:
        scene: a name of ``SCENES``, or the path of a Gazebo ``.world`` file.
        frames, fps: length and rate of the camera; width, height, focal: px; path: None = the scene's.
        rgb, depth, lidar: the sensors; lidar_hz: sweeps per second; lidar_fov_deg: horizontal field.
        image_noise: deviation in grey levels; blur: exposure, s; supersampling: n x n rays on edges;
        readout: s from the first to the last row of an image, depth is taken at once, half way;
        ground_truth_depth: also write it; novel_views: images off the path to write under /ground_truth/novel.
    """

    scene: str
    frames: int = 600
    fps: float = 30.0
    width: int = 640
    height: int = 480
    focal: float = 480.0
    rgb: bool = True
    depth: str = "none"
    lidar: str = "none"
    lidar_hz: float = 10.0
    lidar_fov_deg: float = 360.0
    image_noise: float = 1.0
    blur: float = 0.0
    readout: float = 0.0
    supersampling: int = 2
    ground_truth_depth: bool = True
    novel_views: int = 0
    seed: int = 0
    path: PathPlan | None = None

    def __post_init__(self) -> None:
        if self.depth not in DEPTHS:
            raise ConfigError(f"depth sensor '{self.depth}' is unknown; choose one of {', '.join(DEPTHS)}")
        if self.lidar != "none" and self.lidar not in LIDARS:
            raise ConfigError(f"lidar '{self.lidar}' is unknown; choose none, {', '.join(LIDARS)}")
        if not 0 <= self.novel_views <= self.frames:
            raise ConfigError(f"novel_views must lie between 0 and the {self.frames} frames, got {self.novel_views}")
        if min(self.frames, self.fps, self.lidar_hz, self.supersampling) <= 0 or self.image_noise < 0:
            raise ConfigError("frames, fps, lidar_hz and supersampling of a simulation must be positive")
        if not 0 <= self.blur <= 1 / self.fps:
            raise ConfigError(f"blur must lie between 0 and the {1 / self.fps:.4g} s of a frame, got {self.blur:g}")
        if abs(self.readout) > 1 / self.fps:
            raise ConfigError(f"readout takes at most the {1 / self.fps:.4g} s of a frame, got {self.readout:g}")
        if self.blur and self.readout:
            raise ConfigError("blur and readout cannot be simulated together; leave one of them at 0")

    @property
    def camera(self) -> Camera:
        """The simulated camera, principal point at the image centre."""
        return Camera(self.width, self.height, self.focal, self.focal, self.width / 2, self.height / 2)

    @property
    def path_plan(self) -> PathPlan:
        """The path of the camera: the given one, or that of the scene."""
        if self.path is not None:
            return self.path
        if self.scene in ROOMS:
            x, y, _ = ROOMS[self.scene].size
            return PathPlan((x / 2 - 1.55, y / 2 - 1.55), 1.5)
        return PATHS.get(self.scene, PATHS["world"])


PATHS = {
    "hall": PathPlan((8.2, 2.1), 1.7, heading=2.2, speed=0.9),
    "palace": PathPlan((27.0, 17.0), 1.75, 0.08, 2.5, 0.14, 1.4, 1.3),
    "campus": PathPlan((115.0, 72.0), 55.0, 2.0, 2.6, -0.6, 8.0),
    "garden": PathPlan((49.0, 34.0), 1.75, 0.08, 2.5, 0.14, 1.8, 1.9),
    "world": PathPlan((0.6, 0.4), 1.4),
}

_REPLICA = ("room0", "room1", "room2", "office0", "office1", "office2", "office3", "office4")
PRESETS: dict[str, SimulationSpec] = {
    "demo": SimulationSpec("lounge", frames=70, fps=10.0, lidar="spinning64"),
    "room": SimulationSpec("room"),
    "hall": SimulationSpec("hall", frames=1200, depth="structured_light"),
    "palace": SimulationSpec("palace", 1200, 10.0, lidar="spinning128", ground_truth_depth=False),
    "garden": SimulationSpec("palace", 1700, 10.0, lidar="spinning64", ground_truth_depth=False, path=PATHS["garden"]),
    "campus": SimulationSpec("campus", 700, 10.0, lidar="spinning128", ground_truth_depth=False),
    **{
        name: SimulationSpec(name, 2000, 30.0, 1200, 680, 600.0, seed=k + 1, ground_truth_depth=False)
        for k, name in enumerate(_REPLICA)
    },
}
