"""ScaleCov: Gaussian-process regression of the scale image (paper Sec. ScaleCov).

``s = log(z / base)`` is known where depth is observed. Its mean is an image of planar layers (``layers``), what
that leaves is a Gaussian process with a non-stationary Matern 3/2 kernel (``gaussian_process``), each small tile
conditioned on the observations that say most about it (``conditioning``): the cost is linear in the pixels.
The completed depth is ``base * exp(s_*)``; its variance is calibrated on observations held out (``calibration``).
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch

from sf_depth.config import DepthConfig
from sf_depth.core import gaussian_process as gp
from sf_depth.core.calibration import Calibration, calibrate, held_out
from sf_depth.core.conditioning import Observations, choose, observe
from sf_depth.core.covariance import CovarianceModel, PixelCovariance, make_covariance
from sf_depth.core.layers import at, layer, look, reliability
from sf_depth.core.parallel import each, one_torch_thread
from sf_interfaces.errors import FormatError
from sf_interfaces.types import DepthMap, Float32, UInt8

MIN_OBSERVATIONS = 4  # a plane and one to spare
_CHUNK = 1024  # tiles solved at once; fewer keep the cores waiting for the interpreter
_LAYER_SCALE = 0.15  # difference of log scale over which correlation falls to 0.6
_MIN_AMPLITUDE = 1e-8  # variance of log scale that is left on a perfect plane


def complete(
    base: Float32 | None,
    observed: DepthMap,
    image: UInt8,
    config: DepthConfig,
    covariance: CovarianceModel | None = None,
) -> DepthMap:
    """Depth at every pixel with its variance.

    Args:
        base: monocular depth or another prior [H, W], of any scale, positive everywhere; None: a constant.
        observed: depth with gaps; its variance, where known, is the noise of the observations.
        image: RGB [H, W, 3] or mono [H, W].
        config: see :class:`DepthConfig`.
        covariance: replaces the covariance that the configuration names.

    Returns:
        Observed pixels keep depth and variance (``depth_sigma`` where unknown), the others are regressed.

    Raises:
        FormatError: sizes differ, the base is not positive, or fewer than four pixels are observed.
    """
    _check(base, observed, image)
    measured = observed.valid
    sensor = np.full_like(observed.z, config.depth_sigma**2) if observed.variance is None else observed.variance
    if measured.all():
        return DepthMap(observed.z, sensor, observed.scale)
    base = np.ones_like(observed.z) if base is None else np.asarray(base, np.float32)
    with one_torch_thread():  # tiles are spread over the cores, not their sums
        regression = _Regression.of(base, observed.z, sensor, measured, image, config, covariance)
        log_scale, variance = regression.image(measured)
    z = np.where(measured, observed.z, base * np.exp(log_scale))
    best = sensor[measured].min()  # what the sensor gets wrong everywhere, no regression can see
    variance = np.maximum(z * z * variance, best) + config.registration_sigma**2 * _steepness(z)
    variance = np.where(measured, sensor, variance)
    if config.max_sigma > 0:
        unsure = variance > config.max_sigma**2
        z, variance = np.where(unsure, np.nan, z), np.where(unsure, np.nan, variance)
    return DepthMap(z, variance, observed.scale)


def _steepness(z: Float32) -> Float32:
    """Squared change of depth per px, [H, W] m^2: what it costs that depth lies beside where the image shows it."""
    down, right = np.gradient(z)
    return np.asarray(down * down + right * right)


def _check(base: Float32 | None, observed: DepthMap, image: UInt8) -> None:
    if observed.z.shape != image.shape[:2]:
        raise FormatError(f"depth {observed.z.shape} and image {image.shape[:2]} differ in size")
    if base is not None and base.shape != observed.z.shape:
        raise FormatError(f"base {base.shape} and depth {observed.z.shape} differ in size")
    if base is not None and not (np.isfinite(base).all() and (base > 0).all()):
        raise FormatError("the base of depth completion must be positive at every pixel; fill its gaps first")
    count = int(observed.valid.sum())
    if count < MIN_OBSERVATIONS:
        raise FormatError(
            f"{count} measured pixels, completion needs {MIN_OBSERVATIONS}; "
            "check that the depth sensor sees what the camera sees"
        )


def _colors(image: UInt8, scale: float) -> torch.Tensor:
    """Perceptual colours [H, W, C] in units of ``scale``, smoothed a little so that noise is no edge."""
    lab = cv2.cvtColor(image, cv2.COLOR_RGB2LAB) if image.ndim == 3 else image[..., None]
    smooth = cv2.GaussianBlur(lab.astype(np.float32) / (255.0 * scale), (0, 0), 0.7)
    return torch.from_numpy(smooth.reshape(*image.shape[:2], -1))


@dataclass(frozen=True, slots=True)
class _Regression:
    """One image's observations, colours and covariance."""

    observed: Observations
    color: torch.Tensor  # [H, W, C]
    weight: torch.Tensor  # [N] reliability of the observations
    residual: torch.Tensor  # [N] log(z / base) less the mean
    covariance: PixelCovariance
    typical: float
    apart: float  # px, up to 1, that depth may lie beside where the image shows it
    config: DepthConfig

    @staticmethod
    def of(
        base: Float32,
        z: Float32,
        variance: Float32,
        measured: np.ndarray,
        image: UInt8,
        config: DepthConfig,
        covariance: CovarianceModel | None,
    ) -> _Regression:
        """Prepare one image: ratio base / z of every observation, its plane, its weight, what its layer leaves."""
        known = np.where(measured, z, 1.0)
        observed = observe(np.where(measured, base / known, 0.0), variance / known**2, measured)
        color = _colors(image, config.color_scale)
        apart = min(config.registration_sigma, 1.0)
        weight, ratio = reliability(observed, color, apart)
        residual = torch.log(ratio / observed.ratio)
        spacing = float(observed.spacing[: observed.densest].median())
        model = covariance or make_covariance(config)
        length = config.length_scale * spacing
        typical = max(float((residual[: observed.densest] ** 2).median()), _MIN_AMPLITUDE)
        return _Regression(observed, color, weight, residual, model(image, length), typical, apart, config)

    def image(self, measured: np.ndarray) -> tuple[Float32, Float32]:
        """log(z / base) and its calibrated variance wherever a pixel is missing, [H, W] each."""
        (height, width), size = measured.shape, self.config.tile
        rows, cols = -(-height // size), -(-width // size)
        padded = np.ones((rows * size, cols * size), dtype=bool)
        padded[:height, :width] = measured
        corner = size * np.argwhere(~padded.reshape(rows, size, cols, size).all(axis=(1, 3)))
        inside = np.indices((size, size)).reshape(2, -1).T
        calibration = self._calibrated(measured)
        mean, variance = np.zeros((2, height, width), dtype=np.float32)

        def solve(start: int) -> None:
            part = corner[start : start + _CHUNK]
            ids = choose(self.observed, part + 0.5 * (size - 1), self.config.neighbours)
            pixel = np.minimum(part[:, None] + inside, (height - 1, width - 1))
            x = torch.from_numpy(pixel[..., ::-1].astype(np.float32))
            row, col = pixel[..., 0], pixel[..., 1]
            mean[row, col], raw = self._regress(ids, x)
            variance[row, col] = calibration(raw)

        each(solve, range(0, len(corner), _CHUNK))
        return mean, variance

    def _regress(self, ids: torch.Tensor, x: torch.Tensor) -> tuple[Float32, Float32]:
        """log(z / base) of pixels [B, M, 2] given observations [B, K], and its variance before calibration."""
        seen = look(self.observed, ids, x, self.color)
        layers = layer(seen, self.weight, self.observed.spacing, self.apart)
        log_mean = -torch.log(layers.ratio)
        center = x.mean(dim=1, keepdim=True)
        near, ratio = self.observed.x[ids], self.observed.ratio[ids]
        n = self._points(near, center, -torch.log(ratio))
        noise = self.config.nugget + self.observed.noise[ids] / self.typical
        tiles = gp.condition(n, self.residual[ids], noise)
        s, unit = gp.predict(tiles, self._points(x, center, log_mean))
        variance = unit * tiles.amplitude(self.typical)[:, None] + layers.spread
        return (log_mean + s).numpy(), variance.numpy()

    def _points(self, x: torch.Tensor, center: torch.Tensor, log_scale: torch.Tensor) -> gp.Points:
        """Pixels [B, N, 2] as the kernel sees them: the layer they lie on is one more feature."""
        pixels = self.covariance
        feature = torch.cat([at(pixels.feature, x), log_scale[..., None] / _LAYER_SCALE], dim=2)
        return gp.Points(x - center, at(pixels.shape, x), feature)

    def _calibrated(self, measured: np.ndarray) -> Calibration:
        """Compare held-out observations, as far from the others as missing pixels are, with their regression."""
        center, truth, distance = held_out(self.observed, measured, self.config.seed)
        ids = choose(self.observed, center, self.config.neighbours, excluded=distance)
        x = torch.from_numpy(center[:, None, ::-1].astype(np.float32))
        mean, variance = self._regress(ids, x)
        return calibrate(np.abs(mean[:, 0] - truth), variance[:, 0])
