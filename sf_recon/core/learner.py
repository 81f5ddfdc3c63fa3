"""The learning thread of a live map (Sec. III-D-1), and the lock that lets others in between its iterations."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import threading
import time
from collections import deque
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from sf_recon.core.reconstruction import Reconstruction


class FairLock:
    """A lock that is given in the order of asking, so that a thread in a tight loop starves nobody.

    The thread that holds it may ask again, as with :class:`threading.RLock`.
    """

    def __init__(self) -> None:
        self._inner = threading.Lock()
        self._waiting: deque[threading.Event] = deque()
        self._owner: int | None = None
        self._depth = 0

    def __enter__(self) -> FairLock:
        me = threading.get_ident()
        turn = threading.Event()
        with self._inner:
            if self._owner == me:
                self._depth += 1
                return self
            if self._owner is None:
                self._owner, self._depth = me, 1
                return self
            self._waiting.append(turn)
        turn.wait()  # the one that leaves has already made the lock ours
        with self._inner:
            self._owner = me
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._inner:
            self._depth -= 1
            if self._depth:
                return
            if self._waiting:
                self._owner, self._depth = -1, 1  # nobody's ident: handed over, not free
                self._waiting.popleft().set()
            else:
                self._owner = None


class Learner:
    """Trains a map between its keyframes until every keyframe has had its turns.

    Args:
        lock: held during one iteration; take it for everything else that touches the map.
    """

    def __init__(self, reconstruction: Reconstruction, lock: FairLock) -> None:
        self._map, self._lock = reconstruction, lock
        self._goal, self._turns = reconstruction.config.psnr_goal, reconstruction.config.live_turns
        self._wake = threading.Event()
        self._stopped = False
        self._arrived: dict[int, float] = {}
        self.reached: dict[int, float] = {}
        self.iterations, self.seconds = 0, 0.0
        self._thread = threading.Thread(target=self._run, name="learner", daemon=True)
        self._thread.start()

    def arrived(self, stamp_ns: int, since: float | None = None) -> None:
        """A keyframe was placed; ``since`` is the monotonic clock when it came in (None: now)."""
        self._arrived[stamp_ns] = time.monotonic() if since is None else since
        self._wake.set()

    def stop(self) -> None:
        """End after the iteration that is under way."""
        self._stopped = True
        self._wake.set()
        self._thread.join()

    def timing(self) -> dict[str, Any]:
        """How fast keyframes were learnt: for timing.json."""
        times = list(self.reached.values())
        return {
            "psnr_goal_db": self._goal,
            "keyframes": len(self._arrived),
            "keyframes_at_goal": len(times),
            "seconds_to_goal_median": float(np.median(times)) if times else None,
            "seconds_to_goal_max": max(times, default=None),
            "seconds_to_goal": {str(stamp): seconds for stamp, seconds in self.reached.items()},
            "iterations": self.iterations,
            "iterations_per_s": self.iterations / self.seconds if self.seconds else 0.0,
        }

    def write_timing(self, path: Path) -> None:
        """Put :meth:`timing` under ``recon`` of a JSON file, beside what others wrote there."""
        known = json.loads(path.read_text()) if path.is_file() else {}
        path.write_text(json.dumps(known | {"recon": self.timing()}, indent=2))

    def _run(self) -> None:
        while not self._stopped:
            started = time.monotonic()
            with self._lock:
                least = min((view.turns for view in self._map.views), default=self._turns)
                trained = self._map.learn() if least < self._turns else None
            if trained is None:
                self._wake.wait(0.5)
                self._wake.clear()
                continue
            view, loss = trained
            now = time.monotonic()
            self.iterations, self.seconds = self.iterations + 1, self.seconds + now - started
            psnr = -10 * np.log10(max(loss, 1e-12))
            if psnr >= self._goal and view.stamp_ns in self._arrived:
                self.reached.setdefault(view.stamp_ns, now - self._arrived[view.stamp_ns])
