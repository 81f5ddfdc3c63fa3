"""Furniture, street furniture and plants: each function builds one piece about its own origin."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np

from sf_bringup.simulate import textures as tx
from sf_bringup.simulate.builder import SceneBuilder

_S = 1024


def material(b: SceneBuilder, name: str) -> int:
    """Index of a shared texture by name, made on first use (``painting3`` is the third painting)."""
    r = np.random.default_rng([b.seed, *name.encode()])
    if name.startswith("painting"):
        return b.textures.named(name, lambda: tx.painting(r, 512))
    if name.startswith("fabric"):
        base, accent = (tuple(r.uniform(lo, hi, 3)) for lo, hi in ((0.15, 0.75), (0.3, 0.9)))
        return b.textures.named(name, lambda: tx.fabric(r, 512, base, accent, int(r.integers(4, 11))))
    if name.startswith("facade"):
        wall = tuple(r.uniform([0.45, 0.35, 0.28], [0.85, 0.75, 0.65]))
        return b.textures.named(name, lambda: tx.windows(r, _S, wall, int(r.integers(3, 6)), 4))
    makers = {
        "oak": lambda: tx.wood(r, 512, (0.38, 0.23, 0.12), (0.72, 0.52, 0.32)),
        "walnut": lambda: tx.wood(r, 512, (0.2, 0.11, 0.06), (0.48, 0.3, 0.18)),
        "parquet": lambda: tx.wood(r, _S, (0.42, 0.27, 0.15), (0.75, 0.55, 0.36), planks=12),
        "plaster": lambda: tx.mottled(r, _S, (0.66, 0.63, 0.57), (0.88, 0.86, 0.8), 0.05),
        "ceiling": lambda: tx.mottled(r, _S, (0.74, 0.74, 0.72), (0.93, 0.92, 0.9), 0.07),
        "wallpaper": lambda: tx.fabric(r, _S, (0.78, 0.74, 0.66), (0.55, 0.62, 0.6), 6),
        "concrete": lambda: tx.mottled(r, _S, (0.4, 0.4, 0.39), (0.72, 0.71, 0.68), 0.09),
        "stone": lambda: tx.bricks(r, _S, (0.72, 0.66, 0.55), (0.45, 0.42, 0.37), 8, 4),
        "marble": lambda: tx.tiles(r, 512, (0.82, 0.8, 0.76), (0.78, 0.76, 0.72), 2),
        "brick": lambda: tx.bricks(r, _S, (0.6, 0.3, 0.22), (0.7, 0.67, 0.62)),
        "tiles": lambda: tx.tiles(r, _S, (0.78, 0.76, 0.7), (0.45, 0.42, 0.4)),
        "metal": lambda: tx.panels(r, 512, (0.55, 0.6, 0.62)),
        "paint": lambda: tx.mottled(r, 512, (0.5, 0.5, 0.5), (0.85, 0.85, 0.85), 0.12),
        "leaves": lambda: tx.foliage(r, 512, (0.06, 0.17, 0.05), (0.45, 0.62, 0.25)),
        "grass": lambda: tx.foliage(r, _S, (0.16, 0.28, 0.09), (0.5, 0.6, 0.28)),
        "gravel": lambda: tx.foliage(r, _S, (0.4, 0.36, 0.3), (0.76, 0.72, 0.64)),
        "asphalt": lambda: tx.mottled(r, _S, (0.22, 0.22, 0.23), (0.46, 0.46, 0.46), 0.16),
        "bark": lambda: tx.wood(r, 512, (0.15, 0.1, 0.07), (0.45, 0.36, 0.27)),
        "roof": lambda: tx.bricks(r, _S, (0.5, 0.3, 0.24), (0.25, 0.18, 0.16), 24, 16),
    }
    return b.textures.named(name, makers[name])


def table(b: SceneBuilder, length: float = 1.6, depth: float = 0.85, height: float = 0.75) -> None:
    """A table with things on it: books, a bowl and a vase."""
    oak = material(b, "oak")
    b.box((0, 0, height - 0.05), (length, depth, 0.05), oak, 0.9, gloss=0.25)
    for sx in (-1, 1):
        for sy in (-1, 1):
            b.box((sx * (length / 2 - 0.07), sy * (depth / 2 - 0.07), 0), (0.07, 0.07, height - 0.05), oak)
    b.box((-0.3 * length, 0.1 * depth, height), (0.3, 0.22, 0.05), material(b, "painting1"), None)
    b.box((-0.3 * length, 0.1 * depth, height + 0.05), (0.24, 0.18, 0.03), material(b, "fabric1"), 0.3)
    bowl = ((0.03, 0), (0.1, 0.04), (0.13, 0.1), (0.12, 0.1), (0.0, 0.02))
    b.lathe((0.1, -0.05, height), bowl, material(b, "marble"), 0.3, gloss=0.5)
    vase = ((0.05, 0), (0.09, 0.1), (0.05, 0.2), (0.06, 0.26))
    b.lathe((0.3 * length, 0.12, height), vase, material(b, "fabric2"), 0.25, gloss=0.4)
    b.sphere((0.3 * length, 0.12, height + 0.36), 0.14, material(b, "leaves"), tile=0.3)


def chair(b: SceneBuilder, cloth: str = "fabric3") -> None:
    """A chair looking towards +x."""
    walnut = material(b, "walnut")
    b.box((0, 0, 0.43), (0.44, 0.44, 0.05), material(b, cloth), 0.5)
    for sx in (-0.19, 0.19):
        for sy in (-0.19, 0.19):
            b.box((sx, sy, 0), (0.04, 0.04, 0.43 if sx > 0 else 0.95), walnut, 0.6)
    for z in (0.58, 0.72, 0.86):
        b.box((-0.19, 0, z), (0.025, 0.38, 0.08), walnut, 0.5)


def sofa(b: SceneBuilder, length: float = 2.0, cloth: str = "fabric4") -> None:
    """A sofa with its back at -y, with cushions."""
    body = material(b, cloth)
    b.box((0, 0, 0.08), (length, 0.85, 0.32), body, 0.8)
    b.box((0, -0.34, 0.4), (length, 0.18, 0.45), body, 0.8)
    for side in (-1, 1):
        b.box((side * (length / 2 - 0.09), 0, 0.4), (0.18, 0.85, 0.22), body, 0.8)
        b.sphere((side * length * 0.28, -0.12, 0.56), 0.21, material(b, "fabric5"), 0.8, tile=0.5)
    for k in range(2):
        b.box(
            ((k - 0.5) * (length - 0.4) / 2, 0.06, 0.4),
            ((length - 0.42) / 2, 0.66, 0.1),
            body,
            0.7,
            (0.9,) * 3,
        )


def bed(b: SceneBuilder) -> None:
    """A bed with its head at -x."""
    b.box((0, 0, 0.1), (2.05, 1.5, 0.22), material(b, "walnut"), 0.9)
    b.box((0, 0, 0.32), (2.0, 1.44, 0.2), material(b, "fabric6"), 1.0)
    b.box((0.3, 0, 0.5), (1.42, 1.52, 0.06), material(b, "fabric7"), 1.2)
    b.box((-1.05, 0, 0.0), (0.08, 1.6, 1.05), material(b, "oak"), 0.9)
    for y in (-0.36, 0.36):
        b.sphere((-0.72, y, 0.58), 0.3, material(b, "fabric8"), 0.35, tile=0.6)


def shelf(b: SceneBuilder, width: float = 1.4, height: float = 2.0, boards: int = 5) -> None:
    """A bookcase with its back at -y, filled with books of all sizes."""
    wood = material(b, "walnut")
    b.box((0, -0.15, 0), (width, 0.02, height), wood, 1.0)
    for side in (-1, 1):
        b.box((side * width / 2, 0, 0), (0.03, 0.32, height), wood, 1.0)
    pitch = height / boards
    for k in range(boards + 1):
        b.box((0, 0, min(k * pitch, height - 0.03)), (width, 0.32, 0.03), wood, 1.0)
    for k in range(boards):
        x = -width / 2 + 0.04
        while x < width / 2 - 0.1:
            w, h = b.rng.uniform(0.025, 0.07), pitch * b.rng.uniform(0.55, 0.85)
            cover = material(b, f"painting{b.rng.integers(1, 7)}")
            b.box((x + w / 2, 0, k * pitch + 0.03), (w * 0.93, 0.22, h), cover, 0.6, b.rng.uniform(0.5, 1.1, 3))
            x += w if b.rng.random() < 0.93 else 0.16


def cabinet(b: SceneBuilder, width: float = 1.2, height: float = 0.85, wood: str = "oak") -> None:
    """A cabinet with its back at -y, with doors, knobs and things on top."""
    grain = material(b, wood)
    b.box((0, 0, 0.05), (width, 0.45, height - 0.05), grain, 1.0)
    doors = max(2, round(width / 0.5))
    for k in range(doors):
        x = (k + 0.5) * width / doors - width / 2
        b.box((x, 0.232, 0.12), (width / doors - 0.05, 0.025, height - 0.2), grain, 0.8, (1.12, 1.08, 1.0))
        b.sphere((x + 0.3 * width / doors, 0.26, height / 2), 0.02, material(b, "metal"), gloss=0.6, segments=10)
    if height < 1.2:
        b.box((-0.3 * width, 0, height), (0.2, 0.04, 0.26), material(b, "painting2"), None)
        b.lathe(
            (0.25 * width, 0, height),
            ((0.06, 0), (0.1, 0.12), (0.04, 0.24), (0.07, 0.3)),
            material(b, "fabric9"),
            0.3,
        )


def desk(b: SceneBuilder) -> None:
    """A desk against -y with a screen, a keyboard and papers."""
    b.box((0, 0, 0.7), (1.5, 0.7, 0.04), material(b, "oak"), 0.9)
    for side in (-0.6, 0.6):
        b.box((side, 0, 0), (0.28, 0.6, 0.7), material(b, "walnut"), 0.8)
    b.box((0, -0.15, 0.74), (0.22, 0.16, 0.02), material(b, "metal"), 0.5)
    b.box((0, -0.18, 0.76), (0.05, 0.03, 0.15), material(b, "metal"), 0.5)
    b.box((0, -0.17, 0.88), (0.62, 0.035, 0.37), material(b, "painting3"), None, gloss=0.3)
    b.box((0, 0.13, 0.74), (0.44, 0.15, 0.02), material(b, "metal"), 0.12)
    b.box((0.45, 0.1, 0.74), (0.21, 0.3, 0.02), material(b, "painting4"), None)
    b.cylinder((-0.5, 0.1, 0.74), 0.04, 0.1, material(b, "fabric2"), tile=0.25)


def plant(b: SceneBuilder, height: float = 1.3) -> None:
    """A pot plant of many overlapping leaf balls."""
    b.lathe((0, 0, 0), ((0.13, 0), (0.2, 0.34), (0.17, 0.34), (0, 0.3)), material(b, "brick"), 0.6)
    b.cylinder((0, 0, 0.3), 0.02, height - 0.5, material(b, "bark"), tile=0.3)
    for _ in range(9):
        x, y, z = b.rng.normal(0, 0.13, 3)
        radius = b.rng.uniform(0.1, 0.19)
        b.sphere((x, y, height - 0.25 + 1.4 * z), radius, material(b, "leaves"), 0.8, tile=0.35, segments=14)


def lamp(b: SceneBuilder) -> None:
    """A standard lamp."""
    b.cylinder((0, 0, 0), 0.15, 0.03, material(b, "metal"), tile=0.4)
    b.cylinder((0, 0, 0.03), 0.015, 1.4, material(b, "metal"), tile=0.4)
    b.lathe((0, 0, 1.4), ((0.22, 0), (0.13, 0.3)), material(b, "fabric1"), 0.4, (1.3, 1.2, 1.0))


def picture(b: SceneBuilder, width: float, height: float, index: int) -> None:
    """A framed picture centred on the origin, facing +y."""
    b.box((0, 0.015, -height / 2 - 0.04), (width + 0.08, 0.03, height + 0.08), material(b, "walnut"), 0.5)
    image = material(b, f"painting{index}")
    b.quad((width / 2, 0.034, -height / 2), (-width, 0, 0), (0, 0, height), image, gloss=0.15)


def window(b: SceneBuilder, width: float = 1.4, height: float = 1.3) -> None:
    """A window with its sill at the origin, facing +y: a painted view, frame, bars and curtains."""
    b.quad((width / 2, 0.01, 0), (-width, 0, 0), (0, 0, height), material(b, "grass"), 2.5, (1.5, 1.7, 2.0))
    frame = material(b, "paint")
    for x in (-width / 2, 0, width / 2):
        b.box((x, 0.03, -0.03), (0.07, 0.06, height + 0.06), frame, 0.5, (1.1, 1.1, 1.1))
    for z in (-0.03, height * 0.62, height):
        b.box((0, 0.03, z), (width, 0.05, 0.06), frame, 0.5, (1.1, 1.1, 1.1))
    b.box((0, 0.1, -0.08), (width + 0.2, 0.22, 0.04), material(b, "marble"), 0.8)
    for side in (-1, 1):
        for k in range(4):
            x = side * (width / 2 + 0.05 + 0.07 * k)
            b.cylinder((x, 0.1, -0.5), 0.05, height + 0.7, material(b, "fabric6"), tile=0.5, segments=10)


def door(b: SceneBuilder) -> None:
    """A panelled door on the floor, facing +y."""
    b.box((0, 0.02, 0), (1.02, 0.04, 2.08), material(b, "walnut"), 0.9)
    b.box((0, 0.045, 0), (0.88, 0.02, 2.0), material(b, "oak"), 1.1)
    for z, h in ((0.15, 0.75), (1.05, 0.8)):
        b.box((0, 0.06, z), (0.6, 0.015, h), material(b, "oak"), 0.7, (0.85, 0.82, 0.8))
    b.sphere((0.36, 0.1, 1.0), 0.03, material(b, "metal"), gloss=0.6)


def machine(b: SceneBuilder) -> None:
    """A workshop machine: body, gear box, tank, pipes and a control panel."""
    metal, tint = material(b, "metal"), b.rng.uniform(0.6, 1.3, 3)
    b.box((0, 0, 0), (2.2, 1.2, 0.25), material(b, "concrete"), 1.0)
    b.box((-0.3, 0, 0.25), (1.4, 0.9, 1.1), metal, 1.0, tint, 0.3)
    b.box((-0.4, 0, 1.35), (0.7, 0.6, 0.45), metal, 0.7, tint * 0.8, 0.3)
    b.cylinder((0.75, 0, 0.25), 0.32, 1.5, metal, tile=0.8, gloss=0.4)
    b.sphere((0.75, 0, 1.75), 0.32, metal, 0.5, tile=0.8)
    b.cylinder((-0.9, 0.3, 1.35), 0.06, 1.2, material(b, "paint"), tile=0.4, tint=(1.0, 0.6, 0.3))
    b.box((-0.1, 0.47, 0.7), (0.5, 0.05, 0.4), material(b, "painting5"), None)
    b.box((-0.1, -0.47, 0.7), (0.5, 0.05, 0.4), material(b, "painting6"), None)


def crates(b: SceneBuilder) -> None:
    """A stack of wooden crates."""
    for x, y, z, s in ((0, 0, 0, 0.8), (0.85, 0.1, 0, 0.7), (0.1, 0.05, 0.8, 0.65), (0.8, 0.1, 0.7, 0.45)):
        with b.at(x, y, b.rng.uniform(-0.2, 0.2)):
            b.box((0, 0, z), (s, s, s), material(b, "parquet"), 1.6, b.rng.uniform(0.75, 1.15, 3))


def column(b: SceneBuilder, height: float, radius: float, stone: str = "concrete") -> None:
    """A column with plinth and capital."""
    look = material(b, stone)
    b.box((0, 0, 0), (2.8 * radius, 2.8 * radius, radius), look, 1.2)
    b.lathe((0, 0, radius), ((radius, 0), (0.85 * radius, height - 2 * radius)), look, 1.5)
    b.box((0, 0, height - radius), (2.8 * radius, 2.8 * radius, radius), look, 1.2)


def tree(b: SceneBuilder, height: float = 7.0) -> None:
    """A broad-leaved tree: trunk, and a crown of leaf balls."""
    trunk = ((0.05 * height, 0), (0.03 * height, 0.2 * height), (0.02 * height, 0.6 * height))
    b.lathe((0, 0, 0), trunk, material(b, "bark"), 1.0, segments=10)
    for _ in range(14):
        x, y, z = b.rng.normal(0, 0.13 * height, 3)
        radius, tint = b.rng.uniform(0.11, 0.2) * height, b.rng.uniform(0.75, 1.25)
        look = {"tile": 2.0, "tint": (tint, tint, 0.9 * tint), "segments": 12}
        b.sphere((x, y, 0.7 * height + 0.8 * z), radius, material(b, "leaves"), 0.8, **look)


def statue(b: SceneBuilder) -> None:
    """A figure on a pedestal."""
    stone = material(b, "concrete")
    b.box((0, 0, 0), (1.3, 1.3, 0.3), stone, 1.5)
    b.box((0, 0, 0.3), (0.9, 0.9, 1.2), stone, 1.5)
    body = ((0.3, 0), (0.34, 0.5), (0.22, 0.95), (0.3, 1.35), (0.1, 1.55), (0.09, 1.62))
    b.lathe((0, 0, 1.5), body, stone, 0.8, (1.15, 1.12, 1.05))
    b.sphere((0, 0, 3.25), 0.17, stone, 1.2, tile=0.6)
    b.lathe((0.3, 0, 2.1), ((0.05, 0), (0.09, 0.6)), stone, 0.6)
    b.lathe((-0.3, 0, 2.1), ((0.05, 0), (0.09, 0.6)), stone, 0.6)


def car(b: SceneBuilder) -> None:
    """A parked car along x."""
    paint, tint = material(b, "paint"), b.rng.uniform(0.3, 1.2, 3)
    b.box((0, 0, 0.35), (4.3, 1.75, 0.6), paint, 2.0, tint, 0.5)
    b.box((-0.2, 0, 0.95), (2.3, 1.55, 0.5), material(b, "metal"), 1.2, (0.35, 0.4, 0.5), 0.6)
    b.box((-0.2, 0, 1.45), (2.0, 1.5, 0.04), paint, 2.0, tint, 0.5)
    for x in (-1.35, 1.35):
        b.box((x, 0, 0), (0.62, 1.8, 0.62), material(b, "asphalt"), 1.0, (0.5, 0.5, 0.5))


def building(b: SceneBuilder, sx: float, sy: float, height: float, index: int) -> None:
    """A campus building: windowed facades, a roof with parapet, plant rooms and vents."""
    b.box((0, 0, 0), (sx, sy, height), material(b, f"facade{index}"), 12.0)
    b.box((0, 0, height), (sx + 0.6, sy + 0.6, 0.8), material(b, "concrete"), 5.0)
    b.box(
        (0, 0, height + 0.8),
        (sx - 0.6, sy - 0.6, 0.1),
        material(b, "gravel"),
        6.0,
        b.rng.uniform(0.7, 1.1, 3),
    )
    for _ in range(int(sx * sy / 90) + 2):
        x, y = b.rng.uniform(-0.4, 0.4, 2) * (sx, sy)
        w, d, h = b.rng.uniform(0.8, 3.5, 3)
        b.box((x, y, height + 0.9), (w, d, 0.8 * h), material(b, "metal"), 2.5, b.rng.uniform(0.6, 1.3, 3))
