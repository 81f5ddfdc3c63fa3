"""Definitions of message types: those of Jazzy, ours, and whatever is installed beside them."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
import sys
from functools import lru_cache
from pathlib import Path

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore


def _definition_file(name: str) -> Path | None:
    """The .msg file of a type: in this checkout for our own, else in an installed share folder."""
    package, short = name.split("/")[0], name.split("/")[-1]
    prefixes = [Path(p) for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
    candidates = [prefix / "share" / package / "msg" / f"{short}.msg" for prefix in (*prefixes, Path(sys.prefix))]
    own = Path(__file__).resolve().parents[1]
    if package == own.name:
        candidates.insert(0, own / "msg" / f"{short}.msg")
    return next((path for path in candidates if path.is_file()), None)


def _add(store: Typestore, name: str) -> bool:
    """Register a type and the types in it; whether all of them were found."""
    if name in store.types:
        return True
    path = _definition_file(name)
    if path is None:
        return False
    types = get_types_from_msg(path.read_text(), name)
    for _, kind in types[name][1]:
        while kind[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            kind = kind[1][0]
        if kind[0] == Nodetype.NAME and not _add(store, str(kind[1])):
            return False
    store.register(types)
    return True


@lru_cache(maxsize=1)
def typestore() -> Typestore:
    """The message types known here; :func:`definition` adds to them on demand."""
    return get_typestore(Stores.ROS2_JAZZY)


@lru_cache(maxsize=256)
def definition(name: str) -> str | None:
    """The full ros2msg definition of a type, as mcap and Foxglove expect it, or None when unknown."""
    store = typestore()
    try:
        if not _add(store, name):
            return None
        return str(store.generate_msgdef(name, ros_version=2)[0])
    except TypesysError:
        return None
