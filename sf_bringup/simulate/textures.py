"""Procedural tileable textures with a natural (1/f) spectrum, and their filtered lookup.

Every generator returns [S, S, 3] float32 in 0..1 that repeats without a seam. :class:`TextureSet` holds them
as mip pyramids and samples trilinearly, so that a surface seen from afar does not alias.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from sf_interfaces.errors import FormatError
from sf_interfaces.types import Float32, UInt8

Rng = np.random.Generator
Colour = tuple[float, float, float]
_MAX_LEVELS = 12


def noise(rng: Rng, size: int, exponent: float = 1.0, stretch: tuple[float, float] = (1.0, 1.0)) -> Float32:
    """Periodic noise [size, size] of unit deviation whose amplitude falls as frequency^-exponent.

    ``stretch`` (x, y) > 1 lengthens the features along that axis (wood grain, brushed metal).
    """
    f = np.fft.fftfreq(size) * size
    fx, fy = f[None, : size // 2 + 1] * stretch[0], f[:, None] * stretch[1]
    radius = np.sqrt(fx**2 + fy**2)
    radius[0, 0] = np.inf
    spectrum = rng.standard_normal(radius.shape) + 1j * rng.standard_normal(radius.shape)
    field = np.fft.irfft2(spectrum / np.maximum(radius, 1.0) ** exponent, s=(size, size))
    return ((field - field.mean()) / field.std()).astype(np.float32)


def _blend(a: Colour, b: Colour, t: NDArray[np.floating]) -> Float32:
    t = np.clip(t, 0, 1)[..., None]
    return (np.asarray(a, np.float32) * (1 - t) + np.asarray(b, np.float32) * t).astype(np.float32)


def _grid(size: int) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    v, u = np.mgrid[0:size, 0:size].astype(np.float32) / size
    return u, v


def _shade(image: Float32, gain: NDArray[np.floating]) -> Float32:
    return np.clip(image * gain[..., None], 0, 1).astype(np.float32)


def mottled(rng: Rng, size: int, dark: Colour, light: Colour, grain: float = 0.1) -> Float32:
    """Plaster, concrete, stone, earth: two colours mixed by 1/f noise with fine grain."""
    image = _blend(dark, light, 0.5 + 0.3 * noise(rng, size, 1.25))
    return _shade(image, 1 + grain * noise(rng, size, 0.45))


def wood(rng: Rng, size: int, dark: Colour, light: Colour, planks: int = 0) -> Float32:
    """Wood grain along x; with ``planks`` > 0 a floor of so many staggered boards."""
    u, v = _grid(size)
    rings = 0.5 + 0.5 * np.sin(6 * noise(rng, size, 1.3, (6.0, 0.6)))
    fibre = noise(rng, size, 0.6, (10.0, 0.7))
    image = _shade(_blend(dark, light, 0.65 * rings + 0.2 + 0.12 * fibre), 1 + 0.05 * noise(rng, size, 0.8))
    if not planks:
        return image
    row = np.floor(v * planks).astype(int)
    shift = rng.random(planks)[row]
    joint = (u + shift) % 0.5
    board = row * 2 + ((u + shift) % 1.0 > 0.5)
    gap = np.minimum((v * planks) % 1, 1 - (v * planks) % 1) / planks
    line = (gap < 0.0022) | (joint < 0.003)
    return _shade(image, rng.uniform(0.7, 1.2, 2 * planks)[board] * np.where(line, 0.4, 1.0))


def bricks(rng: Rng, size: int, brick: Colour, mortar: Colour, rows: int = 12, columns: int = 5) -> Float32:
    """Running-bond masonry; ``rows`` even. Also ashlar stone and wall tiles by other counts and colours."""
    u, v = _grid(size)
    row = np.floor(v * rows).astype(int)
    x = u * columns + 0.5 * (row % 2)
    index = (row * columns + np.floor(x).astype(int) % columns) % (rows * columns)
    edge = np.minimum(np.minimum(x % 1, 1 - x % 1) / columns, np.minimum(v * rows % 1, 1 - v * rows % 1) / rows)
    tone = rng.uniform(0.65, 1.2, (rows * columns, 1)) * rng.uniform(0.92, 1.08, (rows * columns, 3))
    face = np.asarray(brick, np.float32) * tone[index] * (1 + 0.14 * noise(rng, size, 0.75))[..., None]
    joint = np.asarray(mortar, np.float32) * (1 + 0.1 * noise(rng, size, 0.5))[..., None]
    wobble = 0.06 / rows * (1 + 0.5 * noise(rng, size, 1.2))
    return np.clip(np.where((edge < wobble)[..., None], joint, face), 0, 1).astype(np.float32)


def tiles(rng: Rng, size: int, first: Colour, second: Colour, count: int = 6) -> Float32:
    """Chequered floor tiles with marble veins and joints; ``count`` even."""
    u, v = _grid(size)
    i, j = np.floor(u * count).astype(int), np.floor(v * count).astype(int)
    vein = np.exp(-np.abs(noise(rng, size, 1.4)) * 7)
    image = _blend(first, second, ((i + j) % 2).astype(np.float32))
    tone = rng.uniform(0.82, 1.12, count * count)[i * count + j]
    gain = tone * (1 - 0.35 * vein + 0.06 * noise(rng, size, 0.6))
    edge = np.minimum.reduce([u * count % 1, 1 - u * count % 1, v * count % 1, 1 - v * count % 1])
    return _shade(image, gain * np.where(edge < 0.018, 0.5, 1.0))


def fabric(rng: Rng, size: int, base: Colour, accent: Colour, pattern: int = 8) -> Float32:
    """Woven cloth with a repeated ornament, wear and weave."""
    u, v = _grid(size)
    phase = rng.uniform(0, 2 * np.pi, 4)
    a, b = 2 * np.pi * pattern * u, 2 * np.pi * pattern * v
    ornament = np.sin(a + phase[0]) * np.sin(b + phase[1]) + 0.6 * np.sin(2 * a - b + phase[2])
    ornament = 1 / (1 + np.exp(-5 * (ornament + 0.35 * noise(rng, size, 0.9))))
    weave = 1 + 0.07 * np.sin(2 * np.pi * size / 6 * u) * np.sin(2 * np.pi * size / 6 * v)
    return _shade(_blend(base, accent, 0.75 * ornament), weave * (1 + 0.1 * noise(rng, size, 0.8)))


def painting(rng: Rng, size: int) -> Float32:
    """A picture with detail at every scale: layered colour fields, strokes, discs and lines."""
    palette = rng.uniform(0.1, 0.95, (7, 3)).astype(np.float32)
    level = noise(rng, size, 1.5) * 1.6 + 3.0 + 0.3 * noise(rng, size, 0.8)
    image = np.ascontiguousarray(palette[np.clip(level, 0, 6).astype(int)])
    for _ in range(140):
        p = tuple(int(x) for x in rng.integers(0, size, 2))
        q = tuple(int(x) for x in np.asarray(p) + rng.normal(0, size / 9, 2))
        colour = tuple(float(x) for x in np.clip(palette[rng.integers(7)] + rng.normal(0, 0.15, 3), 0, 1))
        if rng.random() < 0.35:
            cv2.circle(image, p, int(rng.integers(2, size // 14)), colour, -1, cv2.LINE_AA)
        else:
            cv2.line(image, p, q, colour, int(rng.integers(1, 6)), cv2.LINE_AA)
    return _shade(image, 1 + 0.08 * noise(rng, size, 0.5, (1.0, 3.0)))


def panels(rng: Rng, size: int, base: Colour, count: int = 4) -> Float32:
    """Sheet metal: panels with seams, rivets, scratches and stains."""
    u, v = _grid(size)
    x, y = u * count % 1, v * count % 1
    edge = np.minimum.reduce([x, 1 - x, y, 1 - y])
    index = (np.floor(u * count) * count + np.floor(v * count)).astype(int)
    rivet = np.hypot(np.abs(x - 0.5) - 0.42, np.abs(y - 0.5) - 0.42) < 0.02
    gain = rng.uniform(0.75, 1.15, count * count)[index] * (1 + 0.08 * noise(rng, size, 0.7, (4.0, 0.7)))
    gain = gain * (1 + 0.12 * noise(rng, size, 1.3))
    image = np.broadcast_to(np.asarray(base, np.float32), (size, size, 3))
    return _shade(image, gain * np.where((edge < 0.015) | rivet, 0.45, 1.0))


def foliage(rng: Rng, size: int, dark: Colour, light: Colour) -> Float32:
    """Leaves and grass: strong contrast down to small blades."""
    return _shade(_blend(dark, light, 0.5 + 0.33 * noise(rng, size, 0.7)), 1 + 0.22 * noise(rng, size, 1.2))


def windows(rng: Rng, size: int, wall: Colour, rows: int = 4, columns: int = 4) -> Float32:
    """A facade seen from afar: masonry with framed windows, each lit and curtained differently."""
    image = bricks(rng, size, wall, tuple(0.8 * c for c in wall), rows * 6, columns * 4)
    u, v = _grid(size)
    x, y = u * columns % 1, v * rows % 1
    index = (np.floor(v * rows) * columns + np.floor(u * columns)).astype(int)
    frame = (np.abs(x - 0.5) < 0.3) & (np.abs(y - 0.5) < 0.34)
    pane = (np.abs(np.abs(x - 0.5) - 0.13) < 0.11) & (np.abs(np.abs(y - 0.5) - 0.15) < 0.13)
    glass = rng.uniform([0.08, 0.12, 0.18], [0.45, 0.5, 0.55], (rows * columns, 3))[index]
    glass = glass * (1 + 0.25 * noise(rng, size, 1.3))[..., None]
    image[frame] = 0.85 * (1 + 0.06 * noise(rng, size, 0.7)[frame])[:, None]
    image[pane] = glass[pane]
    return np.clip(image, 0, 1)


class TextureSet:
    """Textures as mip pyramids in one packed buffer; sampling repeats beyond 0..1."""

    def __init__(self) -> None:
        self._texels: list[NDArray[np.uint32]] = []
        self._offsets: list[list[int]] = []
        self._sizes: list[int] = []
        self._names: dict[str, int] = {}
        self._next = 0
        self._packed: tuple[NDArray[np.uint32], NDArray[np.int64], NDArray[np.int64]] | None = None

    def add(self, image: Float32 | UInt8) -> int:
        """Store a square image whose side is a power of two; returns its index.

        Raises:
            FormatError: the image has another shape.
        """
        size = image.shape[0]
        if image.shape != (size, size, 3) or size & (size - 1):
            raise FormatError(f"texture must be a square of 2^n texels with 3 channels, got {image.shape}")
        level = image.astype(np.float32) / (255.0 if image.dtype == np.uint8 else 1.0)
        offsets = []
        while True:
            rgba = np.zeros((*level.shape[:2], 4), np.uint8)
            rgba[..., :3] = np.clip(level * 255 + 0.5, 0, 255)
            self._texels.append(rgba.view(np.uint32).ravel())
            offsets.append(self._next)
            self._next += level.shape[0] ** 2
            if level.shape[0] == 1:
                break
            level = level.reshape(level.shape[0] // 2, 2, -1, 2, 3).mean(axis=(1, 3))
        self._offsets.append(offsets + [offsets[-1]] * (_MAX_LEVELS + 2 - len(offsets)))
        self._sizes.append(size)
        self._packed = None
        return len(self._sizes) - 1

    def named(self, name: str, make: Callable[[], Float32]) -> int:
        """Index of a texture made once under this name."""
        if name not in self._names:
            self._names[name] = self.add(make())
        return self._names[name]

    def sizes(self, index: Sequence[int] | NDArray[np.integer]) -> NDArray[np.int64]:
        """Side lengths in texels."""
        return np.asarray(self._sizes, np.int64)[np.asarray(index)]

    def sample(self, index: NDArray[np.integer], uv: Float32, lod: Float32) -> Float32:
        """Trilinear lookup. index [N], uv [N, 2] in tiles, lod [N] = log2 of texels per pixel -> [N, 3]."""
        if self._packed is None:
            offsets = np.asarray(self._offsets, np.int64)
            self._packed = (np.concatenate(self._texels), offsets, np.asarray(self._sizes, np.int64))
        texels, offsets, sizes = self._packed
        side = sizes[index]
        lod = np.clip(lod, 0, np.log2(side).astype(np.float32))
        low = lod.astype(np.int64)
        t = (lod - low)[:, None]
        uv = (uv - np.floor(uv)).astype(np.float32)
        first = _bilinear(texels, offsets[index, low], np.maximum(side >> low, 1), uv)
        second = _bilinear(texels, offsets[index, low + 1], np.maximum(side >> (low + 1), 1), uv)
        return first * (1 - t) + second * t


def _bilinear(texels: NDArray[np.uint32], offset: NDArray, side: NDArray, uv: Float32) -> Float32:
    xy = uv * side[:, None].astype(np.float32) - 0.5
    corner = np.floor(xy)
    w = xy - corner
    mask = side - 1
    x0, y0 = corner[:, 0].astype(np.int64) & mask, corner[:, 1].astype(np.int64) & mask
    x1, y1 = (x0 + 1) & mask, (y0 + 1) & mask
    wx, wy = w[:, :1], w[:, 1:]
    r0, r1 = offset + y0 * side, offset + y1 * side

    def take(i: NDArray) -> Float32:
        return texels.take(i).view(np.uint8).reshape(-1, 4)[:, :3].astype(np.float32)

    top = take(r0 + x0) * (1 - wx) + take(r0 + x1) * wx
    bottom = take(r1 + x0) * (1 - wx) + take(r1 + x1) * wx
    return (top * (1 - wy) + bottom * wy) * np.float32(1 / 255)
