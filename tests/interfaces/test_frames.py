"""The tree of frames composes, inverts, interpolates, and never guesses."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np

from sf_interfaces.geometry import se3
from sf_interfaces.ros.frames import FrameTree

A = se3.exp(np.array([1.0, 2, 3, 0.1, 0.2, 0.3]))
B = se3.exp(np.array([-1.0, 0, 1, 0.4, -0.2, 0.1]))


def test_static_chains_compose_through_the_common_ancestor() -> None:
    tree = FrameTree()
    tree.add("base_link", "camera", A)
    tree.add("/base_link", "/lidar", B)
    found = tree.lookup("camera", "lidar")
    assert found is not None and np.allclose(found, se3.inverse(A) @ B)
    assert np.allclose(tree.lookup("camera", "camera"), np.eye(4))
    assert tree.lookup("camera", "imu") is None


def test_moving_links_are_interpolated_but_never_extrapolated() -> None:
    tree = FrameTree()
    tree.add("odom", "base_link", np.eye(4), 100, static=False)
    tree.add("odom", "base_link", se3.exp(np.array([2.0, 0, 0, 0, 0, 0])), 200, static=False)
    tree.add("base_link", "camera", A)
    found = tree.lookup("odom", "camera", 150)
    assert found is not None and np.allclose(found, se3.exp(np.array([1.0, 0, 0, 0, 0, 0])) @ A)
    assert tree.lookup("odom", "camera", 201) is None
    assert tree.lookup("odom", "camera", 99) is None
    assert tree.lookup("odom", "camera", static_only=True) is None


def test_the_root_stops_below_the_map_and_cycles_end() -> None:
    tree = FrameTree()
    tree.add("map", "odom", A, 1, static=False)
    tree.add("odom", "base_link", B)
    tree.add("base_link", "camera", A)
    name, T = tree.root("camera", below="map")
    assert name == "odom" and np.allclose(T, B @ A)
    loop = FrameTree()
    loop.add("a", "b", A)
    loop.add("b", "a", B)
    assert loop.lookup("a", "c") is None
