"""Time of Improved Point Rasterization against Open3D and numba: 0.1, 0.5 and 2 M points, K = 8.

    python benchmarks/rasterize.py [--data FOLDER] [--out rasterize.json] [--threads N] [--repeats N]

FOLDER is a 7-Scenes recording, whose fused cloud is drawn from one of its poses; without it, points on the
walls of a room. Random order is the worst case for the cache. Windows are 3 px wide ("1.5 px", which every
method draws) or follow the map's resolution ("adaptive", IPR's own). Open3D draws one point per pixel; the
numba sibling (``pip install numba``) finds the K nearest of each pixel. Prints a table and writes JSON.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import argparse
import importlib.util
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import clouds
import numpy as np

from sf_interfaces.types import Camera
from sf_recon.core.ipr_reference import RasterOptions
from sf_recon.core.rasterizer import rasterize

CAMERAS = (Camera(640, 480, 585, 585, 320, 240), Camera(1200, 680, 600, 600, 600, 340))
COUNTS = (100_000, 500_000, 2_000_000)
FIXED = RasterOptions(radius=1e3, near=0.05, layer_gap=0.02, max_half=1.5)  # 3 px wide at any depth


def adaptive(count: int) -> RasterOptions:
    """The block's defaults for a map of this many points."""
    resolution = 0.005 * float(np.sqrt(5e5 / count))
    return RasterOptions(radius=resolution, near=10 * resolution, layer_gap=4 * resolution)


def open3d_calls(points: np.ndarray, camera: Camera, T: np.ndarray) -> dict[str, Callable[[], object]]:
    """Open3D's projections of the same cloud: one pixel per point, the nearest wins."""
    import open3d as o3d

    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(points))
    cloud.point.colors = o3d.core.Tensor(np.zeros_like(points))
    K = o3d.core.Tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], o3d.core.float64)
    arguments = (camera.width, camera.height, K, o3d.core.Tensor(T), 1000.0, 10.0)
    return {
        "open3d depth": lambda: cloud.project_to_depth_image(*arguments),
        "open3d rgbd": lambda: cloud.project_to_rgbd_image(*arguments),
    }


def numba_top_k() -> Callable[..., object]:
    """K nearest points of each pixel by numba: threads own bands of rows, pixels keep sorted lists."""
    import numba

    @numba.njit(parallel=True)
    def draw(points, T, fx, fy, cx, cy, width, height, half, k, bands):  # type: ignore[no-untyped-def]
        n = len(points)
        u, v, z = np.empty(n, np.float32), np.empty(n, np.float32), np.empty(n, np.float32)
        for i in numba.prange(n):
            p = points[i]
            z[i] = T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3]
            u[i] = fx * (T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2] + T[0, 3]) / z[i] + cx
            v[i] = fy * (T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2] + T[1, 3]) / z[i] + cy
        index = np.full((height, width, k), -1, np.int32)
        depth = np.full((height, width, k), np.inf, np.float32)
        for band in numba.prange(bands):
            first, last = height * band // bands, height * (band + 1) // bands - 1
            for i in range(n):
                if not (z[i] > 0.05 and -2 < u[i] < width + 2 and first - 2 < v[i] < last + 3):
                    continue
                for y in range(max(first, int(np.ceil(v[i] - half - 0.5))), min(last, int(v[i] + half - 0.5)) + 1):
                    for x in range(max(0, int(np.ceil(u[i] - half - 0.5))), min(width - 1, int(u[i] + half - 0.5)) + 1):
                        j = k - 1
                        if z[i] >= depth[y, x, j]:
                            continue
                        while j > 0 and z[i] < depth[y, x, j - 1]:
                            depth[y, x, j], index[y, x, j] = depth[y, x, j - 1], index[y, x, j - 1]
                            j -= 1
                        depth[y, x, j], index[y, x, j] = z[i], i
        return index

    return draw  # type: ignore[no-any-return]


def measure(points: np.ndarray, camera: Camera, T: np.ndarray, threads: int, repeats: int) -> dict[str, float]:
    """Median ms of every method on one cloud and view."""

    def ipr(options: RasterOptions, *outputs: str) -> Callable[[], object]:
        return lambda: rasterize(points, camera, T, options, threads, outputs=outputs)

    calls: dict[str, Callable[[], object]] = {
        "ipr 1.5 px": ipr(FIXED, "position"),
        "ipr 1.5 px, index": ipr(FIXED, "index"),
        "ipr adaptive": ipr(adaptive(len(points)), "position"),
    }
    calls |= open3d_calls(points, camera, T)
    if importlib.util.find_spec("numba"):
        draw, T32 = numba_top_k(), T.astype(np.float32)
        view = (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
        calls["numba top-8"] = lambda: draw(points, T32, *map(np.float32, view[:4]), *view[4:], 1.5, 8, threads)
    return clouds.median_ms(calls, repeats)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, help="folder of a 7-Scenes recording")
    parser.add_argument("--out", type=Path, default=Path("rasterize.json"))
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    parser.add_argument("--repeats", type=int, default=11)
    args = parser.parse_args()
    rows: list[dict[str, Any]] = []
    for count in COUNTS:
        cloud, T = clouds.fused(args.data, count) if args.data else (clouds.walls(count), clouds.ROOM_POSE)
        for order, points in (("random", cloud), ("space", clouds.in_space_order(cloud))):
            for camera in CAMERAS if order == "random" else CAMERAS[:1]:
                ms = measure(points, camera, T, args.threads, args.repeats)
                ours = ms["ipr 1.5 px"]
                ratios = {name: value / ours for name, value in ms.items() if not name.startswith("ipr")}
                size = f"{camera.width}x{camera.height}"
                rows.append({"points": count, "order": order, "size": size, "ms": ms, "times_ipr": ratios})
                print(f"{count:8d} points in {order} order at {size}, {args.threads} threads")
                for name, value in ms.items():
                    print(f"    {name:18} {value:8.2f} ms" + (f"  {ratios[name]:5.1f} x" if name in ratios else ""))
    args.out.write_text(json.dumps({"threads": args.threads, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
