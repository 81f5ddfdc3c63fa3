"""The command line: one verb per task, one sentence per error (exit code 2), a traceback only for bugs (1)."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import argparse
import importlib
import json
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from sf_interfaces.errors import ConfigError, SceneFactoryError

# Verbs that are programs of their own: their arguments go to that module's main untouched.
PASSED_ON = {
    "up": ("sf_bringup.orchestrator", "orchestrate a line on live topics"),
    "play": ("sf_bringup.player", "publish a bag, live or lossless"),
    "record": ("sf_bringup.recorder", "record topics to mcap"),
}
_EXPORTS = {
    "tum": "trajectory.tum",
    "kitti": "trajectory.kitti",
    "euroc": "trajectory.csv in EuRoC's columns",
    "ply": "coloured surface and mesh",
    "glb": "coloured mesh as binary glTF",
    "depth": "keyframe depth as 16-bit PNG (mm) and NPZ with variance",
    "colmap": "COLMAP text model with images",
    "mvsnet": "images, cameras and pairs as MVSNet reads them",
    "nerfstudio": "transforms.json with images and depth",
}
GOALS = ("auto", "tracking", "slam", "recon", "mvd", "completion")


def _overrides(pairs: Sequence[str]) -> dict[str, str]:
    out = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not equals:
            raise ConfigError(f"--set {pair}: write it as section.key=value")
        out[key] = value
    return out


def _reading(args: argparse.Namespace) -> Any:
    from sf_interfaces.io.datasets import ReadOptions

    return ReadOptions(skip_bad=args.skip_bad, use_poses=args.use_poses, depth_scale=args.depth_scale)


def _print(value: Any, as_json: bool, text: str) -> None:
    print(json.dumps(value, default=str) if as_json else text)


def _run(args: argparse.Namespace) -> int:
    from sf_bringup.runner import RunRequest, run

    request = RunRequest(
        inputs=tuple(args.input),
        goal=args.goal,
        engine=args.engine,
        out=args.out,
        calibration=args.calibration,
        poses=args.poses,
        extrinsic=args.extrinsic,
        config=args.config,
        overrides=_overrides(args.set),
        mapping=_overrides(args.map),
        use=tuple(args.use),
        rate=args.rate,
        reading=_reading(args),
    )
    summary = run(request)
    _print(summary.values, args.json, summary.text())
    return 0


def _plan(args: argparse.Namespace) -> int:
    from sf_bringup.runner import RunRequest, explain

    value, text = explain(
        RunRequest(
            inputs=tuple(args.input),
            goal=args.goal,
            calibration=args.calibration,
            poses=args.poses,
            mapping=_overrides(args.map),
            use=tuple(args.use),
            reading=_reading(args),
        )
    )
    _print(value, args.json, text)
    return 0


def _convert(args: argparse.Namespace) -> int:
    from sf_bringup.inputs import convert

    written, counts = convert(args.dataset, args.out, replace(_reading(args), limit=args.limit))
    value = {
        "out": str(args.out),
        "dataset": written.dataset,
        "frames": written.frames,
        "skipped": written.skipped,
        "reasons": written.reasons,
        "notes": list(written.notes),
        "topics": counts,
    }
    topics = ", ".join(f"{count} {name}" for name, count in counts.items())
    _print(value, args.json, "\n".join([*written.sentences(), f"wrote {args.out}: {topics}"]))
    return 0


def _simulate(args: argparse.Namespace) -> int:
    from sf_bringup.simulate_command import simulate_command

    return simulate_command(args)


def _blocks(args: argparse.Namespace) -> int:
    from sf_interfaces.blocks import load_blocks

    specs = load_blocks()
    value = [
        {
            "id": s.id,
            "provides": sorted(q.value for q in s.provides),
            "requires": sorted(q.value for q in s.requires),
            "optional": sorted(q.value for q in s.optional),
            "runs": s.executable,
        }
        for s in specs
    ]
    lines = [
        f"{v['id']:16} {', '.join(v['requires'])} -> {', '.join(v['provides'])}"
        + ("" if v["runs"] else "   (planned only: this version does not run it)")
        for v in value
    ]
    _print(value, args.json, "\n".join(lines))
    return 0


def _doctor(args: argparse.Namespace) -> int:
    from sf_bringup.doctor import checks

    rows = checks(args.seconds, args.recording)
    value = [{"check": c.name, "ok": c.ok, "detail": c.detail, "mend": c.mend} for c in rows]
    lines = [f"{'ok  ' if c.ok else 'FAIL'} {c.name}: {c.detail}{f'; {c.mend}' if c.mend else ''}" for c in rows]
    _print(value, args.json, "\n".join(lines))
    return 0 if all(c.ok for c in rows) else 2


def _demo(args: argparse.Namespace) -> int:
    from sf_bringup.demo import demo

    summary = demo(args.out, args.engine)
    _print(summary.values, args.json, summary.text())
    return 0


def _render(args: argparse.Namespace) -> int:
    if args.fly is not None:
        from sf_bringup.flythrough import fly

        count = fly(args.run, args.fly, args.out)
    else:
        from sf_bringup.looking import render_views

        count = render_views(args.run, args.poses, args.out)
    _print({"views": count}, args.json, f"wrote {count} views to {args.out}")
    return 0


def _view(args: argparse.Namespace) -> int:
    from sf_bringup.looking import view

    view(args.run, args.host, args.port, lambda url: _print({"url": url}, args.json, f"{url}   (Ctrl-C ends)"))
    return 0


def _export(args: argparse.Namespace) -> int:
    from sf_bringup.export import export

    wanted = [name for name in _EXPORTS if getattr(args, name)]
    written, left_out = export(args.run, args.out, wanted, args.frame)
    lines = [*(f"wrote {p}" for p in written), *(f"no {name}: {why}" for name, why in left_out.items())]
    _print({"written": [str(p) for p in written], "left_out": left_out}, args.json, "\n".join(lines))
    return 0


def _eval(args: argparse.Namespace) -> int:
    from sf_bringup.eval_command import eval_command

    return eval_command(args)


def _report(args: argparse.Namespace) -> int:
    from sf_bringup.bench_report import is_run, write_bench_page
    from sf_bringup.run_folder import RunFolder
    from sf_bringup.summary import summarise, write_page

    if not is_run(args.run):
        page = write_bench_page(args.run)
        _print({"report": str(page)}, args.json, f"wrote {page}")
        return 0
    summary = summarise(RunFolder.open(args.run))
    write_page(summary)
    _print(summary.values, args.json, summary.text())
    return 0


def _add_reading(parser: argparse.ArgumentParser) -> None:
    """How a data set is read."""
    parser.add_argument("--skip-bad", action="store_true", help="leave out frames whose files are bad, and count them")
    parser.add_argument("--use-poses", action="store_true", help="its poses are input, not only a reference")
    parser.add_argument("--depth-scale", type=float, metavar="N", help="stored depth units in a metre, if not its own")


def _add_convert(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("dataset", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--limit", type=int, metavar="N", help="only the first so many frames")
    _add_reading(parser)


def _add_input(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "input",
        nargs="+",
        type=Path,
        help="bag (.mcap, .db3, .bag, rosbag2 folder), data set folder, folder of photos, or video",
    )
    _add_reading(parser)
    parser.add_argument("--goal", choices=GOALS, default="auto")
    parser.add_argument("--calibration", type=Path, help="camera.yaml in ROS camera_info format")
    parser.add_argument("--poses", type=Path, help="given poses, TUM format, T_map_camera")
    parser.add_argument(
        "--map",
        action="append",
        default=[],
        metavar="ROLE=TOPIC",
        help="take this topic as rgb, depth, lidar or pose",
    )
    parser.add_argument("--use", action="append", default=[], metavar="BLOCK", help="prefer this block (sf blocks)")


def _add_export(p: argparse.ArgumentParser) -> None:
    p.add_argument("run", type=Path)
    p.add_argument("--out", type=Path, required=True)
    p.add_argument("--frame", choices=("camera", "base_link", "lidar"), default="camera", help="whose trajectory")
    for form, what in _EXPORTS.items():
        p.add_argument(f"--{form}", action="store_true", help=what)


def _add_view(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", type=Path)
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on (default: this machine only)")
    parser.add_argument("--port", type=int, default=8080)


def build_parser() -> argparse.ArgumentParser:
    """The parser alone, without importing any block: help and completion stay fast."""
    parser = argparse.ArgumentParser(
        prog="sf", description="SceneFactory: production lines for scene modelling on ROS 2"
    )
    verbs = parser.add_subparsers(dest="verb", required=True)

    def verb(name: str, action: Callable[[argparse.Namespace], int], help: str) -> argparse.ArgumentParser:
        sub = verbs.add_parser(name, help=help, description=help)
        sub.add_argument("--json", action="store_true", help="print one JSON object")
        sub.set_defaults(action=action)
        return sub

    p = verb("run", _run, "run the line that the input needs, from file to results")
    _add_input(p)
    p.add_argument("--engine", choices=("inproc", "ros"), default="inproc")
    p.add_argument("--out", type=Path, default=Path("out"))
    p.add_argument("--extrinsic", type=Path, help="T_camera_lidar as a 4x4 text file, if the input has no /tf_static")
    p.add_argument("--config", type=Path)
    p.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    p.add_argument("--rate", type=float, default=0.0, help="play live at this rate (ros engine); 0 = lossless")

    _add_input(verb("plan", _plan, "print the line and why, without computing"))
    for name, (_, help) in PASSED_ON.items():
        verbs.add_parser(name, help=help, add_help=False)

    _add_convert(verb("convert", _convert, "write a data set as an mcap bag"))

    p = verb("simulate", _simulate, "write a bag with exact ground truth from a procedural scene")
    from sf_bringup.simulate_command import add_arguments

    add_arguments(p)

    verb("blocks", _blocks, "list the installed blocks")
    p = verb("doctor", _doctor, "check the installation, the machine and the live topics, or a recording")
    p.add_argument("recording", nargs="?", type=Path, help="bag or data set: does its depth lie on its colour?")
    p.add_argument("--seconds", type=float, default=3.0, help="listen to live topics this long (0: not at all)")
    p = verb("demo", _demo, "simulate, play, record, measure: the whole system in one command")
    p.add_argument("--out", type=Path, default=Path("demo"))
    p.add_argument("--engine", choices=("inproc", "ros"), default="ros")

    p = verb("render", _render, "render views of a finished run")
    p.add_argument("run", type=Path)
    way = p.add_mutually_exclusive_group(required=True)
    way.add_argument("--poses", type=Path, help="T_map_camera in TUM format")
    way.add_argument("--fly", type=int, metavar="N", help="N frames along the smoothed way of the keyframes")
    p.add_argument("--out", type=Path, required=True, help="folder of images; with --fly also a .mp4 or .webp file")
    _add_view(verb("view", _view, "serve a page that shows the map of a finished run"))

    p = verb("export", _export, "write the results of a run in other formats; without a format: all it has")
    _add_export(p)

    from sf_bringup import eval_command

    p = verbs.add_parser("eval", help="measure a run or plain files against a reference")
    p.set_defaults(action=_eval)
    eval_command.add_arguments(p)
    p = verb("report", _report, "write report.html of a run, or of a folder of benchmark results")
    p.add_argument("run", type=Path, help="folder of a run, or of JSON files")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb. Returns 0 done, 2 bad input (one sentence on stderr); a bug raises (exit code 1)."""
    argv = list(sys.argv[1:] if argv is None else argv)
    # Read when the first library with OpenMP is loaded: its threads must not spin while others need the cores.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    try:
        if argv and argv[0] in PASSED_ON:
            return int(importlib.import_module(PASSED_ON[argv[0]][0]).main(argv[1:]) or 0)
        args = build_parser().parse_args(argv)
        return int(args.action(args))
    except SceneFactoryError as error:
        print(f"sf: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    sys.exit(main())
