"""Depth and pose of every image of an unordered set (the one-shot goal ``mvd``).

Each image in turn is the reference of U2-MVD with the images it overlaps best. The first one, which overlaps
most, fixes the intrinsics, the map frame and the unit; the others join at the scale of the poses known by then.
A lens that it shows is taken out of all images, since a camera here is a pinhole.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np

from sf_depth.config import DepthConfig
from sf_depth.core import focal, products
from sf_depth.core.filling import Filler
from sf_depth.core.matching import grey
from sf_depth.core.mvd import CONTRADICTED, MultiViewDepth, Recovered, check_images
from sf_depth.core.parallel import one_blas_thread
from sf_depth.core.scale import GlobalScale, from_translations, in_unit
from sf_depth.core.seeds import Features, detect, match_features
from sf_interfaces.errors import FormatError, InsufficientParallax
from sf_interfaces.geometry import se3
from sf_interfaces.geometry.undistort import Distortion, undistort_image
from sf_interfaces.types import Camera, DepthMap, Float64, Frame, Keyframe, Scale, Trajectory, UInt8

_ENOUGH_MOTION = 0.05  # image widths; matched views that differ less are worth less
_ROOT_SOURCES = 7  # views the first reference is triangulated with at most: they fix the intrinsics
_LEAST_OVERLAP = 5.0  # weighted matches of two images that are worth a try


@dataclass(slots=True)
class PhotoSet:
    """What a set of images became.

    Args:
        observed: keyframes with triangulated depth and variance, by stamp.
        keyframes: the same with completed depth.
        trajectory: T_map_camera of all registered images.
        camera: intrinsics of the (full-size) images.
        recovered: what the first reference gave, with the certainty of the intrinsics.
        reasons: why images were left out, rectified, or their poses refined.
    """

    observed: list[Keyframe]
    keyframes: list[Keyframe]
    trajectory: Trajectory
    camera: Camera
    recovered: Recovered
    reasons: dict[str, int] = field(default_factory=dict)

    def save_products(self, folder: Path) -> None:
        """Write poses, a coloured cloud and a contact sheet."""
        products.save(folder, self.trajectory, self.observed, self.keyframes)


class PhotoSetDepth:
    """Mode ``mvd``: a set of images without order, with or without intrinsics and poses."""

    def __init__(self, config: DepthConfig) -> None:
        self._config = config
        self._mvd, self._rectified = (MultiViewDepth(config, lens=lens) for lens in (config.lens, False))
        self._filler = Filler(config)

    def estimate(self, frames: Sequence[Frame], heard: Callable[[int], None] = lambda done: None) -> PhotoSet:
        """Depth, pose and, where missing, intrinsics of all images that can be registered.

        Args:
            heard: told after every reference how many are done.

        Raises:
            FormatError: fewer than two images, or images that do not fit together.
            InsufficientParallax: no image has depth.
        """
        with one_blas_thread():
            return self._estimate(frames, heard)

    def _estimate(self, frames: Sequence[Frame], heard: Callable[[int], None]) -> PhotoSet:
        images = [frame.image for frame in frames if frame.image is not None]
        if len(images) < len(frames):
            raise FormatError("multi-view depth needs colour images; the input has frames without one")
        check_images(images)
        small = _reduced(images, self._config.max_side)
        full = frames[0].camera
        camera = None if full is None else _resized(full, small[0])
        given = [frame.T_map_camera for frame in frames]
        posed = camera is not None and all(T is not None for T in given)
        work = _Work(self, frames, small, _overlaps(small), camera, full, given if posed else None)
        work.run(heard)
        return work.product()

    def recover(
        self,
        images: list[UInt8],
        reference: int,
        sources: list[int],
        camera: Camera | None,
        T: Float64 | None,
        lens: bool = False,
    ) -> Recovered:
        """One reference with its sources; ``lens``: the images may show one."""
        mvd = self._mvd if lens else self._rectified
        return mvd.recover(images[reference], [images[j] for j in sources], camera, T)

    def complete(self, keyframe: Keyframe) -> Keyframe:
        """Fill the pixels that were not triangulated."""
        return self._filler.fill(keyframe)

    @property
    def max_sources(self) -> int:
        """Views a reference is triangulated with at most."""
        return self._config.max_sources


def _reduced(images: list[UInt8], side: int) -> list[UInt8]:
    """Images whose longer side is at most ``side`` px."""
    factor = min(1.0, side / max(images[0].shape[:2]))
    if factor == 1.0:
        return images
    return [np.asarray(cv2.resize(i, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)) for i in images]


def _resized(camera: Camera, image: UInt8) -> Camera:
    """The camera of the same image at another size."""
    height, width = image.shape[:2]
    sx, sy = width / camera.width, height / camera.height
    return replace(
        camera,
        width=width,
        height=height,
        fx=camera.fx * sx,
        fy=camera.fy * sy,
        cx=camera.cx * sx,
        cy=camera.cy * sy,
    )


def _overlaps(images: list[UInt8]) -> Float64:
    """How well two images triangulate each other, [N, N]: verified matches, fewer where they hardly move."""
    features: list[Features] = [detect(grey(image)) for image in images]
    out = np.zeros((len(images), len(images)))
    for i in range(len(images)):
        for j in range(i):
            matches = match_features(features[i], features[j])
            if len(matches):
                motion = float(np.median(np.linalg.norm(matches.second - matches.first, axis=1)))
                share = min(1.0, motion / (_ENOUGH_MOTION * images[0].shape[1]))
                out[i, j] = out[j, i] = len(matches) * share
    return out


class _Work:
    """The growing map of one set of images."""

    def __init__(
        self,
        parts: PhotoSetDepth,
        frames: Sequence[Frame],
        images: list[UInt8],
        overlap: Float64,
        camera: Camera | None,
        full: Camera | None,
        given: list[Float64 | None] | None,
    ) -> None:
        self._parts, self._frames, self._images, self._overlap = parts, frames, images, overlap
        self._camera, self._full, self._given = camera, full, given
        self._poses: dict[int, Float64] = {}
        self._depth: dict[int, DepthMap] = {}
        self._first: Recovered | None = None
        self._reasons: dict[str, int] = {}

    def run(self, heard: Callable[[int], None]) -> None:
        """Every image that can be placed is a reference once, the best connected next.

        Raises:
            InsufficientParallax: no image can be the first reference.
        """
        waiting = sorted(range(len(self._images)), key=lambda i: -self._overlap[i].sum())
        if self._given is not None:
            self._poses = {i: T for i, T in enumerate(self._given) if T is not None}
        failure: InsufficientParallax | None = None
        while waiting:
            ready = [i for i in waiting if not self._poses or i in self._poses]
            if not ready:
                break
            # Images that place others come first: unplaced images they overlap count more than all the rest.
            unplaced = [j for j in waiting if j not in self._poses]
            reference = max(ready, key=lambda i: (self._overlap[i][unplaced].sum(), self._overlap[i].sum()))
            waiting.remove(reference)
            try:
                self._grow(reference)
            except InsufficientParallax as error:
                failure = error
                self._count(f"image {reference} has no depth: {error}")
            heard(len(self._images) - len(waiting))
        for i in waiting:
            self._count(f"image {i} left out: it overlaps with no image that could be placed")
        if self._first is None:
            raise failure or InsufficientParallax("the images do not overlap; give views of the same scene")

    def _grow(self, reference: int) -> None:
        """Depth of one reference, and poses of the sources that had none."""
        first = self._first is None
        limit = max(self._parts.max_sources, _ROOT_SOURCES) if first else self._parts.max_sources
        sources = self._sources(reference, limit)
        if not sources:
            raise InsufficientParallax("it overlaps with no other image")
        T = None
        if self._given is not None:
            T = np.stack([se3.inverse(self._poses[j]) @ self._poses[reference] for j in sources])
        got = self._parts.recover(self._images, reference, sources, self._camera, T, lens=first)
        if first and got.distortion:
            self._rectify(got)
            again = self._parts.recover(self._images, reference, sources, got.camera, T)
            got = replace(again, focal_sigma=got.focal_sigma, distortion=got.distortion, usual=got.usual)
        if got.contradicted:
            self._count(CONTRADICTED)
        if got.usual:
            self._count(focal.USUAL)
        scale = GlobalScale(1.0, 0.0)
        if first:
            self._first, self._camera = got, got.camera
            self._poses.setdefault(reference, np.eye(4))
        elif self._given is None:
            scale = self._scale(reference, sources, got)
        for k, j in enumerate(sources):
            if j not in self._poses and got.registered[k]:
                step = got.T_source_reference[k].copy()
                step[:3, 3] *= scale.factor
                self._poses[j] = self._poses[reference] @ se3.inverse(step)
        self._depth[reference] = in_unit(got.depth, scale)

    def _rectify(self, got: Recovered) -> None:
        """Take the lens that the first reference shows out of all images."""
        lens = Distortion("plumb_bob", (got.distortion, 0.0, 0.0, 0.0, 0.0))
        self._images = [undistort_image(image, got.camera, lens) for image in self._images]
        frames = []
        for frame in self._frames:
            assert frame.image is not None
            camera = self._full or _resized(got.camera, frame.image)
            frames.append(replace(frame, image=undistort_image(frame.image, camera, lens)))
        self._frames = frames
        self._count(f"the images show a lens, radial term {got.distortion:.3f}: rectified")

    def _sources(self, reference: int, limit: int) -> list[int]:
        """The images that overlap best; at least two of them placed already, so that the scale is known."""
        order = [int(j) for j in np.argsort(-self._overlap[reference], kind="stable")]
        order = [j for j in order if self._overlap[reference, j] > _LEAST_OVERLAP]
        anchors = [j for j in order if j in self._poses][:2]
        return anchors + [j for j in order if j not in anchors][: max(limit - len(anchors), 0)]

    def _scale(self, reference: int, sources: list[int], got: Recovered) -> GlobalScale:
        known = [k for k, j in enumerate(sources) if j in self._poses and got.registered[k]]
        true = [(se3.inverse(self._poses[sources[k]]) @ self._poses[reference])[:3, 3] for k in known]
        return from_translations(got.T_source_reference[known, :3, 3], np.array(true).reshape(-1, 3))

    def product(self) -> PhotoSet:
        """Everything, at the size of the images given."""
        assert self._first is not None and self._camera is not None
        image = self._frames[0].image
        assert image is not None
        camera = self._full or _resized(self._camera, image)
        observed = [self._keyframe(i, camera, self._depth[i]) for i in sorted(self._depth)]
        scale = Scale.METRIC if self._given is not None else Scale.ARBITRARY
        stamps = [(self._frames[i].stamp_ns, T) for i, T in self._poses.items()]
        completed = [self._completed(i, camera) for i in sorted(self._depth)]
        trajectory = Trajectory.from_pairs(stamps, scale)
        return PhotoSet(observed, completed, trajectory, camera, self._first, self._reasons)

    def _completed(self, index: int, camera: Camera) -> Keyframe:
        small = Keyframe(
            self._frames[index].stamp_ns,
            _resized(camera, self._images[index]),
            self._images[index],
            self._poses[index],
            self._depth[index],
        )
        depth = self._parts.complete(small).depth
        assert depth is not None
        return self._keyframe(index, camera, depth)

    def _keyframe(self, index: int, camera: Camera, depth: DepthMap) -> Keyframe:
        frame = self._frames[index]
        assert frame.image is not None
        size = (camera.width, camera.height)
        if depth.z.shape != (camera.height, camera.width):
            z, variance = (cv2.resize(a, size, interpolation=cv2.INTER_NEAREST) for a in (depth.z, depth.variance))
            depth = DepthMap(z, variance, depth.scale)
        return Keyframe(frame.stamp_ns, camera, frame.image, self._poses[index], depth)

    def _count(self, reason: str) -> None:
        self._reasons[reason] = self._reasons.get(reason, 0) + 1
