"""Frames per second of the CUDA rasteriser, K = 8, beside PyTorch3D's where that is installed.

    python benchmarks/rasterize_cuda.py [--out rasterize_cuda.json] [--frames N]

Needs a GPU and kernels built with ``-DSF_CUDA=ON``. Points on the walls of a room in random order, as in
``rasterize.py``; the cloud lies on the device and the images stay there. Windows are 3 px wide ("1.5 px") or follow
the map's resolution ("adaptive", IPR's own). PyTorch3D gets points that are projected already (not timed), circles
of the same radius and its own default bins. Prints a table and writes JSON.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import argparse
import importlib.util
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import clouds
import numpy as np
import torch
from rasterize import CAMERAS, FIXED, adaptive
from torch import Tensor

from sf_interfaces.types import Camera
from sf_recon.core.ipr_reference import RasterOptions
from sf_recon.core.rasterizer_cuda import CudaRasterizer

COUNTS = (100_000, 500_000, 2_000_000, 10_000_000)
ROUNDS = 5


def pytorch3d_call(points: np.ndarray, camera: Camera, T: np.ndarray) -> Callable[[], object]:
    """PyTorch3D's coarse-to-fine rasteriser of the cloud as seen from the pose."""
    from pytorch3d import _C

    local = points @ T[:3, :3].T + T[:3, 3]
    u, v = (f * local[:, i] / local[:, 2] + c for f, i, c in ((camera.fx, 0, camera.cx), (camera.fy, 1, camera.cy)))
    side = min(camera.width, camera.height)
    ndc = np.stack([(camera.width - 2 * u) / side, (camera.height - 2 * v) / side, local[:, 2]], axis=1)
    cloud = torch.from_numpy(np.nan_to_num(ndc).astype(np.float32)).cuda()
    radius = torch.full((len(points),), 2 * 1.5 / side, device="cuda")
    first, count = torch.zeros(1, dtype=torch.int64, device="cuda"), torch.tensor([len(points)], device="cuda")
    bin_size = 2 ** max(int(np.ceil(np.log2(max(camera.width, camera.height)))) - 4, 4)
    most = max(10_000, len(points) // 5)
    size = (camera.height, camera.width)
    return lambda: _C.rasterize_points(cloud, first, count, size, radius, 8, bin_size, most)


def frames_per_s(calls: dict[str, Callable[[], object]], frames: int) -> dict[str, float]:
    """Median over rounds, in which the methods take turns; each round waits for the device at its end only."""
    rates: dict[str, list[float]] = {name: [] for name in calls}
    for turn in range(ROUNDS + 1):  # the first pays for memory
        for name, call in calls.items():
            torch.cuda.synchronize()
            start = time.perf_counter()
            for _ in range(frames):
                call()
            torch.cuda.synchronize()
            if turn:
                rates[name].append(frames / (time.perf_counter() - start))
    return {name: float(np.median(rate)) for name, rate in rates.items()}


def measure(points: np.ndarray, camera: Camera, T: np.ndarray, frames: int) -> dict[str, float]:
    """Frames per second of each method on one cloud and view."""
    rasterizer, cloud = CudaRasterizer(), torch.from_numpy(points).cuda()

    def ipr(options: RasterOptions, *outputs: str) -> Callable[[], dict[str, Tensor]]:
        return lambda: rasterizer.rasterize(cloud, camera, T, options, outputs=outputs)

    calls: dict[str, Callable[[], object]] = {
        "ipr 1.5 px": ipr(FIXED, "position"),
        "ipr 1.5 px, index": ipr(FIXED, "index", "weight"),
        "ipr adaptive": ipr(adaptive(len(points)), "position"),
    }
    rates = frames_per_s(calls, frames)
    if importlib.util.find_spec("pytorch3d"):
        rates |= frames_per_s({"pytorch3d": pytorch3d_call(points, camera, T)}, 3)
    return rates


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("rasterize_cuda.json"))
    parser.add_argument("--frames", type=int, default=200)
    args = parser.parse_args()
    rows: list[dict[str, Any]] = []
    for count in COUNTS:
        for camera in CAMERAS:
            rates = measure(clouds.walls(count), camera, clouds.ROOM_POSE, args.frames)
            size = f"{camera.width}x{camera.height}"
            rows.append({"points": count, "size": size, "frames_per_s": rates})
            print(f"{count:9d} points at {size}: " + ", ".join(f"{name} {rate:.0f}/s" for name, rate in rates.items()))
    device = torch.cuda.get_device_name()
    args.out.write_text(json.dumps({"device": device, "rows": rows}, indent=1) + "\n")
    print(device)


if __name__ == "__main__":
    main()
