"""Time of the K nearest neural points: build, insert and search against kd-trees.

    python benchmarks/neighbours.py [--data FOLDER] [--out neighbours.json] [--points N]

100,000 queries in random order, 5 mm off the surface, K = 8, radius 2 cm. FOLDER is a 7-Scenes recording;
without it, points on the walls of a room. kd-trees are rebuilt to insert. pykdtree is measured where it is
installed. Prints a table, checks the result against scipy, and writes JSON.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import argparse
import importlib.util
import json
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import clouds
import numpy as np
from scipy.spatial import cKDTree

from sf_recon.core.native import native

K, RADIUS, QUERIES, INSERTED = 8, 0.02, 100_000, 10_000


def timed_ms(call: Callable[[], Any]) -> tuple[float, Any]:
    """Wall time of one call and its result."""
    start = time.perf_counter()
    result = call()
    return 1e3 * (time.perf_counter() - start), result


def filled_grid(points: np.ndarray) -> Any:
    """The compiled grid with these points."""
    grid = native().PointGrid(RADIUS)
    grid.add(points)
    return grid


def check(grid: Any, points: np.ndarray, queries: np.ndarray) -> None:
    """The neighbours within the radius are the nearest ones, by scipy."""
    d2 = grid.knn(queries, K, RADIUS)[1]
    expected = cKDTree(points).query(queries, K, distance_upper_bound=RADIUS, workers=-1)[0]
    both = np.isfinite(d2) & np.isfinite(expected)
    assert np.abs(np.sqrt(d2[both]) - expected[both]).max() < 1e-6, "a neighbour is not the nearest"
    assert (np.isfinite(d2) != np.isfinite(expected)).mean() < 1e-6, "a neighbour within the radius is missing"


def measure(points: np.ndarray, more: np.ndarray, queries: np.ndarray) -> dict[str, dict[str, float]]:
    """Build, insertion and search in ms; to insert into a kd-tree is to build it again."""
    builds: dict[str, Callable[[], Any]] = {"grid": lambda: filled_grid(points), "scipy": lambda: cKDTree(points)}
    if importlib.util.find_spec("pykdtree"):
        from pykdtree.kdtree import KDTree

        builds["pykdtree"] = lambda: KDTree(points)
    build_ms, found = {}, {}
    for name, build in builds.items():
        build_ms[name], found[name] = timed_ms(build)
    check(found["grid"], points, queries)
    searches: dict[str, Callable[[], Any]] = {
        "grid": lambda: found["grid"].knn(queries, K, RADIUS),
        "scipy": lambda: found["scipy"].query(queries, K, distance_upper_bound=RADIUS, workers=-1),
    }
    if "pykdtree" in found:
        searches["pykdtree"] = lambda: found["pykdtree"].query(queries, K, distance_upper_bound=RADIUS)
    query_ms = clouds.median_ms(searches, 5)
    parts = np.array_split(more, len(more) // INSERTED)
    insert_ms = [timed_ms(partial(found["grid"].add, part))[0] for part in parts]
    rows = {name: {"build": build_ms[name], "insert": build_ms[name], "query": query_ms[name]} for name in builds}
    rows["grid"] |= {"insert": float(np.median(insert_ms)), "insert_max": max(insert_ms)}
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, help="folder of a 7-Scenes recording")
    parser.add_argument("--out", type=Path, default=Path("neighbours.json"))
    parser.add_argument("--points", type=int, default=1_000_000)
    args = parser.parse_args()
    total = args.points + QUERIES + 10 * INSERTED
    cloud = clouds.fused(args.data, total)[0] if args.data else clouds.walls(total)
    points, queries, more = np.split(cloud, [args.points, args.points + QUERIES])
    queries = queries + np.random.default_rng(1).normal(0, 0.005, queries.shape).astype(np.float32)
    rows = measure(points, more, queries)
    for name, row in rows.items():
        print(f"{name:14}" + "".join(f"  {what} {ms:8.2f} ms" for what, ms in row.items()))
    args.out.write_text(json.dumps({"points": args.points, "queries": QUERIES, "k": K, "ms": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
