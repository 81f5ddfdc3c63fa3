"""Dense correspondences between two images (paper Sec. Depth Recovery with Dense Correlation).

The default needs no training: robust sparse matches seed a dense flow, so that wide baselines, rotation and
change of scale work; dense inverse search then refines it in both directions. Learned matchers register under
the entry-point group ``scenefactory.matchers``.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import threading
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from typing import Protocol

import cv2
import numpy as np

from sf_depth.core.seeds import Features, detect, match_features, seed_flow
from sf_interfaces.errors import ConfigError
from sf_interfaces.types import Float32, UInt8

MATCHERS_GROUP = "scenefactory.matchers"
_TEXTURE = 2.0  # grey levels per px; where the image varies less, flow is a guess of its neighbourhood
_WINDOW = 7  # px; side of the windows that are compared


@dataclass(frozen=True, slots=True)
class Correspondence:
    """Where every reference pixel lies in the source image.

    Args:
        target: continuous source pixels [H, W, 2]; NaN where nothing was found. A coarse match is half the size,
            but its pixels are those of the full images.
        back: where the target itself is matched to in the reference [H, W, 2] px (``x* + l_ji`` of the cross check).
        confidence: 0..1 [H, W].
    """

    target: Float32
    back: Float32
    confidence: Float32


class Matcher(Protocol):
    """Anything that relates two images densely, learned or not."""

    name: str

    def __call__(
        self, reference: UInt8, source: UInt8, guess: Float32 | None = None, *, coarse: bool = False
    ) -> Correspondence:
        """Match two RGB or mono images of one size; called for several sources at a time.

        Args:
            guess: expected target pixels [H, W, 2], from a geometry that is known by now; a matcher may ignore it.
            coarse: half the resolution suffices; a matcher may ignore it.
        """
        ...


def load_matcher(name: str) -> Matcher:
    """The matcher of a name: ``flow`` is built in, others are installed packages.

    Raises:
        ConfigError: no installed package provides it.
    """
    if name == FlowMatcher.name:
        return FlowMatcher()
    points = {point.name: point for point in entry_points(group=MATCHERS_GROUP)}
    if name not in points:
        known = ", ".join([FlowMatcher.name, *sorted(points)])
        raise ConfigError(f"no matcher '{name}' is installed; choose one of {known}, or install its package")
    made: Matcher = points[name].load()()
    return made


@dataclass(slots=True)
class _Detected:
    """Features of one image, found by whoever needs them first."""

    image: UInt8
    features: Features | None = None
    lock: threading.Lock = field(default_factory=threading.Lock)


class FlowMatcher:
    """Training-free: sparse matches seed a warp of the source, dense inverse search refines it."""

    name = "flow"

    def __init__(self) -> None:
        self._detected: dict[int, _Detected] = {}
        self._lock = threading.Lock()

    def __call__(
        self, reference: UInt8, source: UInt8, guess: Float32 | None = None, *, coarse: bool = False
    ) -> Correspondence:
        """Match by a warp of the source onto the reference, so that both directions share one frame."""
        first, second = grey(reference), grey(source)
        if guess is None:
            guess = seed_flow(first.shape, match_features(self._detect(reference, first), self._detect(source, second)))
        if not coarse:
            return _refined(first, second, guess, fine=True)
        half = _halved(first.shape)
        scale = np.array([first.shape[1] / half[1], first.shape[0] / half[0]], np.float32)
        small = [cv2.resize(image, half[::-1], interpolation=cv2.INTER_AREA) for image in (first, second)]
        if guess is not None:
            guess = cv2.resize(guess, half[::-1], interpolation=cv2.INTER_LINEAR) / scale
        found = _refined(small[0], small[1], guess, fine=False)
        return Correspondence(found.target * scale, found.back * scale, found.confidence)

    def _detect(self, image: UInt8, grey: UInt8) -> Features:
        """Features of an image; the reference comes again with every source."""
        with self._lock:
            known = self._detected.get(id(image))
            if known is None or known.image is not image:
                known = _Detected(image)
            self._detected = {**dict(list(self._detected.items())[-15:]), id(image): known}
        with known.lock:
            known.features = known.features or detect(grey)
            return known.features


def _halved(shape: tuple[int, ...]) -> tuple[int, int]:
    return (shape[0] + 1) // 2, (shape[1] + 1) // 2


def _refined(first: UInt8, second: UInt8, guess: Float32 | None, fine: bool) -> Correspondence:
    """Dense correspondences of two grey images from where they are expected (None: in the same place)."""
    grid = pixel_grid(first.shape)
    guess = grid if guess is None else guess
    warped = sample(second, guess)
    forward, backward = flow(first, warped, fine), flow(warped, first, fine)
    inside = grid + forward  # in the warped source
    target = sample(guess, inside)
    back = inside + sample(backward, inside)
    confidence = _similarity(first, sample(second, target)) * _texture(first)
    height, width = first.shape
    outside = (target < 0).any(axis=2) | (target[..., 0] > width) | (target[..., 1] > height)
    target[outside] = np.nan
    confidence[outside | np.isnan(confidence)] = 0.0
    return Correspondence(target, back, confidence)


def pixel_grid(shape: tuple[int, ...]) -> Float32:
    """Continuous coordinates of all pixel centres, [H, W, 2]."""
    height, width = shape[:2]
    u, v = np.meshgrid(np.arange(width, dtype=np.float32) + 0.5, np.arange(height, dtype=np.float32) + 0.5)
    return np.stack([u, v], axis=-1)


def sample(image: np.ndarray, at: Float32) -> np.ndarray:
    """Bilinear values of an image [H, W(, C)] at continuous pixels [..., 2]; the border is repeated."""
    x, y = np.ascontiguousarray(at[..., 0]) - np.float32(0.5), np.ascontiguousarray(at[..., 1]) - np.float32(0.5)
    return np.asarray(cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def grey(image: UInt8) -> UInt8:
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


def flow(first: UInt8, second: UInt8, fine: bool = False) -> Float32:
    """Displacement [H, W, 2] px from the first image to the second; ``fine``: down to the full resolution."""
    search = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    if fine:  # the preset ends at half of it; fewer steps a patch suffice there
        search.setFinestScale(0)
        search.setPatchStride(5)
        search.setGradientDescentIterations(8)
        search.setVariationalRefinementIterations(2)
    return np.asarray(search.calc(first, second, None), dtype=np.float32)


def _similarity(first: UInt8, second: UInt8) -> Float32:
    """Normalised cross-correlation of windows, cut to 0..1, [H, W]."""
    a, b = first.astype(np.float32), second.astype(np.float32)
    size = (_WINDOW, _WINDOW)
    ma, mb = cv2.blur(a, size), cv2.blur(b, size)
    va, vb = cv2.blur(a * a, size) - ma * ma, cv2.blur(b * b, size) - mb * mb
    covariance = cv2.blur(a * b, size) - ma * mb
    return np.asarray(np.clip(covariance / np.sqrt((va + 1.0) * (vb + 1.0)).clip(1.0), 0, 1), dtype=np.float32)


def _texture(grey: UInt8) -> Float32:
    """How much there is to match, 0..1 [H, W]."""
    gx, gy = cv2.Sobel(grey, cv2.CV_32F, 1, 0, scale=0.125), cv2.Sobel(grey, cv2.CV_32F, 0, 1, scale=0.125)
    energy = cv2.blur(gx * gx + gy * gy, (_WINDOW, _WINDOW))
    return np.asarray(energy / (energy + _TEXTURE**2), dtype=np.float32)
