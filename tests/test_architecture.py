"""The rules that keep blocks independent and files readable, checked on the syntax tree."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import ast
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
BLOCKS = ("sf_tracking", "sf_flexion", "sf_depth", "sf_recon")
PACKAGES = (*BLOCKS, "sf_interfaces", "sf_bringup")
TOP_LEVEL = {*PACKAGES, "tests", "docs", "benchmarks", ".ci"}
ROS = {"rclpy", "rosidl_runtime_py", "rclpy_lifecycle", "tf2_ros", "launch", "launch_ros"}
MAX_FILE, MAX_FUNCTION = 350, 60


def sources() -> list[Path]:
    """Python files of the six packages, relative to the root."""
    return sorted(p.relative_to(ROOT) for name in PACKAGES for p in (ROOT / name).rglob("*.py"))


def imports(path: Path) -> Iterator[tuple[int, str]]:
    """Line and absolute dotted name of every import, also those inside functions."""
    for node in ast.walk(ast.parse((ROOT / path).read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            anchor = ".".join(path.parent.parts[: len(path.parent.parts) - node.level + 1]) if node.level else ""
            base = ".".join(part for part in (anchor, node.module) if part)
            yield from ((node.lineno, f"{base}.{alias.name}") for alias in node.names)


def is_ros(name: str) -> bool:
    """Whether an import brings rclpy or a message package, generated ones of ours included."""
    parts = name.split(".")
    generated = parts[0] != "sf_interfaces" and parts[0].endswith(("_msgs", "_interfaces"))
    return parts[0] in ROS or generated or parts[:2] in (["sf_interfaces", "msg"], ["sf_interfaces", "srv"])


def must_be_free_of_ros(path: Path) -> bool:
    return "core" in path.parts or (path.parts[0] == "sf_interfaces" and path.parts[1] != "ros")


def report(findings: list[str], rule: str) -> None:
    assert not findings, f"{rule}:\n  " + "\n  ".join(findings)


def test_top_level_holds_no_other_package() -> None:
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("not a git checkout")
    folders = {line.split("/")[0] for line in listed.stdout.splitlines() if "/" in line}
    report(sorted(folders - TOP_LEVEL), "folders that the layout does not know")


@pytest.mark.parametrize("block", BLOCKS)
def test_a_block_has_the_four_names(block: str) -> None:
    missing = [n for n in ("block.py", "config.py", "node.py", "core/__init__.py") if not (ROOT / block / n).is_file()]
    report(missing, f"missing in {block}")


def test_cores_and_vocabulary_do_not_import_ros() -> None:
    found = [
        f"{path}:{line} imports {name}"
        for path in filter(must_be_free_of_ros, sources())
        for line, name in imports(path)
        if is_ros(name)
    ]
    report(found, "core/ and sf_interfaces outside ros/ work without ROS")


def test_blocks_import_only_the_vocabulary() -> None:
    found = [
        f"{path}:{line} imports {name}"
        for path in sources()
        if path.parts[0] != "sf_bringup"
        for line, name in imports(path)
        if name.split(".")[0] in PACKAGES and name.split(".")[0] not in (path.parts[0], "sf_interfaces")
    ]
    report(found, "blocks import sf_interfaces only, never each other")


def test_only_entry_points_tell_bringup_about_blocks() -> None:
    found = [
        f"{path}:{line} imports {name}"
        for path in sources()
        if path.parts[0] == "sf_bringup"
        for line, name in imports(path)
        if name.split(".")[0] in BLOCKS and name.split(".")[1:2] in (["block"], ["node"])
    ]
    report(found, "sf_bringup finds blocks through entry points")


def test_files_and_functions_stay_short() -> None:
    found = []
    for path in sources():
        text = (ROOT / path).read_text(encoding="utf-8")
        if (length := len(text.splitlines())) > MAX_FILE:
            found.append(f"{path} has {length} lines, at most {MAX_FILE}")
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                size = (node.end_lineno or node.lineno) - node.lineno + 1
                if size > MAX_FUNCTION:
                    found.append(f"{path}:{node.lineno} {node.name}() has {size} lines, at most {MAX_FUNCTION}")
    report(found, "too long")


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("rclpy.node.Node", True),
        ("sensor_msgs.msg.Image", True),
        ("builtin_interfaces.msg.Time", True),
        ("sf_interfaces.msg.StreamState", True),
        ("sf_interfaces.types.Frame", False),
        ("numpy", False),
    ],
)
def test_the_ros_check_tells_messages_from_vocabulary(name: str, expected: bool) -> None:
    assert is_ros(name) is expected
