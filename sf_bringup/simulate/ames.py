"""An Ames room: seen from one place it looks like an ordinary room, but it is not.

The projective map ``X -> e + (X - e) / (1 + a.(X - e))`` moves every point along its ray from the eye e: it leaves the
image taken there as it is, and keeps planes planes. Only other views tell the distorted room from the ordinary one.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace

import numpy as np

from sf_bringup.simulate.builder import Scene
from sf_interfaces.types import Float64

EYE = (-2.4, -0.3, 1.45)  # m; looks along +x
_LEAN = (0.0, -0.15, 0.0)  # 1 / m: one far corner is drawn near, the other pushed away
_LONGEST = 0.4  # m; edges are split down to it, since textures stay affine on a triangle


def ames(scene: Scene) -> Scene:
    """The scene as an Ames room around :data:`EYE`."""
    fine = _split(scene)
    eye, lean = np.array(EYE), np.array(_LEAN)
    before = fine.corners.astype(np.float64) - eye
    after = before / (1.0 + before @ lean)[..., None]
    n, v = fine.normals.astype(np.float64), 1.0 - after @ lean
    n = n + lean * ((after * n).sum(axis=-1) / v)[..., None]  # the inverse transpose of the map's derivative, times v
    n /= np.maximum(np.linalg.norm(n, axis=-1, keepdims=True), 1e-12)
    lights = tuple(replace(light, position=tuple(_moved(np.array(light.position)))) for light in scene.lights)
    return replace(fine, corners=(eye + after).astype(np.float32), normals=n.astype(np.float32), lights=lights)


def _moved(point: Float64) -> Float64:
    before = point - EYE
    return np.asarray(EYE + before / (1.0 + before @ _LEAN))


def _split(scene: Scene) -> Scene:
    """Triangles with a long edge become four, until none has one."""
    while True:
        edges = np.linalg.norm(scene.corners - np.roll(scene.corners, 1, axis=1), axis=-1)
        long = edges.max(axis=1) > _LONGEST
        if not long.any():
            return scene
        parts = {name: getattr(scene, name) for name in ("corners", "uv", "normals", "texture", "tint", "gloss")}
        grown = {
            name: np.concatenate(
                [array[~long], _quartered(array[long]) if array.ndim == 3 else np.repeat(array[long], 4, axis=0)]
            )
            for name, array in parts.items()
        }
        scene = replace(scene, **grown)


def _quartered(values: np.ndarray) -> np.ndarray:
    """Values at the corners [T, 3, D] of the four triangles between corners and middles of edges, [4 T, 3, D]."""
    a, b, c = values[:, 0], values[:, 1], values[:, 2]
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    four = [np.stack(corners, axis=1) for corners in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    return np.stack(four, axis=1).reshape(-1, 3, values.shape[2])
