"""Work that is done beside the tracking of the next frames, on another core.

Its result is asked for at a fixed point of the sequence, so what comes out does not depend on when it was done.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import ParamSpec, TypeVar

P, R = ParamSpec("P"), TypeVar("R")

_WORKER = ThreadPoolExecutor(1, "beside tracking")


def beside(work: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> Future[R]:
    """Begin a function of values that nobody changes meanwhile; :meth:`Future.result` waits for it."""
    return _WORKER.submit(work, *args, **kwargs)
