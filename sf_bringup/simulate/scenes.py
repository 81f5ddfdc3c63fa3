"""The worlds: furnished rooms, a machine hall, a palace with its garden, a campus. z up, m."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sf_bringup.simulate import furniture as f
from sf_bringup.simulate.ames import ames
from sf_bringup.simulate.builder import Light, Scene, SceneBuilder

_WARM = (1.0, 0.95, 0.86)
_SUN = (1.0, 0.95, 0.85)


@dataclass(frozen=True)
class RoomPlan:
    """A rectangular room centred on the origin and what stands in it.

    Args:
        size: x, y, z m; wall, floor: material names; pieces: furniture along the walls,
        in order round the room starting at the -y wall; centre: what stands in the middle.
    """

    size: tuple[float, float, float]
    wall: str
    floor: str
    pieces: tuple[str, ...]
    centre: str = "table"


_HOME = ("sofa", "plant", "shelf", "lamp", "cabinet", "window", "shelf", "plant")
_BEDROOM = ("wardrobe", "window", "bed", "cabinet", "shelf", "plant", "lamp", "desk")
_OFFICE = ("desk", "window", "desk", "shelf", "cabinet", "plant", "desk", "shelf", "door", "crates")
_MIXED = (
    "sofa",
    "shelf",
    "window",
    "plant",
    "desk",
    "cabinet",
    "lamp",
    "shelf",
    "door",
    "sofa",
    "plant",
    "wardrobe",
)

ROOMS: dict[str, RoomPlan] = {
    "room": RoomPlan((5.0, 5.0, 2.7), "plaster", "parquet", _HOME),
    "room0": RoomPlan((6.6, 5.2, 2.8), "wallpaper", "parquet", _HOME),
    "room1": RoomPlan((5.4, 5.0, 2.7), "plaster", "parquet", _BEDROOM, "rug"),
    "room2": RoomPlan((6.4, 5.0, 2.8), "brick", "tiles", _MIXED),
    "office0": RoomPlan((5.2, 5.0, 2.8), "plaster", "tiles", _OFFICE, "rug"),
    "office1": RoomPlan((5.0, 4.8, 2.6), "brick", "parquet", _OFFICE),
    "office2": RoomPlan((6.8, 6.0, 3.0), "wallpaper", "tiles", _OFFICE),
    "office3": RoomPlan((8.0, 6.2, 3.0), "concrete", "parquet", _MIXED),
    "office4": RoomPlan((6.2, 5.6, 2.9), "plaster", "concrete", _OFFICE),
    "lounge": RoomPlan((9.0, 7.0, 3.4), "wallpaper", "parquet", _MIXED),
}

# width along the wall and distance of the piece's centre from the wall, m
_FOOTPRINT = {
    "sofa": (2.2, 0.5),
    "plant": (0.6, 0.38),
    "lamp": (0.5, 0.3),
    "shelf": (1.5, 0.2),
    "cabinet": (1.3, 0.26),
    "wardrobe": (1.3, 0.26),
    "desk": (1.6, 0.4),
    "bed": (1.7, 1.12),
    "window": (2.1, 0.0),
    "door": (1.1, 0.0),
    "crates": (1.7, 0.5),
}


def _piece(b: SceneBuilder, name: str) -> None:
    """One piece with its back to -y."""
    if name == "bed":
        with b.at(0, 0, np.pi / 2):
            f.bed(b)
    elif name == "window":
        with b.at(0, 0, z=0.95):
            f.window(b)
    elif name == "wardrobe":
        f.cabinet(b, 1.2, 2.0, "walnut")
    elif name == "desk":
        f.desk(b)
        with b.at(0.1, 0.65, -np.pi / 2 - 0.3):
            f.chair(b)
    elif name == "crates":
        with b.at(-0.4, -0.05):
            f.crates(b)
    else:
        {
            "sofa": f.sofa,
            "plant": f.plant,
            "lamp": f.lamp,
            "shelf": f.shelf,
            "cabinet": f.cabinet,
            "door": f.door,
        }[name](b)


def _along_wall(b: SceneBuilder, length: float, distance: float, yaw: float, queue: list[str], index: int) -> None:
    """Fill one wall (its middle ``distance`` m from the origin) with pieces of the queue, pictures above."""
    place, used = [], 0.0
    while queue and used + _FOOTPRINT[queue[0]][0] < length - 1.3:
        place.append(queue.pop(0))
        used += _FOOTPRINT[place[-1]][0]
    gap = (length - 1.2 - used) / (len(place) + 1)
    x = -length / 2 + 0.6 + gap
    for k, name in enumerate(place):
        width, depth = _FOOTPRINT[name]
        x += width / 2
        with b.at(0, 0, yaw), b.at(x, -distance + depth):
            _piece(b, name)
        if name in ("sofa", "cabinet", "bed", "desk", "crates"):
            with b.at(0, 0, yaw), b.at(x, -distance, z=1.75):
                f.picture(b, 0.5 + 0.15 * ((k + index) % 3), 0.55, 1 + (3 * index + k) % 8)
        x += width / 2 + gap


def _shell(b: SceneBuilder, plan: RoomPlan) -> None:
    sx, sy, sz = plan.size
    wall, floor, top = (f.material(b, n) for n in (plan.wall, plan.floor, "ceiling"))
    b.quad((-sx / 2, -sy / 2, 0), (sx, 0, 0), (0, sy, 0), floor, 2.0, gloss=0.15)
    b.quad((-sx / 2, sy / 2, sz), (sx, 0, 0), (0, -sy, 0), top, 2.5)
    for yaw, length, distance in _walls(sx, sy):
        with b.at(0, 0, yaw):
            b.quad((length / 2, -distance, 0), (-length, 0, 0), (0, 0, sz), wall, 2.2)
            b.box((0, -distance + 0.01, 0), (length, 0.02, 0.1), f.material(b, "oak"), 1.0)


def _walls(sx: float, sy: float) -> tuple[tuple[float, float, float], ...]:
    return (0.0, sx, sy / 2), (np.pi / 2, sy, sx / 2), (np.pi, sx, sy / 2), (-np.pi / 2, sy, sx / 2)


def furnished_room(plan: RoomPlan, seed: int) -> Scene:
    """A room after its plan."""
    b = SceneBuilder(seed)
    sx, sy, sz = plan.size
    _shell(b, plan)
    queue = list(plan.pieces)
    for index, (yaw, length, distance) in enumerate(_walls(sx, sy)):
        _along_wall(b, length, distance, yaw, queue, index)
    b.box((0, 0, 0), (0.42 * sx, 0.42 * sy, 0.015), f.material(b, "fabric10"), 1.6)
    if plan.centre == "table":
        f.table(b)
        for angle in (0.3, 2.9, 3.6, -0.4):
            with b.at(1.0 * np.cos(angle), 0.75 * np.sin(angle), angle + np.pi):
                f.chair(b)
    for x, y in ((-sx / 4, sy / 5), (sx / 4, -sy / 5)):
        b.cylinder((x, y, sz - 0.12), 0.22, 0.12, f.material(b, "paint"), tile=0.5, tint=(1.5, 1.5, 1.4))
    b.lights += [
        Light((-sx / 4, sy / 5, sz - 0.3), _WARM, reach=3.2, shadows=True),
        Light((sx / 4, -sy / 5, sz - 0.3), (0.55, 0.58, 0.62), reach=3.0),
    ]
    return b.build(ambient=0.5)


def hall(seed: int) -> Scene:
    """A 20 x 10 m machine hall with columns, crates, shelves, a gallery of pipes and lamps."""
    b = SceneBuilder(seed)
    plan = RoomPlan((20.0, 10.0, 5.0), "brick", "concrete", ("shelf", "crates", "window", "cabinet") * 7)
    _shell(b, plan)
    queue = list(plan.pieces)
    for index, (yaw, length, distance) in enumerate(_walls(20.0, 10.0)):
        _along_wall(b, length, distance, yaw, queue, index)
    for x in (-7.5, -2.5, 2.5, 7.5):
        for y in (-3.6, 3.6):
            with b.at(x, y):
                f.column(b, 5.0, 0.22)
    for x in (-6.0, -2.0, 2.0, 6.0):
        with b.at(x, b.rng.uniform(-0.2, 0.2), b.rng.uniform(-0.3, 0.3)):
            f.machine(b)
    for y in (-3.6, 3.6):
        b.box((0, y, 4.6), (20, 0.3, 0.35), f.material(b, "metal"), 1.5)
    for x in np.arange(-8, 9, 4):
        b.box((x, 0, 4.7), (0.25, 10, 0.3), f.material(b, "metal"), 1.5)
    for x in (-6.0, 0.0, 6.0):
        b.lights.append(Light((x, 0.3, 4.3), (0.75, 0.72, 0.66), reach=5.0, shadows=x == 0.0))
    return b.build(ambient=0.5)


def palace(seed: int) -> Scene:
    """A 40 x 20 m palace in an 80 x 50 m garden: colonnade, windows, statues, hedges and trees."""
    b = SceneBuilder(seed)
    b.quad((-70, -55, 0), (140, 0, 0), (0, 110, 0), f.material(b, "grass"), 3.5)
    b.box((0, 0, 0), (64, 42, 0.03), f.material(b, "gravel"), 3.0)
    b.box((0, 0, 0), (44, 24, 0.6), f.material(b, "stone"), 3.0)
    b.box((0, 0, 0.6), (40, 20, 11.4), f.material(b, "stone"), 4.0)
    b.box((0, 0, 12), (42, 22, 0.9), f.material(b, "concrete"), 3.0)
    b.lathe((0, 0, 12.9), ((7, 0), (7, 2.5), (6.2, 4.5), (3.5, 6.8), (0, 7.6)), f.material(b, "roof"), 4.0)
    for yaw, length, distance in _walls(40.0, 20.0):
        for x in np.arange(-length / 2 + 2, length / 2 - 1, 4.0):
            with b.at(0, 0, yaw), b.at(x, -distance):
                _palace_bay(b)
    for x in range(-36, 37, 9):
        for side in (-1, 1):
            with b.at(x + b.rng.uniform(-1, 1), side * b.rng.uniform(24.5, 28)):
                f.tree(b, b.rng.uniform(5.5, 9))
            with b.at(x + 4.5, side * 21.5):
                f.statue(b)
            b.box((x, side * 22.3, 0), (3.5, 0.9, 1.1), f.material(b, "leaves"), 1.5)
    for y in range(-18, 19, 9):
        for side in (-1, 1):
            with b.at(side * b.rng.uniform(38, 44), y):
                f.tree(b, b.rng.uniform(6, 9))
    for yaw, length, distance in _walls(110.0, 80.0):
        with b.at(0, 0, yaw):
            b.box((0, -distance - 1, 0), (length, 0.6, 3.2), f.material(b, "brick"), 3.0)
    b.lights.append(Light((0.45, -0.6, 0.75), _SUN, shadows=True))
    return b.build(ambient=0.55, outdoor=True)


def _palace_bay(b: SceneBuilder) -> None:
    """Two storeys of window and a column, facing -y of the wall frame."""
    for z in (1.8, 7.0):
        b.box((0, -0.06, z - 0.2), (2.0, 0.16, 3.4), f.material(b, "concrete"), 2.0, (1.15, 1.12, 1.05))
        b.box((0, -0.14, z), (1.5, 0.06, 2.9), f.material(b, "painting7"), 2.3, (0.5, 0.55, 0.6), 0.6)
        for x in (-0.75, 0, 0.75):
            b.box((x, -0.16, z), (0.09, 0.08, 2.9), f.material(b, "paint"), 1.0)
        b.box((0, -0.25, z + 3.2), (2.4, 0.5, 0.3), f.material(b, "concrete"), 1.5)
    with b.at(2.0, -1.2, z=0.6):
        f.column(b, 11.4, 0.38, "marble")


def campus(seed: int) -> Scene:
    """A 300 x 200 m campus: roads, buildings, trees, cars and lawns, to be seen from the air."""
    b = SceneBuilder(seed)
    b.quad((-260, -210, 0), (520, 0, 0), (0, 420, 0), f.material(b, "grass"), 22.0)
    road = f.material(b, "asphalt")
    xs, ys = (-150, -75, 0, 75, 150), (-100, -33, 33, 100)
    for x in xs:
        b.box((x, 0, 0), (9, 230, 0.04), road, 9.0)
    for y in ys:
        b.box((0, y, 0), (330, 9, 0.05), road, 9.0)
        for x in np.arange(-160, 161, 7.0):
            b.box((x, y, 0.05), (3, 0.25, 0.01), f.material(b, "paint"), 1.0, (1.3, 1.3, 1.3))
            if b.rng.random() < 0.55:
                with b.at(x, y + b.rng.choice((-2.9, 2.9)), z=0.05):
                    f.car(b)
    for i, x in enumerate((-112, -37, 37, 112)):
        for j, y in enumerate((-67, 0, 67)):
            with b.at(x, y):
                _block(b, i + 4 * j)
    b.lights.append(Light((0.5, -0.45, 0.8), _SUN, shadows=True))
    return b.build(ambient=0.5, outdoor=True)


def _block(b: SceneBuilder, index: int) -> None:
    """One block between roads, about 60 x 52 m: two or three buildings among trees and paths."""
    b.box((0, 0, 0), (58, 3, 0.03), f.material(b, "gravel"), 4.0)
    b.box((0, 0, 0), (3, 50, 0.035), f.material(b, "gravel"), 4.0)
    for k, (x, y) in enumerate(((-16, 12), (16, 12), (-16, -12), (16, -12))):
        if (index + k) % 4 == 3:
            for _ in range(9):
                with b.at(x + b.rng.uniform(-11, 11), y + b.rng.uniform(-8, 8)):
                    f.tree(b, b.rng.uniform(6, 12))
            continue
        sx, sy = b.rng.uniform(14, 24), b.rng.uniform(10, 16)
        with b.at(x, y):
            f.building(b, sx, sy, 4.0 * int(b.rng.integers(2, 7)), int(b.rng.integers(1, 6)))
    for t in np.linspace(-26, 26, 6):
        for side in (-1, 1):
            with b.at(t + b.rng.uniform(-2, 2), side * 23.5):
                f.tree(b, b.rng.uniform(4, 8))


SCENES: dict[str, Callable[[int], Scene]] = {
    **{name: (lambda seed, plan=plan: furnished_room(plan, seed)) for name, plan in ROOMS.items()},
    "ames": lambda seed: ames(furnished_room(ROOMS["room2"], seed)),
    "hall": hall,
    "palace": palace,
    "campus": campus,
}
