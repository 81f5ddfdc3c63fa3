"""Which blocks make a line from what is given to what is wanted, and why (Sec. III-E). Pure."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from sf_interfaces.blocks import BlockSpec, Quantity
from sf_interfaces.errors import PlanError

Q = Quantity
INPUT = "input"

# What each goal asks for; 'completion' and 'mvd' both ask for depth and differ in the blocks that may serve them.
TARGETS: Mapping[str, Quantity] = {
    "tracking": Q.POSE,
    "slam": Q.SURFACE,
    "recon": Q.SURFACE,
    "mvd": Q.DEPTH,
    "completion": Q.DEPTH,
}
GOALS = ("auto", *TARGETS)
# The paper checks image, intrinsics, pose and depth in this order; what is missing first is completed first.
_ORDER = (Q.IMAGE, Q.INTRINSICS, Q.GIVEN_POSE, Q.POSE, Q.LANDMARKS, Q.SPARSE_DEPTH, Q.DEPTH, Q.SURFACE)
# Missing sensor data is named itself, not what the block that could replace it lacks in turn.
_SENSED = frozenset({Q.IMAGE, Q.INTRINSICS})
_RICHEST_FIRST = ("recon", "tracking", "completion", "mvd")

_REMEDY: Mapping[Quantity, str] = {
    Q.IMAGE: "add a colour image, or depth with camera_info for flexion",
    Q.INTRINSICS: "add camera_info or use --calibration",
    Q.DEPTH: "add depth images or a LiDAR",
    Q.SPARSE_DEPTH: "add a LiDAR with its extrinsic on /tf_static",
    Q.GIVEN_POSE: "add poses with --poses",
    Q.POSE: "add poses with --poses, or images with camera_info for tracking",
    Q.LANDMARKS: "let the tracking block run",
    Q.SURFACE: "install a block that provides a surface",
}


@dataclass(frozen=True, slots=True)
class Step:
    """One block of the line: why it is there, and who gives it what it uses (block id or ``input``)."""

    spec: BlockSpec
    reason: str
    sources: Mapping[Quantity, str]


@dataclass(frozen=True, slots=True)
class Plan:
    """A production line in the order in which data flows through it."""

    goal: str
    available: frozenset[Quantity]
    steps: tuple[Step, ...]

    @property
    def ids(self) -> tuple[str, ...]:
        """Block ids in order."""
        return tuple(step.spec.id for step in self.steps)

    def step(self, block_id: str) -> Step | None:
        """The step of one block, or None where the line does not have it."""
        return next((step for step in self.steps if step.spec.id == block_id), None)

    def explain(self) -> str:
        """The line and the reason of every block and edge, one sentence a line."""
        given = ", ".join(sorted(q.value for q in self.available if q is not Q.POSE)) or "nothing"
        lines = [f"goal {self.goal}, given {given}: {' -> '.join(self.ids) or 'nothing to do'}"]
        for step in self.steps:
            lines.append(f"  {step.reason}")
            lines += [f"    {quantity.value} from {source}" for quantity, source in step.sources.items()]
        return "\n".join(lines)

    def check_runnable(self) -> None:
        """Refuse a line that this version can plan but not run.

        Raises:
            PlanError: names the block that is missing.
        """
        for step in self.steps:
            if step.spec.executable is None:
                raise PlanError(
                    f"the line needs '{step.spec.id}' ({step.reason}), which this version plans but cannot run; "
                    f"{_REMEDY[min(step.spec.provides, key=lambda q: q.value)]}"
                )


class _Cannot(Exception):
    """A chain that ends at a quantity nobody provides; carries it for the message."""

    def __init__(self, quantity: Quantity, path: Sequence[str]) -> None:
        super().__init__(quantity.value)
        self.quantity, self.path = quantity, tuple(path)


@dataclass(frozen=True, slots=True)
class _Search:
    """Backward chaining: to have a quantity, take it from the input or call the cheapest block that gives it."""

    goal: str
    given: frozenset[Quantity]
    blocks: Sequence[BlockSpec]
    use: frozenset[str]

    def candidates(self, quantity: Quantity) -> list[BlockSpec]:
        """Blocks that may provide it under this goal: those the user names first, then by cost."""
        fitting = [
            b
            for b in self.blocks
            if quantity in b.provides
            and (not b.goals or self.goal in b.goals)
            and not b.provides & self.given  # a given quantity is never computed again
        ]
        return sorted(fitting, key=lambda b: (b.id not in self.use, b.cost, b.id))

    def need(self, quantity: Quantity, wanted_by: str, chosen: dict[str, Step], path: tuple[str, ...]) -> str:
        """Make sure ``quantity`` is provided and return its source; adds steps to ``chosen`` before their users."""
        if quantity in self.given:
            return INPUT
        for step in chosen.values():
            if quantity in step.spec.provides:
                return step.spec.id
        failure: _Cannot | None = None
        for block in self.candidates(quantity):
            if block.id in path:
                continue
            attempt = dict(chosen)
            try:
                self.add(block, quantity, wanted_by, attempt, path)
            except _Cannot as deeper:
                failure = failure or deeper  # the preferred block gives the advice
                continue
            chosen.clear()
            chosen.update(attempt)
            return block.id
        if failure is None or quantity in _SENSED:
            failure = _Cannot(quantity, (*path, wanted_by))
        raise failure

    def add(
        self,
        block: BlockSpec,
        quantity: Quantity,
        wanted_by: str,
        chosen: dict[str, Step],
        path: tuple[str, ...],
    ) -> None:
        """Choose ``block``: first everything it requires, then what it can use that is there anyway."""
        here = (*path, block.id)
        sources = {
            required: self.need(required, block.id, chosen, here)
            for required in sorted(block.requires, key=_ORDER.index)
        }
        for extra in sorted(block.optional, key=_ORDER.index):
            provider = next((s.spec.id for s in chosen.values() if extra in s.spec.provides), None)
            if extra in self.given or provider:
                sources[extra] = INPUT if extra in self.given else str(provider)
        reason = f"{block.id}, because {quantity.name} is missing and {wanted_by} needs it"
        if wanted_by.startswith("the goal"):
            reason = f"{block.id}, because {wanted_by} asks for {quantity.name}"
        chosen[block.id] = Step(block, reason, sources)


def _given(available: Iterable[Quantity]) -> frozenset[Quantity]:
    """The available quantities; a given pose also is a pose."""
    given = set(available)
    if Q.GIVEN_POSE in given:
        given.add(Q.POSE)
    return frozenset(given)


def plan(available: Iterable[Quantity], goal: str, blocks: Sequence[BlockSpec], use: Iterable[str] = ()) -> Plan:
    """The production line for a goal.

    Args:
        available: what the input carries.
        goal: one of GOALS; ``auto`` takes the richest product that can be reached and run.
        blocks: the installed block modes.
        use: block ids that are preferred whatever their cost.

    Raises:
        PlanError: unknown goal or no line; the sentence says what to add.
    """
    preferred = frozenset(use)
    for name in preferred - {b.id for b in blocks}:
        raise PlanError(f"--use {name}: no such block; installed are {', '.join(b.id for b in blocks)}")
    if goal == "auto":
        return _richest(available, blocks, preferred)
    if goal not in TARGETS:
        raise PlanError(f"unknown goal '{goal}'; choose one of {', '.join(GOALS)}")
    given = _given(available)
    target = TARGETS[goal]
    if goal == "slam" and Q.GIVEN_POSE in given:
        raise PlanError("goal slam, but poses are given: use --goal recon, or leave the poses out")
    chosen: dict[str, Step] = {}
    try:
        _Search(goal, given, blocks, preferred).need(target, f"the goal {goal}", chosen, ())
    except _Cannot as failure:
        chain = f" for {failure.path[-1]}" if failure.path else ""
        raise PlanError(
            f"cannot reach goal {goal}: {failure.quantity.name} is missing{chain}; {_REMEDY[failure.quantity]}"
        ) from None
    if not chosen:
        raise PlanError(f"goal {goal} has nothing to compute: {target.name} is already given")
    return Plan(goal, given, tuple(chosen.values()))


def _richest(available: Iterable[Quantity], blocks: Sequence[BlockSpec], use: frozenset[str]) -> Plan:
    """The first goal, richest first, whose line runs; else the first that can at least be planned."""
    given = frozenset(available)
    planned: list[Plan] = []
    reasons: list[str] = []
    for goal in _RICHEST_FIRST:
        try:
            candidate = plan(given, goal, blocks, use)
        except PlanError as error:
            reasons.append(str(error))
            continue
        if all(step.spec.executable for step in candidate.steps):
            return candidate
        planned.append(candidate)
    if planned:
        return planned[0]
    raise PlanError(reasons[0])
