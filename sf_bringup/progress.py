"""A progress bar on a terminal, a quiet line now and then elsewhere."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import sys
import time
from types import TracebackType

from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as RichProgress

_QUIET_SECONDS = 15.0  # between lines where there is no terminal


class Progress:
    """Context manager; call :meth:`update` with (done, total)."""

    def __init__(self, title: str, unit: str) -> None:
        self._title, self._unit = title, unit
        self._started = self._spoken = time.monotonic()
        self._bar: RichProgress | None = None
        self._task = None
        if sys.stderr.isatty():
            columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn(unit))
            self._bar = RichProgress(
                *columns, TimeElapsedColumn(), TimeRemainingColumn(), TextColumn("{task.fields[note]}")
            )
            self._task = self._bar.add_task(title, total=None, note="")

    def __enter__(self) -> Progress:
        if self._bar is not None:
            self._bar.start()
        return self

    def update(self, done: int, total: int, note: str = "") -> None:
        """Show that ``done`` of ``total`` units are finished."""
        if self._bar is not None and self._task is not None:
            self._bar.update(self._task, completed=done, total=total, note=note)
        elif time.monotonic() - self._spoken > _QUIET_SECONDS:
            self._spoken = time.monotonic()
            print(f"{self._title}: {done}/{total} {self._unit} {note}".rstrip(), file=sys.stderr)

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()
