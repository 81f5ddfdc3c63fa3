"""Every input set and every goal against a reviewed table, and the rules any plan obeys."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path

import pytest

from sf_bringup.planner import GOALS, INPUT, plan
from sf_depth import block as depth
from sf_flexion import block as flexion
from sf_interfaces.blocks import BlockSpec, Quantity
from sf_interfaces.errors import PlanError
from sf_recon import block as recon
from sf_tracking import block as tracking

Q = Quantity
BLOCKS = (*depth.SPECS, flexion.SPEC, recon.SPEC, tracking.SPEC)
GOLDEN = Path(__file__).with_name("golden_lines.txt")


def quantities(rgb: str, dense: str, pose: str, intrinsics: str) -> frozenset[Quantity]:
    columns = (
        (rgb == "x", Q.IMAGE),
        (dense == "x", Q.DEPTH),
        (dense == "sp", Q.SPARSE_DEPTH),
        (pose == "x", Q.GIVEN_POSE),
        (intrinsics == "x", Q.INTRINSICS),
    )
    return frozenset(q for present, q in columns if present)


INPUTS = list(product("x.", ("x", "sp", "."), "x.", "x."))
CASES = [(*columns, goal) for columns in INPUTS for goal in GOALS]


def line(rgb: str, dense: str, pose: str, intrinsics: str, goal: str) -> str:
    try:
        return " -> ".join(plan(quantities(rgb, dense, pose, intrinsics), goal, BLOCKS).ids)
    except PlanError as error:
        return f"cannot: {error}"


def test_the_golden_table_has_every_case_once() -> None:
    rows = [tuple(row.split(None, 5)[:5]) for row in GOLDEN.read_text().splitlines()]
    assert rows == CASES


@pytest.mark.parametrize("row", GOLDEN.read_text().splitlines())
def test_line_is_the_golden_one(row: str) -> None:
    *columns, expected = row.split(None, 5)
    assert line(*columns) == expected


@pytest.mark.parametrize("rgb, dense, pose, intrinsics, goal", CASES)
def test_every_plan_is_sound(rgb: str, dense: str, pose: str, intrinsics: str, goal: str) -> None:
    given = quantities(rgb, dense, pose, intrinsics)
    try:
        made = plan(given, goal, BLOCKS)
    except PlanError as error:
        assert str(error).count("\n") == 0
        return
    have = set(made.available)
    for step in made.steps:
        assert step.spec.requires <= have, "a block comes after all it requires"
        assert not step.spec.provides & made.available, "a given quantity is never computed again"
        assert set(step.sources) >= step.spec.requires
        for quantity, source in step.sources.items():
            assert (source == INPUT) == (quantity in made.available)
        have |= step.spec.provides
    assert len(set(made.ids)) == len(made.ids)


def test_every_edge_has_its_reason() -> None:
    made = plan({Q.IMAGE, Q.INTRINSICS, Q.SPARSE_DEPTH}, "recon", BLOCKS)
    text = made.explain()
    assert "tracking, because POSE is missing and recon needs it" in text
    assert "recon, because the goal recon asks for SURFACE" in text
    complete = made.step("depth:complete")
    assert complete is not None and complete.sources[Q.POSE] == "tracking"


def test_a_tracked_pose_never_fires_posed_depth() -> None:
    assert "depth:posed" not in plan({Q.IMAGE, Q.INTRINSICS}, "recon", BLOCKS).ids


def test_multi_view_depth_serves_only_its_own_goal() -> None:
    with pytest.raises(PlanError, match="SPARSE_DEPTH is missing"):
        plan({Q.IMAGE, Q.INTRINSICS}, "completion", BLOCKS)


def test_the_user_and_the_cost_choose_between_blocks() -> None:
    rival = replace(tracking.SPEC, name="odometry", cost=2.0)
    given = {Q.IMAGE, Q.INTRINSICS, Q.DEPTH}
    assert plan(given, "tracking", (*BLOCKS, rival)).ids == ("tracking",)
    assert plan(given, "tracking", (*BLOCKS, replace(rival, cost=0.5))).ids == ("odometry",)
    assert plan(given, "tracking", (*BLOCKS, rival), use=["odometry"]).ids == ("odometry",)
    with pytest.raises(PlanError, match="no such block"):
        plan(given, "tracking", BLOCKS, use=["odometri"])


def test_a_cycle_of_blocks_ends_in_a_sentence() -> None:
    a = BlockSpec("a", "", frozenset({Q.DEPTH}), frozenset({Q.POSE}))
    b = BlockSpec("b", "", frozenset({Q.POSE}), frozenset({Q.DEPTH}))
    with pytest.raises(PlanError, match="cannot reach goal tracking"):
        plan(frozenset(), "tracking", (a, b))


def test_a_line_that_cannot_run_says_which_block_is_missing() -> None:
    planned_only = tuple(replace(b, executable=None) if b.id == "depth:slam" else b for b in BLOCKS)
    made = plan({Q.IMAGE, Q.INTRINSICS}, "recon", planned_only)
    with pytest.raises(PlanError, match="needs 'depth:slam'"):
        made.check_runnable()


def test_unknown_goals_are_refused() -> None:
    with pytest.raises(PlanError, match="choose one of"):
        plan({Q.IMAGE}, "mapping", BLOCKS)
