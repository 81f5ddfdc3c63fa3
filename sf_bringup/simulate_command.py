"""``sf simulate``: the arguments of a simulation, apart from the renderer so that help stays fast."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from sf_interfaces.errors import ConfigError

_CHANGES = (
    "frames",
    "fps",
    "width",
    "height",
    "focal",
    "depth",
    "lidar",
    "lidar_hz",
    "seed",
    "supersampling",
    "blur",
    "readout",
    "novel_views",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what can be changed of a preset."""
    parser.add_argument(
        "scene", help="a preset (demo, room, hall, palace, garden, campus, room0-2, office0-4) or a .world file"
    )
    parser.add_argument("out", type=Path, help="the bag to write, .mcap")
    for name, kind in (
        ("frames", int),
        ("width", int),
        ("height", int),
        ("seed", int),
        ("supersampling", int),
    ):
        parser.add_argument(f"--{name}", type=kind)
    parser.add_argument("--novel-views", type=int, help="images off the path, to measure extrapolation with")
    parser.add_argument("--mesh", type=Path, help="also write the true surface as .ply, in the bag's map frame")
    for name in ("fps", "focal", "lidar-hz"):
        parser.add_argument(f"--{name}", type=float)
    parser.add_argument(
        "--blur", type=float, help="exposure in s: motion within it blurs the images, depth stays sharp"
    )
    parser.add_argument(
        "--readout", type=float, help="s from the first to the last row of an image: a rolling shutter, depth has none"
    )
    parser.add_argument("--depth", help="none, exact, structured_light or tof")
    parser.add_argument("--lidar", help="none, spinning64, spinning128 or rosette")
    parser.add_argument("--no-rgb", action="store_true", help="leave the colour images out")
    parser.add_argument("--no-ground-truth-depth", action="store_true")


def simulate_command(args: argparse.Namespace) -> int:
    """Simulate and say what was written.

    Raises:
        ConfigError: unknown preset or sensor.
    """
    from sf_bringup.progress import Progress
    from sf_bringup.simulate import PRESETS, SimulationSpec, simulate

    if args.scene in PRESETS:
        spec = PRESETS[args.scene]
    elif args.scene.endswith(".world"):
        if not Path(args.scene).is_file():
            raise ConfigError(f"no world file {args.scene}; give an existing one or a preset: {', '.join(PRESETS)}")
        spec = SimulationSpec(args.scene)
    else:
        raise ConfigError(f"unknown scene '{args.scene}'; choose a .world file or one of {', '.join(PRESETS)}")
    changes: dict[str, Any] = {name: value for name in _CHANGES if (value := getattr(args, name)) is not None}
    if args.no_rgb:
        changes["rgb"] = False
    if args.no_ground_truth_depth:
        changes["ground_truth_depth"] = False
    args.out.parent.mkdir(parents=True, exist_ok=True)
    with Progress("simulating", "frames") as progress:
        made = simulate(replace(spec, **changes), args.out, progress.update, args.mesh)
    value = {
        "out": str(args.out),
        "frames": made.frames,
        "sweeps": made.sweeps,
        "seconds": made.duration_s,
        "wall_seconds": made.wall_s,
    }
    text = (
        f"wrote {args.out}: {made.frames} frames, {made.sweeps} sweeps, {made.duration_s:.1f} s in {made.wall_s:.1f} s"
    )
    print(json.dumps(value) if args.json else text)
    return 0
