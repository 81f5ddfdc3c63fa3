"""``sf doctor``: is everything there that the lines need, can processes talk, and what do the topics say?

With a recording: does its depth lie on its colour?
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import importlib
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, entry_points, version
from pathlib import Path

from sf_bringup.shared_memory import orphaned_segments
from sf_interfaces.blocks import load_blocks
from sf_interfaces.errors import SceneFactoryError

_VERSIONED = ("scenefactory", "ros-jazzy-rclpy", "ros-jazzy-rmw-fastrtps-cpp", "torch", "numpy", "open3d", "mcap")
_MODELS = ("matchers", "monodepth", "covariance", "update_operators")  # entry-point groups scenefactory.*
_WANTED_SHM_MB = 512


@dataclass(frozen=True, slots=True)
class Check:
    """One finding: what was found, whether that is well, and how to mend it ("" where nothing is to be done)."""

    name: str
    ok: bool
    detail: str
    mend: str = ""


def _versions() -> Check:
    found = {}
    for name in _VERSIONED:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not a wheel"
    return Check("versions", True, ", ".join(f"{name} {number}" for name, number in found.items()))


def _import(module: str) -> Callable[[], Check]:
    def check() -> Check:
        try:
            importlib.import_module(module)
        except ImportError as error:
            return Check(module, False, str(error), "run make in the checkout, or reinstall the package")
        return Check(module, True, "imports")

    return check


def _shared_memory() -> Check:
    """Images of VGA size and more go through /dev/shm; a small one silently halves the rate."""
    if not os.path.isdir("/dev/shm"):
        return Check(
            "shared memory", False, "/dev/shm is missing: images go over UDP and are slow", "mount a tmpfs there"
        )
    usage = shutil.disk_usage("/dev/shm")
    detail = f"{usage.free >> 20} of {usage.total >> 20} MB free in /dev/shm"
    if usage.free >> 20 < _WANTED_SHM_MB:
        mend = f"make it larger ({_WANTED_SHM_MB} MB wanted): mount -o remount,size=1g /dev/shm, docker --shm-size=1g"
        return Check("shared memory", False, detail, mend)
    return Check("shared memory", True, detail)


def _orphans() -> Check:
    """Segments of processes that were killed take shared memory until somebody removes them."""
    found = orphaned_segments()
    size = sum(p.stat().st_size for p in found if p.exists()) >> 20
    if found:
        mend = "any sf up or sf run removes them at its end; or now: python -m sf_bringup.shared_memory"
        return Check("orphaned segments", size < _WANTED_SHM_MB, f"{len(found)} of dead processes, {size} MB", mend)
    return Check("orphaned segments", True, "none")


def _blocks() -> Check:
    try:
        specs = load_blocks()
    except (SceneFactoryError, ImportError, AttributeError) as error:
        return Check("blocks", False, str(error), "uninstall the package that provides the broken block")
    return Check("blocks", bool(specs), ", ".join(s.id for s in specs) or "none installed", "" if specs else "run make")


def _models() -> Check:
    found = [f"{group[:-1]} {p.name}" for group in _MODELS for p in entry_points(group=f"scenefactory.{group}")]
    return Check(
        "optional models", True, ", ".join(sorted(found)) or "none installed; the training-free defaults serve"
    )


def _torch() -> Check:
    import torch

    where = torch.cuda.get_device_name() if torch.cuda.is_available() else "CPU (no CUDA device)"
    return Check("torch", True, f"{version('torch')} on {where}, {torch.get_num_threads()} threads")


def _middleware() -> Check:
    try:
        import rclpy
        from rclpy.utilities import get_rmw_implementation_identifier

        context = rclpy.Context()
        rclpy.init(context=context)
        node = rclpy.create_node("sf_doctor", context=context)
        name = get_rmw_implementation_identifier()
        node.destroy_node()
        rclpy.try_shutdown(context=context)
    except Exception as error:  # whatever stops DDS is the finding
        return Check("middleware", False, str(error), "install the RMW: pip install 'ros-jazzy-rclpy[fastrtps]'")
    domain, reach = os.environ.get("ROS_DOMAIN_ID", "0"), os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET")
    profile = os.environ.get("FASTRTPS_DEFAULT_PROFILES_FILE", "")
    if profile and not Path(profile).is_file():
        return Check(
            "middleware", False, f"{name}, profile {profile} is missing", "unset FASTRTPS_DEFAULT_PROFILES_FILE"
        )
    return Check("middleware", True, f"{name}, domain {domain}, discovery {reach}")


def checks(seconds: float = 3.0, recording: Path | None = None) -> list[Check]:
    """All findings, in the order in which problems should be mended.

    Args:
        seconds: how long to listen to the live topics; 0: not at all.
        recording: look at this bag or data set instead of the machine.

    Raises:
        SceneFactoryError: the recording cannot be read.
    """
    if recording is not None:
        from sf_bringup.doctor_recording import recording_checks
        from sf_bringup.doctor_shutter import shutter_checks

        return recording_checks(recording) + shutter_checks(recording)
    tests = [
        _versions,
        _import("sf_interfaces.msg"),
        _import("tf2_msgs.msg"),
        _import("sf_recon._native"),
        _import("sf_tracking._native"),
        _import("sf_depth._native"),
        _torch,
        _blocks,
        _models,
        _shared_memory,
        _orphans,
        _middleware,
    ]
    found = [test() for test in tests]
    if seconds > 0 and found[-1].ok:
        from sf_bringup.doctor_topics import topic_checks

        found += topic_checks(seconds)
    return found
