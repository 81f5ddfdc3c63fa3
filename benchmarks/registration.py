"""Does depth lie on colour? What the depth edges find on 7-Scenes, and how wrong that is where the truth is known.

python benchmarks/registration.py [--data FOLDER] [--scenes room hall] [--frames 30] [--out bench]
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from common import Benchmark, print_rows

from sf_bringup.simulate import PRESETS, SimulationSpec, Simulator
from sf_bringup.simulate.sensors import structured_light
from sf_interfaces.geometry import se3
from sf_interfaces.geometry.depth_alignment import Alignment, align
from sf_interfaces.geometry.edge_views import EdgeViews, Shot
from sf_interfaces.io.datasets.files import read_depth, read_rgb
from sf_interfaces.io.datasets.indoor import SevenScenes, stamp_30hz
from sf_interfaces.types import Camera, DepthMap, Float32, Float64

# What was used for 7-Scenes before its registration was measured: the pose of another Kinect.
GIVEN = se3.orthonormalise(
    np.array(
        [
            [0.99997, 0.00268, -0.00790, -0.02556],
            [-0.00274, 0.99996, -0.00815, 0.00010],
            [0.00788, 0.00817, 0.99994, 0.00203],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
)
# Frames of 7-Scenes: all, and two parts before the lost depth image.
PARTS = {"0-199": range(1, 199, 3), "0-99": range(1, 100, 2), "101-176": range(101, 177, 2)}
# Scene -> lag, s.
SCENES = {
    "room0": 0.012,
    "office0": 0.0,
    "lounge": 0.020,
    "room": 0.0,
    "hall": -0.010,
    "office3": 0.008,
    "office1": 0.015,
    "room1": -0.006,
}
QUICK_SCENES = ("room0", "lounge")
# Rotations by which the claimed pose of a simulated depth camera is wrong, deg about its x, y and z.
ERRORS_DEG = ((0.0, 0.0, 0.0), (0.3, -0.6, 0.5), (-1.0, 0.4, -0.8), (0.1, 0.1, 0.0))
BASELINE = np.array([-0.025, 0.002, 0.001])  # m, from the depth to the colour camera
SWAY_DEG, SWAY_HZ = (1.0, 1.5, 0.5), (0.7, 0.45, 0.3)  # of the hand, about x, y and z of the camera
PROJECTOR = 0.075  # m, to the right of the depth camera


class Rig:
    """A simulated hand-held colour camera with a depth camera beside it that has its own lens, place and clock.

    Args:
        lag_s: the depth image shows what was so long before its stamp.
        every: s between frames.
        noisy: depth as a structured-light sensor gives it, with the shadow of its projector; else exact.
    """

    def __init__(self, spec: SimulationSpec, lag_s: float = 0.0, every: float = 0.5, noisy: bool = True) -> None:
        self.simulator, self.lag_s, self.every, self.noisy = Simulator(spec), lag_s, every, noisy
        self.color = spec.camera
        focal = spec.focal * 1.1
        self.depth = Camera(spec.width, spec.height, focal, focal, spec.width / 2 + 3, spec.height / 2 - 2, "depth")
        self.T_color_depth = se3.exp(np.array([*BASELINE, 0.01, -0.005, 0.008]))

    def shots(self, count: int) -> Iterator[Shot]:
        """Depth images with the colour images before, at and after them."""
        spec, period = self.simulator.spec, 1 / self.simulator.spec.fps
        for k in range(count):
            times = [(k + 0.5) * self.every + j * period for j in (-1, 0, 1)]
            stamps = [round(1e9 * (1 + t)) for t in times]
            images = [self._image(t) for t in times]
            T = self._pose(times[1] - self.lag_s) @ self.T_color_depth
            z = self.simulator.renderer.render(self.depth, T, 1)[1]
            if self.noisy:
                rng = np.random.default_rng([spec.seed, 7, k])
                z = np.where(shadowed(z, self.depth.fx), np.nan, structured_light(z, self.depth.fx, rng))
            yield Shot((stamps[0], stamps[1], stamps[2]), (images[0], images[1], images[2]), DepthMap(z), stamps[1])

    def _pose(self, t: float) -> Float64:
        """T_map_camera: the path of the scene, not quite steadily."""
        sway = np.radians(SWAY_DEG) * np.sin(2 * np.pi * np.array(SWAY_HZ) * t)
        return np.asarray(self.simulator.path.pose(t) @ se3.exp(np.array([0.0, 0.0, 0.0, *sway])))

    def _image(self, t: float) -> np.ndarray:
        image = self.simulator.renderer.render(self.color, self._pose(t), 1)[0]
        rng = np.random.default_rng([self.simulator.spec.seed, 8, round(1e6 * t)])
        return np.clip(image + rng.standard_normal(image.shape) + 0.5, 0, 255).astype(np.uint8)


def shadowed(z: Float32, focal: float) -> np.ndarray:
    """Pixels that a projector to the right of the camera does not light: something nearer lies to the right, [H, W]."""
    column = np.arange(z.shape[1]) - focal * PROJECTOR / np.nan_to_num(z, nan=1e4)  # as the projector sees it
    nearest = np.minimum.accumulate(column[:, ::-1], axis=1)[:, ::-1]
    return np.asarray(column > nearest + 1)


def found(shots: Iterable[Shot], depth: Camera, color: Camera, T_color_depth: Float64) -> Alignment | None:
    """How the depth of shots lies on colour."""
    views = EdgeViews(depth, color, T_color_depth)
    for shot in shots:
        views.add(shot)
    return align(views)


def seven_scenes(folder: Path, frames: Iterable[int]) -> Iterator[Shot]:
    """Raw depth, not registered, with the colour images around it."""
    for k in frames:
        images = [read_rgb(folder / f"frame-{j:06d}.color.jpg") for j in (k - 1, k, k + 1)]
        stamps = [stamp_30hz(j) for j in (k - 1, k, k + 1)]
        depth = read_depth(folder / f"frame-{k:06d}.depth.png", SevenScenes.depth_units or 1000.0)
        yield Shot((stamps[0], stamps[1], stamps[2]), (images[0], images[1], images[2]), depth, stamps[1])


def row_of(a: Alignment) -> dict[str, Any]:
    """What a benchmark shows of an alignment."""
    jump = a.jump
    return {
        "frames": f"{a.used}/{a.frames}",
        "off px": a.off_px,
        "right px": float(a.offset_px[0]),
        "down px": float(a.offset_px[1]),
        "score": a.score,
        "corrected": a.score_corrected,
        "by chance": a.score_chance,
        "rotation deg": " ".join(f"{v:.2f}" for v in np.degrees(a.rotation)),
        "halves px": a.halves_px,
        "halves deg": float(np.degrees(a.halves_rad)),
        "lag ms": "not told" if a.lag_s is None else round(1e3 * a.lag_s, 2),
        "halves ms": 1e3 * a.halves_lag_s,
        "jump": "none" if jump is None else f"{jump.seconds / a.period_s:.2f} frames",
        "jump after": "" if jump is None else round((jump.after_ns - stamp_30hz(0)) * 30e-9),
        "jump before": "" if jump is None else round((jump.before_ns - stamp_30hz(0)) * 30e-9),
    }


def real(folder: Path) -> list[dict[str, Any]]:
    """7-Scenes with the extrinsic that came with it, and with the one in use."""
    rows = []
    for claimed, T in (("given", GIVEN), ("in use", SevenScenes.T_COLOR_DEPTH)):
        for name, frames in PARTS.items():
            a = found(seven_scenes(folder, frames), SevenScenes.DEPTH_CAMERA, SevenScenes.COLOR_CAMERA, T)
            rows.append({"extrinsic": claimed, "of": name, **(row_of(a) if a else {"frames": "not told"})})
            print_rows(rows[-1:])
    return rows


def simulated(scene: str, count: int) -> list[dict[str, Any]]:
    """Claimed poses that are wrong by known rotations, a lag and a lost image that are known."""
    spec = replace(PRESETS.get(scene) or SimulationSpec(scene), width=640, height=480, focal=480.0, fps=30.0)
    rig = Rig(spec, SCENES[scene], every=1.0)
    shots = list(rig.shots(count))
    slipped = [s if k < 0.7 * count else replace(s, depth_ns=s.depth_ns - 33_333_333) for k, s in enumerate(shots)]
    cases = [(str(error), error, shots) for error in ERRORS_DEG] + [("one image lost", (0.3, -0.6, 0.5), slipped)]
    rows = []
    for name, error, used in cases:
        claimed = _turned(error) @ rig.T_color_depth
        a = found(used, rig.depth, rig.color, claimed)
        row: dict[str, Any] = {"scene": scene, "wrong by deg": name}
        if a is None:
            rows.append({**row, "frames": "not told"})
            continue
        left = np.degrees(se3.log(a.corrected(claimed) @ se3.inverse(rig.T_color_depth))[3:])
        lag = None if a.lag_s is None else 1e3 * abs(a.lag_s - rig.lag_s)
        row |= {"error deg": float(np.linalg.norm(left)), "error ms": "not told" if lag is None else round(lag, 2)}
        rows.append({**row, **row_of(a)})
        print_rows(rows[-1:])
    return rows


def _turned(degrees: tuple[float, float, float]) -> Float64:
    return se3.exp(np.array([0.0, 0.0, 0.0, *np.radians(degrees)]))


def main() -> None:
    """Both, one table each."""
    bench = Benchmark("registration", __doc__.splitlines()[0])
    bench.parser.add_argument("--data", type=Path, help="folder of real recordings")
    bench.parser.add_argument("--scenes", nargs="*", choices=sorted(SCENES), default=list(QUICK_SCENES))
    bench.parser.add_argument("--frames", type=int, default=24, help="of each simulated recording")
    args = bench.parse()
    bench.note(
        "Rotations correct T_color_depth from the left. A positive lag: depth is older than its stamp says. Simulated "
        "depth is that of a structured-light sensor with the shadow of its projector; motion is seen in colour alone."
    )
    tables = {}
    if args.data is not None:
        tables["7-Scenes RedKitchen"] = real(args.data / "rgbd_7scenes_redkitchen_000_199")
    tables["simulated"] = [row for scene in args.scenes for row in simulated(scene, args.frames)]
    bench.write("Depth on colour", tables)


if __name__ == "__main__":
    main()
