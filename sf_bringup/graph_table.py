"""``python -m sf_bringup.graph_table``: nodes, topics and types of the running graph, checked against the table."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import dataclass

import rclpy
from rclpy.node import Node

from sf_interfaces import topics

_PATIENCE_S = 20.0


@dataclass(frozen=True, slots=True)
class GraphTable:
    """What was found: nodes, topic -> type, and every departure from ``sf_interfaces/topics.py`` in words."""

    nodes: tuple[str, ...]
    topics: dict[str, str]
    departures: tuple[str, ...]


def departures(found: dict[str, str], nodes: tuple[str, ...]) -> list[str]:
    """Topics below /sf of another type than the table says, or that the table does not know."""
    expected = {t.name: t.type for t in topics.TABLE}
    for node in nodes:
        short = node.rsplit("/", 1)[-1]
        for topic in (topics.consumed(short), topics.stream(short)):
            expected[topic.name] = topic.type
    expected[topics.stream("player").name] = topics.stream("player").type
    out = []
    for name, kind in sorted(found.items()):
        if name in expected and expected[name] != kind:
            out.append(f"{name} has type {kind}, the table says {expected[name]}")
        elif name.startswith("/sf/") and name not in expected and not name.endswith("/transition_event"):
            out.append(f"{name} ({kind}) is not in the table")
    return out


def look(seconds: float = 3.0) -> GraphTable:
    """Listen for at least ``seconds`` and list the graph (rclpy has to be initialised).

    Names of nodes are discovered later than their topics: as long as a topic seems to have no place in the
    table, it goes on listening, at most ``_PATIENCE_S``.
    """
    node = Node("sf_graph_table")
    begin = time.monotonic()
    table = _list(node)
    while (passed := time.monotonic() - begin) < seconds or (table.departures and passed < _PATIENCE_S):
        rclpy.spin_once(node, timeout_sec=0.1)
        table = _list(node)
    node.destroy_node()
    return table


def _list(node: Node) -> GraphTable:
    names = sorted(f"{space.rstrip('/')}/{name}" for name, space in node.get_node_names_and_namespaces())
    nodes = tuple(n for n in names if n != "/sf_graph_table")
    found = {name: kinds[0] for name, kinds in node.get_topic_names_and_types()}
    return GraphTable(nodes, found, tuple(departures(found, nodes)))


def main(args: list[str] | None = None) -> int:
    """Print the table; exit code 2 if the graph departs from it."""
    parser = argparse.ArgumentParser(prog="graph_table", description=__doc__)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--seconds", type=float, default=3.0)
    given = parser.parse_args(args)
    rclpy.init()
    try:
        table = look(given.seconds)
    finally:
        rclpy.try_shutdown()
    if given.json:
        print(json.dumps({"nodes": table.nodes, "topics": table.topics, "departures": table.departures}))
    else:
        print("\n".join([*table.nodes, *(f"{n:44} {k}" for n, k in sorted(table.topics.items())), *table.departures]))
    return 2 if table.departures else 0


if __name__ == "__main__":
    sys.exit(main())
