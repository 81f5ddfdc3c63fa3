"""What a block needs and gives, as data: from it the planner builds the production line (Sec. III-E)."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum
from importlib.metadata import entry_points

from sf_interfaces.errors import ConfigError

ENTRY_POINT_GROUP = "scenefactory.blocks"


class Quantity(Enum):
    """A kind of data that a line is given or has to complete."""

    IMAGE = "image"
    INTRINSICS = "intrinsics"
    DEPTH = "depth"
    SPARSE_DEPTH = "sparse_depth"
    GIVEN_POSE = "given_pose"  # kept apart from POSE, so that a tracked pose never fires depth:posed
    POSE = "pose"
    LANDMARKS = "landmarks"
    SURFACE = "surface"


@dataclass(frozen=True, slots=True)
class BlockSpec:
    """One mode of one block.

    Args:
        name: the block, e.g. ``depth``.
        mode: what it does there, e.g. ``complete`` (empty for blocks with a single mode).
        provides: quantities it completes.
        requires: quantities it cannot work without.
        optional: quantities it uses when they are present.
        cost: ties between blocks go to the lower cost.
        executable: module run as ``python -m <executable>``; None where this version plans the mode
            but does not run it yet.
        sequence: False if it needs only a set of images, without order in time.
        goals: goals it serves; empty for all.
    """

    name: str
    mode: str
    provides: frozenset[Quantity]
    requires: frozenset[Quantity]
    optional: frozenset[Quantity] = frozenset()
    cost: float = 1.0
    executable: str | None = None
    sequence: bool = True
    goals: frozenset[str] = frozenset()

    @property
    def id(self) -> str:
        """``name`` or ``name:mode``, unique among all blocks."""
        return f"{self.name}:{self.mode}" if self.mode else self.name


def load_blocks() -> tuple[BlockSpec, ...]:
    """All installed block modes, ours and third parties', sorted by id.

    An entry point of group ``scenefactory.blocks`` names a BlockSpec or an iterable of them.

    Raises:
        ConfigError: two blocks claim the same id.
    """
    specs: dict[str, BlockSpec] = {}
    for point in sorted(entry_points(group=ENTRY_POINT_GROUP), key=lambda p: (p.name, p.value)):
        loaded: BlockSpec | Iterable[BlockSpec] = point.load()
        for spec in (loaded,) if isinstance(loaded, BlockSpec) else tuple(loaded):
            if spec.id in specs and specs[spec.id] != spec:
                raise ConfigError(f"two installed packages provide block '{spec.id}'; uninstall one of them")
            specs[spec.id] = spec
    return tuple(specs[key] for key in sorted(specs))
