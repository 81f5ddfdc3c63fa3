"""U2-MVD: depth of a reference image from others, unposed and uncalibrated if need be (paper Sec. V).

    match -> cross check -> start -> [static, parallax, epipole check <-> dense BA] -> sweep, match again -> depth

:meth:`MultiViewDepth.recover` is the loop. Without given poses its unit of length is the median depth; see
:mod:`sf_depth.core.scale` for the way to the global scale.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sf_depth.config import DepthConfig
from sf_depth.core import checks, dense_ba, dense_depth, focal, pinhole, posterior
from sf_depth.core.dense_ba import Estimate, Observations
from sf_depth.core.expectation import expected
from sf_depth.core.matched import Matched, matched, thinned
from sf_depth.core.matching import Matcher, load_matcher, pixel_grid
from sf_depth.core.outliers import lonely
from sf_depth.core.parallel import each, one_blas_thread
from sf_depth.core.scale import from_translations
from sf_depth.core.start import Size, start, triangulate
from sf_interfaces.errors import FormatError, InsufficientParallax
from sf_interfaces.types import Camera, DepthMap, Float32, Float64, Scale, UInt8

_LEAST_CONTRAST = 2.0  # grey levels; below it an image is blank
_CHECK_ROUNDS = 2  # the checks and dense BA improve each other
_NOISY_POSES = 1.5  # given poses that leave so many times the residual of free ones are refined
_LEAST_KEPT = 0.3  # share of the correspondences that given poses have to explain to be kept at all
_LENS = 0.01  # share of the cost that a radial term beside a focal length has to explain; 0.003 without a lens
_SURE = 0.01  # deviation of an unknown focal length; less sure, it and the radial term make up for each other
_LENS_THINNING = 3  # every n-th of the pixels of dense BA tells whether there is a lens
_BENDS = 0.5  # px at a width of 640; a lens that moves the corners of the image by less is none
# Prior deviation of what sources turn by while they are read, and the share of the cost that it has to explain: of a
# camera that reads at once and errs alike all over its image, and of one that reads row by row. On simulated images it
# is 0.01 at most, on photo sets 0.23.
_TURNS = ((0.0007, 0.12), (0.004, 0.25))
_REGISTERED = 60  # strided correspondences a source keeps if it is registered
_BLOCK = 1 << 15  # pixels solved at once: their arrays stay in the cache
CONTRADICTED = "given poses contradict the images: refined, they only give the scale, and the variance tells how well"
_LEAST_DENSITY = 0.01  # share of the reference's pixels that has to be triangulated


@dataclass(frozen=True, slots=True)
class Recovered:
    """What a set of views says about its reference.

    Args:
        depth: depth and variance of the reference, NaN where nothing was triangulated.
        camera: intrinsics, as given or as estimated.
        T_source_reference: [S, 4, 4], in the unit of the depth.
        registered: which sources keep enough correspondences, [S].
        focal_sigma: posterior deviation of the focal length relative to it; 0 where it was given.
        sigma: deviation of a correspondence, px.
        distortion: radial term k1 of the images, 0 unless they show one.
        contradicted: given poses fit the images so badly that they were refined and only give the scale.
        usual: the views hardly tell the focal length, which was drawn to that of usual cameras.
    """

    depth: DepthMap
    camera: Camera
    T_source_reference: Float64
    registered: np.ndarray
    focal_sigma: float
    sigma: float
    distortion: float
    contradicted: bool = False
    usual: bool = False


@dataclass(frozen=True, slots=True)
class _Fit:
    """The optimum of dense BA, the observations that passed the checks, and how sure scale and focal length are."""

    adjusted: posterior.Adjusted
    seen: Observations
    scale_deviation: float = 0.0  # relative
    contradicted: bool = False
    focal_deviation: float | None = None  # relative; None: what the covariance says
    usual: bool = False  # the focal length was drawn to that of usual cameras

    @property
    def unsure(self) -> float:
        """Relative deviation of a free focal length."""
        told = self.focal_deviation
        return dense_depth.focal_deviation(self.adjusted) if told is None else told


class MultiViewDepth:
    """Recovers the depth of one image from others; holds no geometry between calls.

    Args:
        config: see :class:`DepthConfig`.
        matcher: replaces the one the configuration names.
        lens: images without given poses may show a lens, which is then estimated (``Recovered.distortion``); for
            those who take it out, as the camera is a pinhole.
    """

    def __init__(self, config: DepthConfig, matcher: Matcher | None = None, *, lens: bool = False) -> None:
        self._config, self._lens = config, lens
        self._matcher = matcher or load_matcher(config.matcher)

    def recover(
        self,
        reference: UInt8,
        sources: Sequence[UInt8],
        camera: Camera | None = None,
        T_source_reference: Float64 | None = None,
    ) -> Recovered:
        """Depth of ``reference``, and whatever of intrinsics and poses is not given.

        Args:
            reference, sources: images of one size, taken by one camera.
            camera: intrinsics, or None to estimate those that option ``intrinsics`` names.
            T_source_reference: [S, 4, 4]; the depth then has their scale. Needs ``camera``.

        Raises:
            FormatError: fewer than two images, images of different size, or a blank one.
            InsufficientParallax: the views do not constrain depth.
        """
        with one_blas_thread():
            return self._recover(reference, sources, camera, T_source_reference)

    def _recover(
        self, reference: UInt8, sources: Sequence[UInt8], camera: Camera | None, T_source_reference: Float64 | None
    ) -> Recovered:
        check_images([reference, *sources])
        T = None if camera is None else T_source_reference
        size = Size(reference.shape[1], reference.shape[0])
        theta = None if camera is None else pinhole.theta_of(camera)
        free = self._config.intrinsics if camera is None else "none"

        pairs = self._match(reference, sources, coarse=self._config.rematches > 0)
        fit = None if theta is None or T is None else self._with_given_poses(pairs.seen, theta, T, size)
        kept = fit is not None  # whether the given poses are taken as they are
        fit = fit or self._check_and_adjust(pairs.seen, start(pairs.seen, size, theta), size, True, free)
        for _ in range(self._config.rematches):
            guess = expected(reference, sources, fit.adjusted, fit.seen, pairs.grid, _REGISTERED)
            pairs = self._match(reference, sources, guess)
            at = fit.adjusted.estimate
            at = _triangulated(pairs.seen, at.theta, at.T)
            fit = self._check_and_adjust(pairs.seen, at, size, not kept, free)
        if T is None:
            fit = self._with_lens_and_turns(pairs.seen, fit, size, free)
            fit = self._with_usual_focal(pairs.seen, fit, size, free)
        if theta is not None and T is not None:
            fit = self._refine_noisy_poses(pairs.seen, fit, size) if kept else _scaled(fit, T)
        depth = _dense(pairs, fit, size)
        return _recovered(depth, fit, size, camera, Scale.ARBITRARY if T is None else Scale.METRIC)

    def _match(
        self,
        reference: UInt8,
        sources: Sequence[UInt8],
        guess: Sequence[Float32 | None] | None = None,
        coarse: bool = False,
    ) -> Matched:
        """Correspondences to every source that come back to where they started."""
        size = Size(reference.shape[1], reference.shape[0])

        def one(j: int) -> tuple[Float32, Float32]:
            expected = None if guess is None else guess[j]
            found = self._matcher(reference, sources[j], expected, coarse=coarse)
            weight = checks.cross_check(found, size)
            return np.where(weight[..., None] > 0, found.target, np.float32(0)), weight

        found = each(one, range(len(sources)))
        target, weight = (np.stack(part) for part in zip(*found, strict=True))
        return matched(target, weight, self._config.stride, size)

    def _check_and_adjust(
        self, seen: Observations, at: Estimate, size: Size, poses: bool, intrinsics: str, turn: bool = False
    ) -> _Fit:
        """Dense BA over what passes the checks; both run again with the better geometry.

        Raises:
            InsufficientParallax: next to nothing passes.
        """
        for last in (False,) * (_CHECK_ROUNDS - 1) + (True,):
            weight = checks.checked(seen.weight, seen.uv, seen.target, at, size.width)
            if (weight > 0).any(axis=0).sum() < _REGISTERED:
                raise InsufficientParallax(
                    "hardly a pixel of the images can be triangulated: they move too little, or not as one rigid "
                    "scene; give views that are a tenth of the distance to the scene apart"
                )
            good = Observations(seen.uv, seen.target, weight)
            found = dense_ba.optimum(good, at, poses=poses, intrinsics=intrinsics)
            at, cost = found.estimate, found.cost
            for deviation, share in _TURNS if turn and last else ():
                turned = dense_ba.optimum(good, at, poses=poses, intrinsics=intrinsics, turn=deviation)
                found = turned if turned.cost < (1.0 - share) * cost else found
        return _Fit(posterior.with_covariance(good, found, poses, intrinsics), good)

    def _with_lens_and_turns(self, seen: Observations, fit: _Fit, size: Size, free: str) -> _Fit:
        """The fit with what cameras add to a pinhole: a radial term, and turns while their rows are read."""
        at, moved = fit.adjusted.estimate, 0.0
        if self._lens and free == "none":
            free = "lens"
        elif self._lens and free == "f" and (told := self._beside_focal(fit)):
            (at, moved), free = told, "radial"
        fit = self._check_and_adjust(seen, at, size, True, free, True)
        return replace(fit, focal_deviation=float(np.hypot(fit.unsure, moved))) if moved else fit

    def _beside_focal(self, fit: _Fit) -> tuple[Estimate, float] | None:
        """The optimum with a radial term beside an unknown focal length, None unless the views tell both.

        As the two make up for each other, what the term moves the focal length by counts as unsure in that, in the
        share of the cost that it leaves.
        """
        few, at = thinned(fit.seen, fit.adjusted.estimate, _LENS_THINNING)
        straight = dense_ba.optimum(few, at, intrinsics="f")
        found = dense_ba.optimum(few, straight.estimate, intrinsics="radial")
        deviation = dense_depth.focal_deviation(posterior.with_covariance(few, found, True, "radial"))
        if found.cost > (1.0 - _LENS) * straight.cost or deviation > _SURE:
            return None
        moved = np.log(found.estimate.theta[0] / straight.estimate.theta[0]) * found.cost / straight.cost
        return replace(found.estimate, inverse_depth=fit.adjusted.estimate.inverse_depth), float(moved)

    def _with_usual_focal(self, seen: Observations, fit: _Fit, size: Size, free: str) -> _Fit:
        """The fit with the focal length of usual cameras as far as the views do not tell it."""
        if free == "none" or (told := dense_depth.focal_deviation(fit.adjusted)) < focal.UNSURE:
            return fit
        at = fit.adjusted.estimate
        f, deviation = focal.drawn(at.theta[0], told, max(size.width, size.height))
        theta = at.theta * [f / at.theta[0], f / at.theta[0], 1, 1, 1]
        fit = self._check_and_adjust(seen, replace(at, theta=theta), size, True, "none", True)
        return replace(fit, focal_deviation=deviation, usual=True)

    def _with_given_poses(self, seen: Observations, theta: Float64, T: Float64, size: Size) -> _Fit | None:
        """The fit with poses as given; None if they contradict the correspondences, or explain few of them."""
        try:
            fit = self._check_and_adjust(seen, _triangulated(seen, theta, T), size, False, "none")
        except InsufficientParallax:
            return None
        if (fit.seen.weight > 0).sum() < _LEAST_KEPT * (seen.weight > 0).sum():
            return None
        free = self._check_and_adjust(seen, fit.adjusted.estimate, size, True, "none")
        return fit if fit.adjusted.sigma < _NOISY_POSES * free.adjusted.sigma else None

    def _refine_noisy_poses(self, seen: Observations, fit: _Fit, size: Size) -> _Fit:
        """Given poses that fit the images badly are refined and only keep their scale.

        Those that fit a little worse than free ones are kept, and the part of the residual that they explain is as
        unsure in the scale.
        """
        given = fit.adjusted.estimate
        free = self._check_and_adjust(seen, given, size, True, "none")
        scaled = _scaled(free, given.T)
        if fit.adjusted.sigma < _NOISY_POSES * free.adjusted.sigma:
            theirs = max(1.0 - (free.adjusted.sigma / fit.adjusted.sigma) ** 2, 0.0)
            return _Fit(fit.adjusted, fit.seen, scaled.scale_deviation * theirs**0.5)
        return scaled


def _scaled(free: _Fit, T: Float64) -> _Fit:
    """A fit with free poses, at the scale of given ones."""
    scale = from_translations(free.adjusted.estimate.T[:, :3, 3], T[:, :3, 3])
    return _Fit(posterior.rescaled(free.adjusted, scale.factor), free.seen, scale.deviation, contradicted=True)


def check_images(images: Sequence[UInt8]) -> None:
    """Refuse what no depth can come from.

    Raises:
        FormatError: fewer than two images, images of different size, or a blank one.
    """
    if len(images) < 2:
        raise FormatError(f"multi-view depth needs at least 2 images, got {len(images)}")
    sizes = {image.shape[:2] for image in images}
    if len(sizes) > 1:
        named = ", ".join(f"{w}x{h}" for h, w in sorted(sizes))
        raise FormatError(f"the images differ in size ({named}); give images of one camera, all of one size")
    for index, image in enumerate(images):
        if image.std() < _LEAST_CONTRAST:
            raise FormatError(f"image {index} is blank (contrast {image.std():.1f} grey levels); leave it out")


def _triangulated(seen: Observations, theta: Float64, T: Float64) -> Estimate:
    """Known poses and intrinsics with the inverse depths that follow from them."""
    return Estimate(theta, T, triangulate(seen, Estimate(theta, T, np.ones(seen.uv.shape[1]))))


def _dense(pairs: Matched, fit: _Fit, size: Size) -> dense_depth.InverseDepth:
    """Inverse depth [H, W] of every pixel whose correspondences pass the checks."""
    at, still = fit.adjusted.estimate, replace(fit.adjusted.estimate, turn=None)
    sigma = dense_ba.deviation(dense_ba.squared_residuals(fit.seen, at))
    grid = pixel_grid((size.height, size.width)).reshape(-1, 2)
    weight, target = pairs.weight.reshape(len(at.T), -1), pairs.target.reshape(len(at.T), -1, 2)

    def solved(index: np.ndarray) -> dense_depth.InverseDepth:
        uv = np.ascontiguousarray(grid[index].T)
        to = dense_ba.steadied(at, np.ascontiguousarray(target[:, index].transpose(0, 2, 1)))
        trusted = checks.checked(weight[:, index], uv, to, still, size.width)
        return dense_depth.solve(still, uv, to, trusted, sigma, size.width)

    seen = np.flatnonzero(weight.any(axis=0))
    parts = each(solved, np.array_split(seen, max(1, len(seen) // _BLOCK)))
    d, variance, support = (np.full(len(grid), empty, np.float32) for empty in (np.nan, np.nan, 0.0))
    for name, image in (("d", d), ("variance", variance), ("support", support)):
        image[seen] = np.concatenate([getattr(part, name) for part in parts])
    d, variance, support = (image.reshape(size.height, size.width) for image in (d, variance, support))
    common = dense_depth.common_variance(fit.adjusted, fit.seen, pairs.grid, (size.height, size.width))
    return dense_depth.InverseDepth(np.where(lonely(d, variance), np.float32(np.nan), d), variance + common, support)


def registered(seen: Observations) -> np.ndarray:
    """Which sources keep enough correspondences to be placed, [S]."""
    return np.asarray((seen.weight > 0).sum(axis=1) >= _REGISTERED)


def _shown(theta: Float64, size: Size) -> float:
    """The radial term, 0 if it moves the corners of the image by next to nothing."""
    corner = np.hypot(size.width / theta[0], size.height / theta[1]) / 2
    return float(theta[4]) if abs(theta[4]) * corner**3 * theta[0] > _BENDS * size.unit else 0.0


def _recovered(
    solved: dense_depth.InverseDepth, fit: _Fit, size: Size, camera: Camera | None, scale: Scale
) -> Recovered:
    """Depth with variance in the unit of the poses.

    Raises:
        InsufficientParallax: next to no pixel has a depth.
    """
    adjusted = fit.adjusted
    at = adjusted.estimate
    z = 1.0 / solved.d
    density = float(np.isfinite(z).mean())
    if density < _LEAST_DENSITY:
        raise InsufficientParallax(
            f"only {density:.1%} of the pixels can be triangulated; give views with more parallax and more overlap"
        )
    variance = np.where(np.isfinite(z), z**4 * solved.variance + (z * fit.scale_deviation) ** 2, np.nan)
    own = camera or pinhole.camera_of(at.theta, size.width, size.height)
    focal_sigma = 0.0 if camera is not None else fit.unsure
    return Recovered(
        DepthMap(z, variance, scale),
        own,
        at.T,
        registered(fit.seen),
        focal_sigma,
        adjusted.sigma,
        _shown(at.theta, size),
        fit.contradicted,
        fit.usual,
    )
