"""The pose graph on loops whose answer is known."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from sf_interfaces.geometry import se3
from sf_tracking.core import sim3
from sf_tracking.core.pose_graph import Edges, optimise

SIGMA = np.array([0.02, 0.02, 0.02, 0.003, 0.003, 0.003, 0.01])


def circle(count: int, radius: float = 10.0) -> np.ndarray:
    """Camera poses once around a circle, looking ahead; the last is the first again."""
    poses = []
    for a in np.linspace(0, 2 * np.pi, count):
        T = se3.exp(np.array([0, 0, 0, 0, a, 0]))
        T[:3, 3] = radius * np.array([1 - np.cos(a), 0, np.sin(a)])
        poses.append(T)
    return np.array(poses)


def chained(steps: np.ndarray) -> np.ndarray:
    """S_0 = 1, S_k+1 = S_k step_k."""
    S = [np.eye(4)]
    for step in steps:
        S.append(S[-1] @ step)
    return np.array(S)


def graph(steps: np.ndarray, loops: list[tuple[int, int, np.ndarray]]) -> Edges:
    n = len(steps)
    i, j = np.r_[np.arange(n), [a for a, _, _ in loops]], np.r_[np.arange(n) + 1, [b for _, b, _ in loops]]
    Z = np.concatenate([steps, np.array([z for _, _, z in loops]).reshape(-1, 4, 4)])
    closing = np.arange(len(Z)) >= n
    return Edges(i, j, Z, np.where(closing[:, None], SIGMA / 4, SIGMA), closing)


def drifted(truth: np.ndarray, scale: float = 1.0) -> np.ndarray:
    """The true steps with a constant error of each: 0.1 degrees, 1 % in length, and a drift of scale."""
    steps = se3.inverse(truth[:-1]) @ truth[1:]
    wrong = se3.exp(np.array([0, 0.005, 0, 0.0004, 0.0017, 0])) @ steps
    wrong[:, :3, 3] *= 1.01
    return sim3.similarity(wrong, scale)


def errors(S: np.ndarray, truth: np.ndarray) -> np.ndarray:
    return np.linalg.norm(S[:, :3, 3] - truth[:, :3, 3], axis=1)


def test_the_derivatives_are_those_of_the_residuals() -> None:
    rng = np.random.default_rng(0)
    S = sim3.similarity(se3.exp(rng.normal(0, 0.5, (2, 6))), np.array([1.3, 0.7]))
    Z = sim3.similarity(se3.exp(rng.normal(0, 0.5, (1, 6))), np.array([0.8]))
    edges = Edges(np.array([0]), np.array([1]), Z, np.ones((1, 7)), np.array([True]))
    _, *J = edges.residuals(S)
    for k in range(2):
        for axis in range(7):
            xi = np.zeros((2, 7))
            xi[k, axis] = 1e-6
            change = (edges.residuals(sim3.moved(S, xi))[0] - edges.residuals(sim3.moved(S, -xi))[0]) / 2e-6
            np.testing.assert_allclose(J[k][0, :, axis], change[0], atol=1e-6)
    np.testing.assert_allclose(sim3.inverse(S) @ S, np.broadcast_to(np.eye(4), (2, 4, 4)), atol=1e-12)
    np.testing.assert_allclose(sim3.scale_of(S), [1.3, 0.7])


def test_a_circle_with_drift_closes() -> None:
    truth = circle(60)
    steps = drifted(truth)
    start = chained(steps)
    solved, _ = optimise(start, graph(steps, [(0, 59, np.eye(4))]), with_scale=False)
    assert errors(start, truth)[-1] > 0.5
    assert errors(solved, truth)[-1] < 0.01
    assert errors(solved, truth).max() < 0.35 * errors(start, truth).max()
    np.testing.assert_allclose(sim3.scale_of(solved), 1.0, atol=1e-9)


def test_a_drift_of_scale_is_taken_back_along_the_loop() -> None:
    truth = circle(60)
    steps = drifted(truth, 0.99)  # the unit shrinks by 45 % over the loop
    start = chained(steps)
    solved, _ = optimise(start, graph(steps, [(0, 59, sim3.similarity(np.eye(4), 1.0))]), with_scale=True)
    assert sim3.scale_of(start)[-1] == pytest.approx(0.99**59)
    assert np.abs(sim3.scale_of(solved) - 1.0).max() < 0.15 and abs(sim3.scale_of(solved)[-1] - 1.0) < 0.01
    assert errors(solved, truth).max() < 0.35 * errors(start, truth).max()


def test_a_false_loop_among_true_ones_is_not_believed() -> None:
    truth = np.concatenate([circle(40), circle(40)[1:20]])
    steps = drifted(truth)
    true_loops = [(k, 39 + k, np.eye(4)) for k in (0, 4, 8, 12, 16)]
    clean, _ = optimise(chained(steps), graph(steps, true_loops), with_scale=False)
    false_loop = (5, 25, np.eye(4))
    solved, weight = optimise(chained(steps), graph(steps, [*true_loops, false_loop]), with_scale=False)
    assert weight[-1] < 0.01 and weight[-6:-1].min() > 0.5
    assert errors(solved, clean).max() < 0.02
