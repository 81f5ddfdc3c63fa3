"""Paths that come over the wire: they stay inside the folder that was opened for them."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

from sf_interfaces.errors import ConfigError


def inside(root: Path | None, given: str) -> Path:
    """``given`` as a path inside ``root``: relative to it, or absolute and below it. Links are followed first.

    Raises:
        ConfigError: no root is open, or the path leads out of it.
    """
    if root is None:
        raise ConfigError("this node has no output folder; start it with the parameter 'out'")
    home = root.resolve()
    if "\0" in given:
        raise ConfigError("the path holds a zero byte; give a plain folder name")
    path = (home / given).resolve()
    if not path.is_relative_to(home):
        raise ConfigError(f"the path leads out of {home}; give a folder below it, such as 'map'")
    return path
