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
from pathlib import Path

import clouds
import numpy as np
from scipy.spatial import cKDTree

from sf_recon.core.native import native

K, RADIUS, QUERIES, INSERTED = 8, 0.02, 100_000, 10_000


def timed_ms(call: object) -> tuple[float, object]:
    """Wall time of one call and its result."""
    start = time.perf_counter()
    result = call()  # type: ignore[operator]
    return 1e3 * (time.perf_counter() - start), result


def measure_grid(points: np.ndarray, more: np.ndarray, queries: np.ndarray) -> dict[str, float]:
    """Build, insertion and search of the compiled grid; checks that the neighbours are the nearest ones."""

    def build() -> object:
        grid = native().PointGrid(RADIUS)
        grid.add(points)
        return grid

    build_ms, grid = timed_ms(build)
    d2 = grid.knn(queries, K, RADIUS)[1]  # type: ignore[attr-defined]
    expected = cKDTree(points).query(queries, K, distance_upper_bound=RADIUS, workers=-1)[0]
    both = np.isfinite(d2) & np.isfinite(expected)
    assert np.abs(np.sqrt(d2[both]) - expected[both]).max() < 1e-6, "a neighbour is not the nearest"
    assert (np.isfinite(d2) != np.isfinite(expected)).mean() < 1e-6, "a neighbour within the radius is missing"
    query_ms = clouds.median_ms(lambda: grid.knn(queries, K, RADIUS), 7)  # type: ignore[attr-defined]
    parts = np.array_split(more, len(more) // INSERTED)
    insert_ms = [timed_ms(lambda part=part: grid.add(part))[0] for part in parts]  # type: ignore[attr-defined, misc]
    return {"build": build_ms, "insert": float(np.median(insert_ms)), "insert_max": max(insert_ms), "query": query_ms}


def measure_trees(points: np.ndarray, queries: np.ndarray) -> dict[str, dict[str, float]]:
    """Build and search of kd-trees; inserting is building again."""
    rows = {}
    build_ms, tree = timed_ms(lambda: cKDTree(points))
    search = lambda: tree.query(queries, K, distance_upper_bound=RADIUS, workers=-1)  # type: ignore[attr-defined] # noqa: E731
    rows["scipy cKDTree"] = {"build": build_ms, "insert": build_ms, "query": clouds.median_ms(search, 3)}
    if importlib.util.find_spec("pykdtree"):
        from pykdtree.kdtree import KDTree

        build_ms, fast = timed_ms(lambda: KDTree(points))
        query_ms = clouds.median_ms(lambda: fast.query(queries, K, distance_upper_bound=RADIUS), 3)  # type: ignore[attr-defined]
        rows["pykdtree"] = {"build": build_ms, "insert": build_ms, "query": query_ms}
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
    rows = {"grid": measure_grid(points, more, queries)} | measure_trees(points, queries)
    for name, row in rows.items():
        print(f"{name:14}" + "".join(f"  {what} {ms:8.2f} ms" for what, ms in row.items()))
    args.out.write_text(json.dumps({"points": args.points, "queries": QUERIES, "k": K, "ms": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
