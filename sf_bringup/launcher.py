"""Processes of the graph: started with the right environment, watched, and never left behind."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from sf_bringup.launcher_env import node_environment
from sf_bringup.wiring import NodeLaunch

_PR_SET_PDEATHSIG = 1
_INTERRUPT_S, _TERMINATE_S = 1.5, 1.0  # together below the 3 s in which everything has to be gone
_LIBC = ctypes.CDLL(None) if sys.platform == "linux" else None  # loaded before the fork


def _in_child(nice: int) -> None:
    """Give way by ``nice``, and ask Linux for SIGTERM when the parent dies, even by SIGKILL."""
    os.nice(nice)
    if _LIBC is not None:
        _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


class Process:
    """One child in a process group of its own, its output in a log file.

    Start it from the main thread: Linux ties the death signal to the thread that forked.
    """

    def __init__(
        self,
        name: str,
        command: Sequence[str],
        log: Path,
        environment: Mapping[str, str] | None = None,
        nice: int = 0,
    ) -> None:
        self.name, self.log = name, log
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("ab") as output:
            self._child = subprocess.Popen(
                list(command),
                env=dict(environment or node_environment()),
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                preexec_fn=lambda: _in_child(nice),
            )

    @property
    def pid(self) -> int:
        """Process id."""
        return self._child.pid

    def poll(self) -> int | None:
        """Exit code, None while it runs."""
        return self._child.poll()

    def send(self, number: signal.Signals) -> None:
        """Signal the child's whole group; a child that is gone already is no error."""
        try:
            os.killpg(self._child.pid, number)
        except ProcessLookupError:
            return

    def last_lines(self, count: int = 8) -> str:
        """The end of its log."""
        return "\n".join(self.log.read_text(errors="replace").splitlines()[-count:])


def node_command(launch: NodeLaunch, folder: Path) -> list[str]:
    """The command of a node; its parameters go through a YAML file beside its log."""
    path = folder / f"{launch.name}.params.yaml"
    folder.mkdir(parents=True, exist_ok=True)
    values: dict[str, Any] = {k: v for k, v in launch.parameters.items() if v != [] and v != ()}
    path.write_text(yaml.safe_dump({f"/sf/{launch.name}": {"ros__parameters": values}}))
    remaps = [part for own, real in launch.remaps.items() for part in ("-r", f"{own}:={real}")]
    return [sys.executable, "-m", launch.module, "--ros-args", "--params-file", str(path), *remaps]


def stop_all(processes: Sequence[Process], interrupt_s: float = _INTERRUPT_S) -> list[str]:
    """End every process: SIGINT, then SIGTERM, then SIGKILL; all are gone when this returns.

    Returns:
        Names of those that had to be ended before they had completed what SIGINT lets them complete.
    """
    running = [p for p in processes if p.poll() is None]
    cut_short: list[str] = []
    for number, patience in (
        (signal.SIGINT, interrupt_s),
        (signal.SIGTERM, _TERMINATE_S),
        (signal.SIGKILL, 1.0),
    ):
        for process in running:
            process.send(number)
        deadline = time.monotonic() + patience
        while running and time.monotonic() < deadline:
            running = [p for p in running if p.poll() is None]
            time.sleep(0.02)
        if number == signal.SIGINT:
            cut_short = [p.name for p in running]
        if not running:
            break
    return cut_short
