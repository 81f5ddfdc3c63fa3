"""A small vocabulary of ORB descriptors in DBoW2's text format, for where ORB-SLAM3's own 139 MB one is not at hand."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from sf_interfaces.types import UInt8

BRANCHES, LEVELS, ROUNDS = 9, 3, 6
Bits = np.ndarray  # [N, 256] uint8 in {0, 1}


def train(images: Sequence[UInt8], path: Path, seed: int = 0) -> int:
    """Cluster the descriptors of images into a tree of ``BRANCHES`` ** ``LEVELS`` words; returns their number."""
    orb = cv2.ORB.create(1000)
    per_image = [d for i in images if (d := orb.detectAndCompute(i, None)[1]) is not None]
    bits = np.unpackbits(np.concatenate(per_image), axis=1)
    owner = np.repeat(np.arange(len(per_image)), [len(d) for d in per_image])
    rng = np.random.default_rng(seed)
    lines: list[str] = []  # node n is line n; the root, 0, has none

    def grow(parent: int, members: np.ndarray, level: int) -> int:
        words = 0
        centres, label = _clusters(bits[members], rng)
        for k, centre in enumerate(centres):
            mine = members[label == k]
            leaf = level == LEVELS or len(mine) < BRANCHES
            weight = np.log(len(per_image) / max(1, len(np.unique(owner[mine])))) if leaf else 0.0
            values = " ".join(map(str, np.packbits(centre)))
            lines.append(f"{parent} {int(leaf)} {values} {weight:.6f}")
            words += 1 if leaf else grow(len(lines), mine, level + 1)
        return words

    count = grow(0, np.arange(len(bits)), 1)
    path.write_text("\n".join([f"{BRANCHES} {LEVELS} 0 0", *lines]) + "\n")
    return count


def _clusters(bits: Bits, rng: np.random.Generator) -> tuple[Bits, np.ndarray]:
    """Centres [K, 256] by majority and the label [N] of each descriptor, K-means in Hamming distance."""
    centres = bits[rng.choice(len(bits), min(BRANCHES, len(bits)), replace=False)]
    signed = bits.astype(np.float32) * 2 - 1
    label = np.zeros(len(bits), int)
    for _ in range(ROUNDS):
        label = (signed @ (centres.astype(np.float32) * 2 - 1).T).argmax(axis=1)
        groups = [bits[label == k] for k in range(len(centres))]
        centres = np.array([np.uint8(g.mean(0) > 0.5) if len(g) else c for g, c in zip(groups, centres, strict=True)])
    return centres, label
