"""All benchmarks one after the other, and one report of them. --full is hours of work, without it minutes.

python benchmarks/all.py [--full] [--data FOLDER] [--only rooms speed] [--out bench]
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from pathlib import Path

from sf_bringup.bench_report import write_bench_page

HERE = Path(__file__).parent
# name -> arguments of the quick run, of the full run.
_ROOMS = ["room0", "room1", "room2", "office0", "office1", "office2", "office3", "office4"]
FOLDER = {
    "speed": (["--factor", "1"], ["--frames", "300", "--stride", "1", "--factor", "1"]),
    "rooms": ([], ["--rooms", *_ROOMS, "--frames", "2000", "--stride", "1", "--factor", "1"]),
    "noise": ([], ["--rooms", *_ROOMS, "--frames", "300"]),
    "rooms_given": (
        ["--frames", "60"],
        ["--rooms", *_ROOMS, "--frames", "2000", "--stride", "1", "--factor", "1", "--every", "10"],
    ),
    "depth": (["--line", "room0"], ["--all", "--oracle", "--line", *_ROOMS, "hall"]),
    "live_map": ([], []),
    "colour": (["--methods", "ours", "warp"], []),
    "map_memory": (["--keyframes", "12"], ["--keyframes", "100"]),
    "loops": (
        ["--walks", "room-rgbd", "room-mono", "--factor", "0.25", "--lost"],
        ["--lost", "--memory", "10000"],
    ),
    "scales": ([], ["--frames", "400", "--factor", "1"]),
    "registration": (
        ["--scenes", "room0", "--frames", "16"],
        ["--scenes", "room0", "office0", "lounge", "room", "hall", "office3", "office1", "room1"],
    ),
    "real": ([], ["--frames", "1000", "--full"]),
}
# Those that write one file, by --out FILE.
FILE = {
    "rasterize": (["--repeats", "5"], []),
    "neighbours": ([], []),
    "play_record": (["--frames", "90", "--rates", "1", "4"], []),
    "completion": ([], []),
}
NEED_DATA = ("real", "completion", "live_map", "colour")
USE_DATA = (*NEED_DATA, "depth", "registration")


def commands(full: bool, data: Path | None, out: Path) -> dict[str, list[str]]:
    """Benchmark -> its command; those whose script or data is not here are left out."""
    found = {}
    for name, (quick, everything) in {**FOLDER, **FILE}.items():
        script = HERE / f"{name}.py"
        if not script.is_file() or (name in NEED_DATA and data is None):
            continue
        target = out if name in FOLDER else out / f"{name}.json"
        command = [sys.executable, str(script), "--out", str(target), *(everything if full else quick)]
        found[name] = [*command, "--data", str(data)] if name in USE_DATA and data is not None else command
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--full", action="store_true")
    parser.add_argument("--data", type=Path, help="folder of real recordings")
    parser.add_argument("--only", nargs="+", choices=sorted({**FOLDER, **FILE}))
    parser.add_argument("--out", type=Path, default=Path("bench"))
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    # Threads that wait must not spin: on few cores they would take the time of those that work.
    environment = {"OMP_WAIT_POLICY": "PASSIVE", **os.environ}
    failed = []
    for name, command in commands(args.full, args.data, args.out).items():
        if args.only and name not in args.only:
            continue
        print(f"== {name}", flush=True)
        start = time.monotonic()
        if subprocess.run(command, check=False, env=environment).returncode:
            failed.append(name)
        print(f"== {name}: {time.monotonic() - start:.0f} s", flush=True)
    print(f"wrote {write_bench_page(args.out)}")
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
