"""``sf doctor RECORDING``: are the rows of its colour images read one after the other?

Nothing in a recording says so, but a tracker notices: with the right readout its patches agree best. It follows two
parts of the recording with several, and both have to say the same.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Sequence
from itertools import islice, product
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from sf_bringup import inputs, preflight
from sf_bringup.doctor import Check
from sf_bringup.pipeline import joined, make_part
from sf_bringup.planner import plan
from sf_bringup.progress import Progress
from sf_interfaces.blocks import Quantity, load_blocks
from sf_interfaces.config import ConfigFile
from sf_interfaces.io import datasets
from sf_interfaces.io.bag import is_bag
from sf_interfaces.io.datasets import ReadOptions
from sf_interfaces.types import Float64, Frame

READOUTS = (0.0, 0.01, 0.02, 0.03)  # s
PART = 80  # frames
_SHUTTER = "shutter"
_FEWEST = 20  # tracked frames of a part
_GAIN = 0.15  # of the mean logarithm of what patches err too much, that a readout has to bring in every part
_APART = 0.6  # relative difference of what the parts say, up to which they agree
_SAID = 0.5  # relative difference of what the recording says, up to which it is right


def shutter_checks(recording: Path) -> list[Check]:
    """What tracking tells about the shutter; nothing where there are no colour images with calibration and order.

    Raises:
        SceneFactoryError: the recording cannot be read.
    """
    if not is_bag(recording) and datasets.recognise(recording).goal != "auto":
        return []
    with TemporaryDirectory() as scratch:
        bag = inputs.resolve((recording,), Path(scratch), ReadOptions(limit=2 * PART)).bag
        given = preflight.inspect(bag, {})
        if not {"rgb", "camera_info"} <= given.mapping.roles.keys():
            return []
        available = given.mapping.available & {Quantity.IMAGE, Quantity.INTRINSICS, Quantity.DEPTH}
        made = plan(frozenset(available), "tracking", load_blocks())
        frames = list(islice(joined(given, made, ConfigFile({})), 2 * PART))
        said = inputs.readout_of(bag)
    middle, costs = len(frames) // 2, []
    with Progress("following", "passes") as progress:
        for part, readout in product((frames[:middle], frames[middle:]), READOUTS):
            costs.append(_cost(part, readout))
            progress.update(len(costs), 2 * len(READOUTS))
    return [judge_shutter(np.array(costs).reshape(2, len(READOUTS)), said)]


def _cost(frames: Sequence[Frame], readout: float) -> float:
    """Mean logarithm of what the squared errors of patches exceed their variance by; NaN where few are tracked."""
    tracker = make_part("tracking", ConfigFile({"tracking": {"readout_s": readout}}))
    updates = [tracker.track(frame) for frame in frames]
    found = [float(np.log(update.excess)) for update in updates if update.edges]
    return float(np.mean(found)) if len(found) >= _FEWEST else float("nan")


def judge_shutter(costs: Float64, said: float) -> Check:
    """What the costs [parts, READOUTS] tell.

    Args:
        said: the readout by the recording, s; 0 where it says nothing.
    """
    if not np.isfinite(costs).all():
        return Check(
            _SHUTTER, True, "cannot tell: too few frames are tracked", "record some seconds of a lively camera"
        )
    gains, best = costs[:, 0] - costs.min(axis=1), np.array([_minimum(cost) for cost in costs])
    found = float(best.mean())
    seen = f"parts of the recording say {' and '.join(f'{1e3 * b:.0f}' for b in best)} ms"
    if (gains < _GAIN).any():
        none = "rows are read at once, or the camera moves too evenly to tell"
        return Check(_SHUTTER, True, f"nothing shows that it rolls: {none}")
    if np.ptp(best) > _APART * found:
        return Check(_SHUTTER, True, f"cannot tell: it seems to roll, but {seen}", "record it while the camera shakes")
    detail = f"rows are read one after the other, within about {1e3 * found:.0f} ms ({seen}); undone, "
    detail += f"patches err {np.exp(0.5 * gains.mean()):.1f} times less"
    if abs(said - found) < _SAID * found:
        return Check(_SHUTTER, True, f"{detail}; the recording says {1e3 * said:.0f} ms")
    return Check(_SHUTTER, False, detail, f"--set tracking.readout_s={found:.3f}")


def _minimum(cost: Float64) -> float:
    """Where the parabola through costs of READOUTS is least, within what was tried."""
    square, line, _ = np.polyfit(READOUTS, cost, 2)
    at = -line / (2 * square) if square > 0 else READOUTS[int(cost.argmin())]
    return float(np.clip(at, READOUTS[0], READOUTS[-1]))
