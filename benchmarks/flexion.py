"""Time of the flexion image at 640x480, and the step the noise asks for.

    python benchmarks/flexion.py [--depth FRAME.png ...] [--out flexion.json] [--repeats N]

Without ``--depth`` (16-bit PNG, mm) the frame is a simulated corner with structured-light noise and holes. Prints
a table and writes JSON. Process time is the figure to compare between machines under load.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sf_flexion.config import VARIANTS, FlexionConfig
from sf_flexion.core.flexion import Flexion
from sf_interfaces.types import Camera, DepthMap

CAMERA = Camera(640, 480, 585.0, 585.0, 320.0, 240.0)


def corner(sigma_per_m2: float, holes: float, seed: int = 0) -> DepthMap:
    """A corner 2..3 m away; noise grows with depth squared and is correlated, holes are discs of 12 px."""
    rng = np.random.default_rng(seed)
    u = np.mgrid[0:480, 0:640][1]
    z = 3.0 / (1.0 + 0.6 * np.abs((u - 320) / 585.0))
    noise = cv2.GaussianBlur(rng.standard_normal(z.shape), (0, 0), 2.0)
    z = z + sigma_per_m2 * z**2 * noise / noise.std()
    mask = np.zeros(z.shape, np.uint8)
    while mask.mean() < holes:
        cv2.circle(mask, (int(rng.integers(640)), int(rng.integers(480))), 12, 1, -1)
    z[mask > 0] = np.nan
    return DepthMap(z)


def load(path: Path) -> DepthMap:
    """A 16-bit PNG in mm, 0 and 65535 invalid."""
    mm = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    return DepthMap(np.where((mm == 0) | (mm == 65535), np.nan, mm.astype(np.float32) / 1000))


def measure(depth: DepthMap, config: FlexionConfig, repeats: int) -> dict[str, Any]:
    """Median and fastest wall time and process time, ms; the step; the median flexion of known pixels."""
    flexion, wall, cpu = Flexion(config), [], []
    for _ in range(repeats + 2):
        start, start_cpu = time.perf_counter(), time.process_time()
        image = flexion(depth, CAMERA)
        wall.append(1e3 * (time.perf_counter() - start))
        cpu.append(1e3 * (time.process_time() - start_cpu))
    wall, cpu = wall[2:], cpu[2:]  # the first calls pay for the memory
    return {
        "wall_ms": float(np.median(wall)),
        "wall_min_ms": min(wall),
        "process_ms": float(np.median(cpu)),
        "step": flexion.step,
        "median_flexion": float(np.median(image[image > 0])) / (255 if config.bits == 8 else 65535),
    }


def main() -> None:
    """Measure all variants and both depths of output."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--depth", type=Path, nargs="+", default=[])
    parser.add_argument("--out", type=Path, default=Path("flexion.json"))
    parser.add_argument("--repeats", type=int, default=50)
    args = parser.parse_args()
    inputs = {path.name: load(path) for path in args.depth}
    inputs = inputs or {"noise-free": corner(0.0, 0.1), "structured light": corner(0.0015, 0.1)}
    rows = []
    print(
        f"{'input':28} {'variant':10} {'bits':>4} {'step':>4} {'wall ms':>8} {'fastest':>8} {'cpu ms':>8} {'median':>7}"
    )
    for name, depth in inputs.items():
        for variant, bits in [*((v, 8) for v in VARIANTS), ("standard", 16)]:
            row = measure(depth, FlexionConfig(variant, bits=bits), args.repeats)
            rows.append({"input": name, "variant": variant, "bits": bits, **row})
            print(
                f"{name:28} {variant:10} {bits:8} {row['step']:8} {row['wall_ms']:8.1f} {row['wall_min_ms']:8.1f} "
                f"{row['process_ms']:8.1f} {row['median_flexion']:8.3f}"
            )
    args.out.write_text(json.dumps(rows, indent=2))


if __name__ == "__main__":
    main()
