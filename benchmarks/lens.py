"""Radial term of the 7-Scenes camera: with which one matches between its images agree best with the sensor's depth.

python benchmarks/lens.py --data FOLDER [--out bench]

Pairs of frames are matched; points of the first, with their measured depth, are projected into the second, whose pose
and turn while its rows are read are free. What is left, by radial term, is the table; its minimum is ``LENS`` of the
importer. Both halves of the recording say the same.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import image_sets
import numpy as np
from common import Benchmark, print_rows
from scipy.optimize import least_squares

from sf_depth.core import checks, pinhole
from sf_depth.core.matching import FlowMatcher
from sf_depth.core.start import Size
from sf_interfaces.geometry import se3
from sf_interfaces.io.datasets.files import read_rgb
from sf_interfaces.io.datasets.indoor import SevenScenes
from sf_interfaces.types import Float64

TERMS = (-0.065, -0.05, -0.035, -0.02, -0.005)
PARTS = {"0-99": range(15, 100, 14), "100-176": range(105, 167, 12)}
STEPS = (-10, -5, 5, 10)  # from a frame to those it is matched with
POINTS = 500  # of a pair
_SURE = 0.6  # confidence of a match that counts
_KERNEL = 0.7  # px


@dataclass(frozen=True)
class Pair:
    """Pixels [2, N] of one frame, their depth [N] m, where another frame sees them [2, N], and its pose as given."""

    uv: Float64
    z: Float64
    target: Float64
    T: Float64


def pairs(folder: Path, references: range) -> Iterator[Pair]:
    """Confident matches, evenly chosen, where the sensor has depth."""
    matcher = FlowMatcher()
    for frame in references:
        z, pose = image_sets.registered_depth(folder, frame).z, image_sets.color_pose(folder, frame)
        image = read_rgb(folder / f"frame-{frame:06d}.color.jpg")
        for other in (frame + step for step in STEPS):
            found = matcher(image, read_rgb(folder / f"frame-{other:06d}.color.jpg"))
            sure = checks.cross_check(found, Size(*z.shape[::-1])) > _SURE
            index = np.flatnonzero(sure & np.isfinite(z))
            index = index[:: max(1, len(index) // POINTS)]
            row, column = np.unravel_index(index, z.shape)
            uv = np.stack([column, row]) + 0.5
            target = found.target.reshape(-1, 2)[index].T.astype(np.float64)
            T = se3.inverse(image_sets.color_pose(folder, other)) @ pose
            yield Pair(uv, z[row, column].astype(np.float64), target, T)


def left(pair: Pair, theta: Float64) -> float:
    """Robust cost of a pair, px^2, at its best pose and turn."""
    x = pinhole.rays(theta, pair.uv)
    X = np.concatenate([x, np.ones((1, x.shape[1]))]) * pair.z
    row = (pair.target[1] - theta[3]) / theta[1]

    def residuals(p: Float64) -> Float64:
        T = se3.exp(p[None, :6])[0] @ pair.T
        Y = T[:3, :3] @ X + T[:3, 3:]
        Y = Y + row * np.cross(p[6:], Y, axisb=0).T
        return np.asarray(pinhole.project(theta, Y[:2] / Y[2]) - pair.target).ravel()

    return float(least_squares(residuals, np.zeros(9), loss="cauchy", f_scale=_KERNEL, x_scale="jac").cost)


def main() -> None:
    bench = Benchmark("lens", __doc__.splitlines()[0])
    bench.parser.add_argument("--data", type=Path, required=True, help="folder of real recordings")
    args = bench.parse()
    rows = []
    for name, references in PARTS.items():
        found = list(pairs(args.data / "rgbd_7scenes_redkitchen_000_199", references))
        theta = pinhole.theta_of(SevenScenes.COLOR_CAMERA)
        costs = np.array([sum(left(p, theta + np.array([0, 0, 0, 0, k1])) for p in found) for k1 in TERMS])
        square, line, _ = np.polyfit(TERMS, costs, 2)
        rows.append({"frames": name, "pairs": len(found), "best": -line / (2 * square)})
        rows[-1] |= {f"cost at {k1}": round(c, 1) for k1, c in zip(TERMS, costs, strict=True)}
        print_rows(rows[-1:])
    bench.write("Lens of 7-Scenes", {"lens": rows})


if __name__ == "__main__":
    main()
