"""Time of Improved Point Rasterization: 0.1, 0.5 and 2 M points at two image sizes.

    python benchmarks/rasterize.py [--out rasterize.json] [--threads N] [--repeats N]

Prints a table and writes JSON. The points are uniform on the walls of a room and in random order, the
worst case for the cache.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path
from typing import Any

import numpy as np

from sf_interfaces.types import Camera
from sf_recon.core.ipr_reference import RasterOptions, rasterize_reference
from sf_recon.core.rasterizer import rasterize

HALF = np.array([2.5, 1.4, 3.0])  # m, half size of the room
CAMERAS = (Camera(640, 480, 585, 585, 320, 240), Camera(1200, 680, 600, 600, 600, 340))
COUNTS = (100_000, 500_000, 2_000_000)
POSE = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1.5], [0, 0, 0, 1]], float)


def walls(count: int, seed: int = 0) -> np.ndarray:
    """Points [N, 3] float32 m on the six walls, by area."""
    rng = np.random.default_rng(seed)
    area = np.array([HALF[1] * HALF[2], HALF[0] * HALF[2], HALF[0] * HALF[1]])
    axis = rng.choice(3, count, p=area / area.sum())
    points = rng.uniform(-HALF, HALF, (count, 3))
    points[np.arange(count), axis] = rng.choice([-1, 1], count) * HALF[axis]
    return points.astype(np.float32)


def spacing(count: int) -> float:
    """Mean distance of neighbouring points, m: the resolution a map of this size has."""
    area = 8 * (HALF[0] * HALF[1] + HALF[1] * HALF[2] + HALF[0] * HALF[2])
    return float(np.sqrt(area / count))


def options_for(resolution: float) -> RasterOptions:
    """The block's defaults for a map of this resolution."""
    return RasterOptions(radius=resolution, near=10 * resolution, layer_gap=4 * resolution)


def measure(points: np.ndarray, camera: Camera, options: RasterOptions, threads: int, repeats: int) -> dict[str, Any]:
    """Median and fastest wall time, process time, and the fraction of holes."""
    wall, cpu = [], []
    for _ in range(repeats + 1):
        start, start_cpu = time.perf_counter(), time.process_time()
        drawn = rasterize(points, camera, POSE, options, threads)
        wall.append(time.perf_counter() - start)
        cpu.append(time.process_time() - start_cpu)
    wall, cpu = wall[1:], cpu[1:]  # the first call pays for the memory
    return {
        "points": len(points),
        "size": f"{camera.width}x{camera.height}",
        "threads": threads,
        "median_ms": 1e3 * float(np.median(wall)),
        "min_ms": 1e3 * min(wall),
        "cpu_ms": 1e3 * float(np.median(cpu)),
        "holes": float(drawn.hole.mean()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("rasterize.json"))
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    parser.add_argument("--repeats", type=int, default=15)
    args = parser.parse_args()
    rows = []
    print("   points      size  T  window      median       min       cpu  holes")
    for count in COUNTS:
        points = walls(count)
        one_pixel = RasterOptions(radius=1e-6, near=0.05, layer_gap=0.02)
        for camera in CAMERAS:
            for threads in sorted({1, args.threads}):
                for name, options in (("adaptive", options_for(spacing(count))), ("1 px", one_pixel)):
                    row = measure(points, camera, options, threads, args.repeats) | {"window": name}
                    rows.append(row)
                    print(
                        f"{count:9d} {row['size']:>9} {threads:2d}  {name:8} {row['median_ms']:8.2f} ms "
                        f"{row['min_ms']:6.2f} ms {row['cpu_ms']:6.2f} ms  {row['holes']:.3f}"
                    )
    small, camera = walls(2000), Camera(80, 60, 73, 73, 40, 30)
    start = time.perf_counter()
    rasterize_reference(small, camera, POSE, options_for(spacing(2000)))
    reference_ms = 1e3 * (time.perf_counter() - start)
    kernel = measure(small, camera, options_for(spacing(2000)), 1, args.repeats)
    print(f"reference, 2000 points at 80x60: {reference_ms:.0f} ms; kernel {kernel['median_ms']:.2f} ms")
    result = {"rows": rows, "reference_ms": reference_ms, "reference_kernel": kernel}
    args.out.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
