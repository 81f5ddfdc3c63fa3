"""A node as a process: signals, the parent's death, and exit codes."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import ctypes
import os
import signal
import sys
import time
from collections.abc import Callable
from types import FrameType

import rclpy
from rclpy._rclpy_pybind11 import RCLError
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from sf_interfaces.errors import SceneFactoryError
from sf_interfaces.ros.node import BlockNode

_PR_SET_PDEATHSIG = 1
_SPIN_S = 0.1
_STOP_S = 0.6  # for the worker to complete after SIGTERM; the process is gone within 1 s
_SAVE_S = 60.0  # after SIGINT, for a live node to write its results; SIGTERM ends that too


def die_with_parent() -> None:
    """Ask Linux for SIGTERM when the parent dies, so that no node outlives its orchestrator."""
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


def run(make: Callable[[], BlockNode], args: list[str] | None = None) -> int:
    """Run a node until it is shut down, its parent dies or a signal comes.

    Returns:
        0 = done, 2 = configuration refused (one sentence on stderr), 1 = bug.
    """
    die_with_parent()
    parent = os.getppid()
    stopping: list[int] = []

    def stop(number: int, _: FrameType | None) -> None:
        stopping.append(number)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = make()
    except SceneFactoryError as error:
        print(error, file=sys.stderr)
        rclpy.shutdown()
        return 2
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    if node.options.autostart:
        node.trigger_configure()
        if node.exit_code is None:
            node.trigger_activate()
    while not stopping and node.exit_code is None and os.getppid() == parent:
        try:
            executor.spin_once(timeout_sec=_SPIN_S)
        except RCLError as error:  # a lifecycle request that does not fit the state, such as one asked twice
            node.get_logger().warning(str(error))
    code = node.exit_code or 0
    if not _finished(node, stopping):
        sys.stderr.flush()
        # The worker is inside a long computation: its results are given up, as the signal asks.
        os._exit(code)
    executor.remove_node(node)
    node.destroy_node()
    rclpy.shutdown()
    return code


def _finished(node: BlockNode, signals: list[int]) -> bool:
    """Let the worker complete; True if it did before its time was over or another signal came."""
    patient = signals[:1] == [signal.SIGINT] and node.state("") is not None
    deadline = time.monotonic() + (_SAVE_S if patient else _STOP_S)
    while not node.stop(_SPIN_S):
        if patient and signal.SIGTERM in signals:
            patient, deadline = False, min(deadline, time.monotonic() + _STOP_S)
        if time.monotonic() > deadline:
            return False
    return True
