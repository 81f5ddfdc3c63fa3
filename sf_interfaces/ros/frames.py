"""The tree of coordinate frames that /tf and /tf_static describe. Pure: it never sees a message."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from bisect import bisect_left, bisect_right
from dataclasses import dataclass, field

import numpy as np

from sf_interfaces.geometry import se3
from sf_interfaces.types import Float64, check_pose

_HISTORY = 2000  # dynamic transforms kept per frame: 20 s at 100 Hz
_RESET_NS = 1_000_000_000  # a link whose time goes back further starts anew


@dataclass(slots=True)
class _Edge:
    """One link to the parent; static links have one pose and no stamps."""

    parent: str
    static: bool
    stamps_ns: list[int] = field(default_factory=list)
    poses: list[Float64] = field(default_factory=list)

    def at(self, stamp_ns: int | None) -> Float64 | None:
        """``T_parent_child`` at a stamp (None: the newest); interpolated, never extrapolated."""
        if self.static or stamp_ns is None:
            return self.poses[-1]
        after = bisect_left(self.stamps_ns, stamp_ns)
        if after == len(self.stamps_ns):
            return None
        if self.stamps_ns[after] == stamp_ns:
            return self.poses[after]
        if after == 0:
            return None
        t0, t1 = self.stamps_ns[after - 1], self.stamps_ns[after]
        alpha = (stamp_ns - t0) / (t1 - t0)
        return se3.interpolate(self.poses[after - 1], self.poses[after], alpha)


class FrameTree:
    """Transforms between named frames, composed through the tree.

    Static links never expire. A link that was static stays static.
    """

    def __init__(self) -> None:
        self._edges: dict[str, _Edge] = {}

    def add(self, parent: str, child: str, T: Float64, stamp_ns: int = 0, *, static: bool = True) -> None:
        """Add or renew ``T_parent_child``. Leading slashes of frame names are ignored (ROS 1 habit).

        Raises:
            FormatError: T is not a rigid motion.
        """
        parent, child = parent.lstrip("/"), child.lstrip("/")
        T = check_pose(T, f"transform from '{child}' to '{parent}'")
        edge = self._edges.get(child)
        if edge is not None and edge.static and not static:
            return
        if static:
            self._edges[child] = _Edge(parent, True, [stamp_ns], [T])
            return
        if edge is None or edge.parent != parent or stamp_ns < edge.stamps_ns[-1] - _RESET_NS:
            edge = self._edges[child] = _Edge(parent, False)
        where = bisect_right(edge.stamps_ns, stamp_ns)
        if where and edge.stamps_ns[where - 1] == stamp_ns:
            edge.poses[where - 1] = T
            return
        edge.stamps_ns.insert(where, stamp_ns)
        edge.poses.insert(where, T)
        if len(edge.stamps_ns) > _HISTORY:
            del edge.stamps_ns[0], edge.poses[0]

    def _chain(self, frame: str, stamp_ns: int | None, static_only: bool) -> list[tuple[str, Float64]]:
        """(ancestor, T_ancestor_frame) from the frame itself up to its root, or to the first gap."""
        T = np.eye(4)
        chain = [(frame, T)]
        while (edge := self._edges.get(frame)) is not None and (edge.static or not static_only):
            step = edge.at(stamp_ns)
            if step is None or any(name == edge.parent for name, _ in chain):
                break
            frame, T = edge.parent, step @ T
            chain.append((frame, T))
        return chain

    def lookup(
        self, target: str, source: str, stamp_ns: int | None = None, *, static_only: bool = False
    ) -> Float64 | None:
        """``T_target_source`` at a stamp, or None where the tree does not connect the two frames.

        Args:
            stamp_ns: instant for moving links, None for the newest.
            static_only: follow only links of /tf_static.
        """
        target, source = target.lstrip("/"), source.lstrip("/")
        up = dict(self._chain(target, stamp_ns, static_only))
        for name, T_name_source in self._chain(source, stamp_ns, static_only):
            if name in up:
                return se3.inverse(up[name]) @ T_name_source
        return None

    def root(self, frame: str, *, below: str = "") -> tuple[str, Float64]:
        """The topmost ancestor and ``T_root_frame`` (newest links); stops under the frame ``below``."""
        chain = self._chain(frame.lstrip("/"), None, False)
        names = [name for name, _ in chain]
        return chain[names.index(below) - 1] if below in names[1:] else chain[-1]
