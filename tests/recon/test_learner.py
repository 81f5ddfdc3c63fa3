"""Learning while others use the map."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import threading
import time
from pathlib import Path

from sf_recon.config import ReconConfig
from sf_recon.core.learner import FairLock, Learner
from sf_recon.core.reconstruction import Reconstruction
from tests.recon.scene import CAMERA, view


def test_lock_is_given_in_the_order_of_asking() -> None:
    lock, served = FairLock(), []

    def ask(name: int) -> None:
        with lock, lock:
            served.append(name)

    threads = []
    with lock:
        for name in range(5):
            threads.append(threading.Thread(target=ask, args=(name,)))
            threads[-1].start()
            while len(lock._waiting) <= name:
                time.sleep(0.001)
    for thread in threads:
        thread.join(5)
    assert served == [0, 1, 2, 3, 4]


def test_a_greedy_thread_starves_nobody() -> None:
    lock, stop, turns = FairLock(), threading.Event(), [0, 0]

    def work(me: int) -> None:
        while not stop.is_set():
            with lock:
                time.sleep(0.001)
                turns[me] += 1

    threads = [threading.Thread(target=work, args=(i,)) for i in (0, 1)]
    for thread in threads:
        thread.start()
    time.sleep(0.5)
    stop.set()
    for thread in threads:
        thread.join(5)
    assert min(turns) > 0.4 * max(turns) > 0


def test_learning_drawing_and_placing_share_the_map(tmp_path: Path) -> None:
    room = Reconstruction(ReconConfig(pixels=256, live_turns=15, psnr_goal=20.0, detail=0))
    lock = FairLock()
    learner = Learner(room, lock)
    for i in (0, 2, 4):
        with lock:
            room.place(view(i))
        learner.arrived(i)
        with lock:
            room.render(CAMERA, view(i).T_map_camera)
    deadline = time.monotonic() + 60
    while len(learner.reached) < 3 or min(v.turns for v in room.views) < 15:
        assert time.monotonic() < deadline
        time.sleep(0.05)
    time.sleep(0.2)
    learner.stop()
    assert [v.turns for v in room.views] == [15] * 3  # and then it rests
    (tmp_path / "timing.json").write_text('{"other": 1}')
    learner.write_timing(tmp_path / "timing.json")
    written = json.loads((tmp_path / "timing.json").read_text())
    assert written["other"] == 1 and written["recon"]["keyframes_at_goal"] == 3
    assert written["recon"]["iterations"] == 45 and written["recon"]["seconds_to_goal_max"] > 0
