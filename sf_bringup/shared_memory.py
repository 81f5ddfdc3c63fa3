"""Shared memory of Fast DDS: what processes that were killed have left in /dev/shm is removed."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import fcntl
import os
from pathlib import Path

_FOLDER = Path("/dev/shm")
_PREFIXES = ("fastrtps_", "fastdds_")
_LOCK = "_el"  # each segment and port has such a file; its owner holds a lock on it, which ends with the process


def _held(lock: Path) -> bool:
    """Whether a living process owns the segment."""
    try:
        file = os.open(lock, os.O_RDWR)
    except FileNotFoundError:
        return True  # its owner is just removing it
    except PermissionError:
        return True  # another user's
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(file)
    return False


def orphaned_segments(folder: Path = _FOLDER) -> list[Path]:
    """Segments whose owner is dead (ports are left alone: Fast DDS takes them over)."""
    if not folder.is_dir():
        return []
    locks = [p for p in sorted(folder.iterdir()) if p.name.startswith(_PREFIXES) and p.name.endswith(_LOCK)]
    segments = [lock.with_name(lock.name.removesuffix(_LOCK)) for lock in locks if "_port" not in lock.name]
    return [s for s in segments if s.is_file() and not _held(s.with_name(s.name + _LOCK))]


def sweep_shared_memory(folder: Path = _FOLDER) -> int:
    """Remove the segments of dead processes; returns their number."""
    orphans = orphaned_segments(folder)
    for segment in orphans:
        segment.unlink(missing_ok=True)
        segment.with_name(segment.name + _LOCK).unlink(missing_ok=True)
    return len(orphans)


if __name__ == "__main__":
    print(f"removed {sweep_shared_memory()} segments of dead processes")
