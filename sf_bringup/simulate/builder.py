"""Scenes as textured triangles, and the small set of solids they are built from."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sf_bringup.simulate.textures import TextureSet
from sf_interfaces.errors import FormatError
from sf_interfaces.types import Float32, Float64

Vector = Sequence[float]


@dataclass(frozen=True)
class Light:
    """A lamp at ``position`` m, or the sun in direction ``position`` (towards it) when ``reach`` is inf."""

    position: tuple[float, float, float]
    colour: tuple[float, float, float]
    reach: float = float("inf")
    shadows: bool = False


@dataclass(frozen=True)
class Scene:
    """Textured triangles in the world frame (z up, m).

    Args:
        corners: [T, 3, 3] m; uv: [T, 3, 2] tiles; normals: [T, 3, 3] unit; texture: [T]; tint: [T, 3];
        gloss: [T] specular weight; ambient: light from above and below; sky: miss colour, None = black.
    """

    corners: Float32
    uv: Float32
    normals: Float32
    texture: NDArray[np.int64]
    tint: Float32
    gloss: Float32
    textures: TextureSet
    lights: tuple[Light, ...]
    ambient: float = 0.45
    outdoor: bool = False

    def __post_init__(self) -> None:
        if len(self.corners) == 0:
            raise FormatError("the scene has no triangles; check its models")


@dataclass
class SceneBuilder:
    """Collects solids. Furniture writes in its own frame inside ``with builder.at(x, y, yaw)``."""

    seed: int
    textures: TextureSet = field(default_factory=TextureSet)
    lights: list[Light] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)
        self._parts: list[tuple[Float64, Float64, Float64, int, Float64, float]] = []
        self._pose = np.eye(4)

    @contextmanager
    def at(self, x: float, y: float, yaw: float = 0.0, z: float = 0.0) -> Iterator[None]:
        """Place what follows at (x, y, z) m, turned by ``yaw`` rad; nests."""
        previous, c, s = self._pose, np.cos(yaw), np.sin(yaw)
        self._pose = previous @ np.array([[c, -s, 0, x], [s, c, 0, y], [0, 0, 1, z], [0, 0, 0, 1.0]])
        yield
        self._pose = previous

    def triangles(
        self, corners: Float64, uv: Float64, normals: Float64, texture: int, tint: Vector, gloss: float
    ) -> None:
        """Add triangles [T, 3, 3] of the local frame with uv [T, 3, 2] and normals [T, 3, 3]."""
        R, t = self._pose[:3, :3], self._pose[:3, 3]
        self._parts.append((corners @ R.T + t, uv, normals @ R.T, texture, np.asarray(tint, float), gloss))

    def quad(
        self,
        origin: Vector,
        along: Vector,
        up: Vector,
        texture: int,
        tile: float | None = None,
        tint: Vector = (1, 1, 1),
        gloss: float = 0.1,
    ) -> None:
        """A parallelogram; ``tile`` metres per repeat, or None to fit the texture once (v downwards)."""
        o, a, b = (np.asarray(x, dtype=float) for x in (origin, along, up))
        p = np.stack([o, o + a, o + a + b, o + b])
        la, lb = np.linalg.norm(a), np.linalg.norm(b)
        size = (1.0, 1.0) if tile is None else (la / tile, lb / tile)
        shift = np.zeros(2) if tile is None else self.rng.random(2)
        uv = np.array([[0, 1], [1, 1], [1, 0], [0, 0]]) * size + shift
        n = np.cross(a, b)
        normals = np.broadcast_to(n / np.linalg.norm(n), (2, 3, 3))
        index = np.array([[0, 1, 2], [0, 2, 3]])
        self.triangles(p[index], uv[index], normals, texture, tint, gloss)

    def box(
        self,
        base: Vector,
        size: Vector,
        texture: int,
        tile: float | None = 1.0,
        tint: Vector = (1, 1, 1),
        gloss: float = 0.1,
    ) -> None:
        """A box on the centre of its base (x, y, z) with size (x, y, z) m."""
        (x, y, z), (sx, sy, sz) = base, size
        x0, y0 = x - sx / 2, y - sy / 2
        x1, y1, z1 = x0 + sx, y0 + sy, z + sz
        for origin, along, up in (
            ((x0, y0, z), (sx, 0, 0), (0, 0, sz)),
            ((x1, y1, z), (-sx, 0, 0), (0, 0, sz)),
            ((x1, y0, z), (0, sy, 0), (0, 0, sz)),
            ((x0, y1, z), (0, -sy, 0), (0, 0, sz)),
            ((x0, y0, z1), (sx, 0, 0), (0, sy, 0)),
            ((x0, y1, z), (sx, 0, 0), (0, -sy, 0)),
        ):
            self.quad(origin, along, up, texture, tile, tint, gloss)

    def lathe(
        self,
        base: Vector,
        profile: Sequence[tuple[float, float]],
        texture: int,
        tile: float = 1.0,
        tint: Vector = (1, 1, 1),
        gloss: float = 0.1,
        segments: int = 20,
        squash: tuple[float, float] = (1.0, 1.0),
    ) -> None:
        """A solid of revolution about z from (radius, height) pairs m, bottom to top."""
        r, h = np.asarray(profile, dtype=float).T
        angle = np.linspace(0, 2 * np.pi, segments + 1)
        ring = np.stack([np.cos(angle) * squash[0], np.sin(angle) * squash[1]], -1)
        p = np.concatenate([r[:, None, None] * ring, np.broadcast_to(h[:, None, None], (len(r), segments + 1, 1))], -1)
        slope_r, slope_h = np.gradient(r), np.gradient(h)
        n = np.concatenate(
            [
                slope_h[:, None, None] * ring,
                np.broadcast_to(-slope_r[:, None, None], (len(r), segments + 1, 1)),
            ],
            -1,
        )
        n /= np.maximum(np.linalg.norm(n, axis=-1, keepdims=True), 1e-9)
        arc = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(r), np.diff(h)))]) / tile
        around = max(1, round(2 * np.pi * r.max() / tile))
        u, v = np.broadcast_arrays(angle[None] / (2 * np.pi) * around, -arc[:, None])
        uv = np.stack([u, v], -1) + self.rng.random(2)
        i, j = (g.ravel() for g in np.mgrid[0 : len(r) - 1, 0:segments])
        low = np.stack([np.stack([i, j], -1), np.stack([i, j + 1], -1), np.stack([i + 1, j + 1], -1)], 1)
        high = np.stack([np.stack([i, j], -1), np.stack([i + 1, j + 1], -1), np.stack([i + 1, j], -1)], 1)
        index = np.concatenate([low, high])
        pick = (index[..., 0], index[..., 1])
        corners = p[pick] + np.asarray(base, dtype=float)
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1)
        keep = area > 1e-10
        self.triangles(corners[keep], uv[pick][keep], n[pick][keep], texture, tint, gloss)

    def cylinder(self, base: Vector, radius: float, height: float, texture: int, **look: object) -> None:
        """A closed upright cylinder on the centre of its base."""
        e = 1e-3 * radius
        profile = (
            (0, 0),
            (radius - e, 0),
            (radius, e),
            (radius, height - e),
            (radius - e, height),
            (0, height),
        )
        self.lathe(base, profile, texture, **look)  # type: ignore[arg-type]

    def sphere(self, centre: Vector, radius: float, texture: int, flatten: float = 1.0, **look: object) -> None:
        """A sphere, or an ellipsoid of vertical half axis ``radius * flatten``."""
        a = np.linspace(-np.pi / 2, np.pi / 2, 13)
        profile = list(zip(radius * np.cos(a), radius * flatten * np.sin(a), strict=True))
        self.lathe(centre, profile, texture, **look)  # type: ignore[arg-type]

    def build(self, ambient: float = 0.45, outdoor: bool = False) -> Scene:
        """The finished scene."""
        if not self._parts:
            raise FormatError("the scene has no triangles; check its models")
        count = [len(p[0]) for p in self._parts]
        return Scene(
            corners=np.concatenate([p[0] for p in self._parts]).astype(np.float32),
            uv=np.concatenate([p[1] for p in self._parts]).astype(np.float32),
            normals=np.concatenate([p[2] for p in self._parts]).astype(np.float32),
            texture=np.repeat([p[3] for p in self._parts], count),
            tint=np.repeat([p[4] for p in self._parts], count, axis=0).astype(np.float32),
            gloss=np.repeat([p[5] for p in self._parts], count).astype(np.float32),
            textures=self.textures,
            lights=tuple(self.lights),
            ambient=ambient,
            outdoor=outdoor,
        )
