"""Fills gaps of an image as heat spreads: through what looks alike, hardly across edges (anisotropic diffusion).

Every pixel that is not known becomes the mean of its neighbours, each weighted by the conductance of the link to it.
That is the mean of the known pixels at which a random walk from it first arrives, so the spread of their values tells
how ambiguous a gap is. With slopes the mean follows the planes that bound a gap. Solved from coarse to fine; the
steps of each level are compiled, ``diffusion_reference`` says what they are.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from sf_interfaces.native import kernels
from sf_interfaces.types import Float32, UInt8

CHANNELS = 4  # images that are filled at the same time
_EDGE = 0.008  # difference of Lab colours (0..1) from pixel to pixel at which a link conducts a quarter
_LEAST = 1e-6  # conductance across the hardest edge
_STEPS = 20  # of conjugate gradients at every level
_COARSEST = 4  # px, a side of the coarsest level at least
_SPREAD = 320  # px, the width that is enough for what is smooth
_COLUMNS, _ROWS = (np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])  # the two ends of every link


@dataclass(frozen=True, slots=True)
class Links:
    """Conductance of the links to the next pixel, 0 in the last column and row, [H, W] each."""

    right: Float32
    down: Float32

    @staticmethod
    def of(image: UInt8) -> Links:
        """Links of an RGB or mono image, the weaker the more colours differ; noise is smoothed a little first."""
        lab = cv2.cvtColor(image, cv2.COLOR_RGB2LAB) if image.ndim == 3 else image[..., None]
        lab = cv2.GaussianBlur(lab.astype(np.float32) / np.float32(255.0 * _EDGE), (0, 0), 0.7)
        lab = lab.reshape(*image.shape[:2], -1)
        right, down = np.zeros((2, *image.shape[:2]), np.float32)
        right[:, :-1] = _LEAST + 1.0 / (1.0 + ((lab[:, 1:] - lab[:, :-1]) ** 2).sum(axis=2)) ** 2
        down[:-1] = _LEAST + 1.0 / (1.0 + ((lab[1:] - lab[:-1]) ** 2).sum(axis=2)) ** 2
        return Links(right, down)

    def halved(self) -> Links:
        """Links between blocks of 2 x 2 pixels: two beside each other, each in line with half of those within."""
        return Links(_halved(self.right), _halved(self.down.T).T.copy())


def _halved(right: Float32) -> Float32:
    within, between = right[:, ::2], right[:, 1::2]
    after = np.pad(within[:, 1:], ((0, 0), (0, 1)))
    with np.errstate(divide="ignore"):
        inner = 0.5 / np.where(within > 0, within, between) + 0.5 / np.where(after > 0, after, between)
        lines = 1.0 / (inner + 1.0 / between)
    return np.ascontiguousarray(lines[::2] + lines[1::2])


class Diffusion:
    """Fills gaps of images that go with one picture.

    Args:
        image: RGB [H, W, 3] or mono [H, W].
        known: [H, W] bool, the pixels whose values are taken for granted; at least one.

    Attributes:
        links: those within gaps, from fine to coarse; the sides are multiples of two to the power of the levels.
    """

    def __init__(self, image: UInt8, known: np.ndarray) -> None:
        self._known = known
        steps = max(0, int(np.log2(min(known.shape) / _COARSEST)))
        height, width = (-(-side // 2**steps) * 2**steps for side in known.shape)
        self._pad = ((0, height - known.shape[0]), (0, width - known.shape[1]))
        self._all = Links.of(image)
        gap = ~known
        inner = Links(self._all.right.copy(), self._all.down.copy())
        inner.right[:, :-1] *= gap[:, :-1] & gap[:, 1:]
        inner.down[:-1] *= gap[:-1] & gap[1:]
        self.links = [Links(np.pad(inner.right, self._pad), np.pad(inner.down, self._pad))]
        for _ in range(steps):
            self.links.append(self.links[-1].halved())

    def fill(self, values: Float32, reach: float = np.inf, slope: Float32 | None = None) -> Float32:
        """Images without gaps, [H, W, 4].

        Args:
            values: [H, W, 4]; what they hold in gaps does not matter.
            reach: px, over which values fall to zero.
            slope: [H, W, 2] change per px to the right and down that the first image follows in gaps.
        """
        levels = [self._bordered(values, slope, 1.0 / reach**2)]
        slopes = [None if slope is None else np.pad(slope, (*self._pad, (0, 0)))]
        for _ in self.links[1:]:
            levels.append((_blocks(levels[-1][0]).sum(axis=(1, 3)), _blocks(levels[-1][1]).sum(axis=(1, 3))))
            last = slopes[-1]
            slopes.append(None if last is None else _blocks(last).mean(axis=(1, 3)) * np.float32(2.0))
        out = np.zeros_like(levels[-1][1])
        for links, (ground, inflow), own in zip(self.links[::-1], levels[::-1], slopes[::-1], strict=True):
            if out.shape != inflow.shape:
                out = out.repeat(2, axis=0).repeat(2, axis=1)
            if own is not None:
                _follow(inflow, links, own)
            out = np.asarray(kernels("sf_depth").settle(out, inflow, links.right, links.down, ground, _STEPS))
        out = out[: values.shape[0], : values.shape[1]]
        return np.where(self._known[..., None], values, out)

    def _bordered(self, values: Float32, slope: Float32 | None, screen: float) -> tuple[Float32, Float32]:
        """Conductance [H, W] from gaps to what is known around them, and what flows in from there, [H, W, 4]."""
        known, gap = self._known, ~self._known
        ground = np.where(gap, np.float32(screen), np.float32(0))
        inflow = np.zeros(values.shape, np.float32)
        for axis, (link, first, second) in enumerate(((self._all.right, *_COLUMNS), (self._all.down, *_ROWS))):
            link = link[first]
            for here, there, sign in ((first, second, -1.0), (second, first, 1.0)):
                w = np.where(gap[here] & known[there], link, np.float32(0))
                ground[here] += w
                inflow[here] += np.where(known[there][..., None], w[..., None] * values[there], np.float32(0))
                if slope is not None:
                    step = slope[..., axis]
                    inflow[here][..., 0] += np.float32(0.5 * sign) * w * (step[here] + step[there])
        return np.pad(ground, self._pad), np.pad(inflow, (*self._pad, (0, 0)))


def spread(image: UInt8, values: Float32, known: np.ndarray, reach: float = np.inf) -> Float32:
    """Images without gaps [H, W, 4], smooth ones: diffused at a fraction of the size where that is large.

    Args:
        image, known: as those of :class:`Diffusion`; only every n-th known pixel of every n-th row counts.
        values, reach: as those of :meth:`Diffusion.fill`.
    """
    height, width = known.shape
    n = max(1, width // _SPREAD)
    size, some = (width // n, height // n), tuple(slice(n // 2, side // n * n, n) for side in known.shape)
    small = Diffusion(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.ascontiguousarray(known[some]))
    filled = small.fill(np.ascontiguousarray(values[some]), reach / n)
    return np.asarray(cv2.resize(filled, (width, height), interpolation=cv2.INTER_LINEAR))


def _follow(inflow: Float32, links: Links, slope: Float32) -> None:
    """Add to the first image [H, W, 4] what a slope [H, W, 2] drives through the links."""
    right = links.right[:, :-1] * 0.5 * (slope[:, :-1, 0] + slope[:, 1:, 0])
    down = links.down[:-1] * 0.5 * (slope[:-1, :, 1] + slope[1:, :, 1])
    inflow[:, :-1, 0] -= right
    inflow[:, 1:, 0] += right
    inflow[:-1, :, 0] -= down
    inflow[1:, :, 0] += down


def _blocks(image: np.ndarray) -> np.ndarray:
    """[H, W, ...] as [H / 2, 2, W / 2, 2, ...]."""
    return image.reshape(image.shape[0] // 2, 2, image.shape[1] // 2, 2, *image.shape[2:])
