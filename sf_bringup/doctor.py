"""``sf doctor``: is everything installed that the lines need, and can processes on this machine talk?"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import importlib
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version

from sf_interfaces.blocks import load_blocks


@dataclass(frozen=True, slots=True)
class Check:
    """One finding; ``detail`` says what was found, or what to do."""

    name: str
    ok: bool
    detail: str


def _import(module: str, remedy: str) -> Callable[[], Check]:
    def check() -> Check:
        try:
            importlib.import_module(module)
        except ImportError as error:
            return Check(module, False, f"{error}; {remedy}")
        return Check(module, True, "imports")

    return check


def _ros() -> Check:
    try:
        import rclpy

        rclpy.init()
        node = rclpy.create_node("sf_doctor")
        names = node.get_node_names()
        node.destroy_node()
        rclpy.try_shutdown()
    except Exception as error:  # whatever stops DDS is the finding
        return Check("ros graph", False, f"{error}; install the RMW: pip install 'ros-jazzy-rclpy[fastrtps]'")
    domain = os.environ.get("ROS_DOMAIN_ID", "0")
    others = sorted(n for n in names if n != "sf_doctor")
    return Check("ros graph", True, f"domain {domain}, other nodes: {', '.join(others) or 'none'}")


def _shared_memory() -> Check:
    """Images of VGA size and more go through /dev/shm; a small one silently halves the rate."""
    if not os.path.isdir("/dev/shm"):
        return Check(
            "shared memory",
            False,
            "/dev/shm is missing: images go over UDP and are slow; mount a tmpfs there",
        )
    free = shutil.disk_usage("/dev/shm").free // 2**20
    return Check("shared memory", free > 512, f"{free} MB free in /dev/shm (512 MB wanted for large messages)")


def _blocks() -> Check:
    specs = load_blocks()
    return Check("blocks", bool(specs), ", ".join(s.id for s in specs) or "none installed; reinstall with make")


def _torch() -> Check:
    import torch

    where = torch.cuda.get_device_name() if torch.cuda.is_available() else "CPU"
    return Check("torch", True, f"{version('torch')} on {where}, {torch.get_num_threads()} threads")


def checks() -> list[Check]:
    """All findings, in the order in which problems should be mended."""
    remedy = "run make in the checkout, or reinstall the package"
    tests = [
        _import("sf_interfaces.msg", remedy),
        _import("tf2_msgs.msg", remedy),
        _import("sf_recon._native", remedy),
        _torch,
        _blocks,
        _shared_memory,
        _ros,
    ]
    return [test() for test in tests]
