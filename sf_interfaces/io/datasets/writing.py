"""A data set becomes a bag: one frame at a time, bad frames refused by name or left out and counted."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import islice

from sf_interfaces import topics
from sf_interfaces.errors import ConfigError, FormatError, SceneFactoryError
from sf_interfaces.io.datasets.dataset import LIDAR, MAP, OPTICAL, Dataset, Sample
from sf_interfaces.io.sequence_writer import SequenceWriter
from sf_interfaces.types import PointCloud

COLOR, INFO = "/camera/color/image_raw", "/camera/color/camera_info"
DEPTH, POINTS = "/camera/depth/image_raw", "/lidar/points"
TRUE_POSE = topics.GROUND_TRUTH_PREFIX + "pose"
TRUE_DEPTH = topics.GROUND_TRUTH_PREFIX + "depth/image"
TRUE_POINTS = topics.GROUND_TRUTH_PREFIX + "points"
_SIZE_TOLERANCE = 0.1  # images of one set differ by a few pixels after undistortion, not by more
_KEPT_REASONS = 20

Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """How a data set is read.

    Args:
        skip_bad: leave frames out that cannot be read, and count them.
        use_poses: poses of the data set are an input (/sf/pose) and not only a reference.
        depth_scale: stored depth units in one metre, in place of the layout's.
        limit: read only the first so many good frames.

    Raises:
        ConfigError: a limit below one frame.
    """

    skip_bad: bool = False
    use_poses: bool = False
    depth_scale: float | None = None
    limit: int | None = None

    def __post_init__(self) -> None:
        if self.limit is not None and self.limit < 1:
            raise ConfigError(f"a limit of {self.limit} frames leaves nothing to read; give 1 or more")


@dataclass(slots=True)
class Written:
    """What became of a data set: its goal, frames written, with a pose, and skipped, why (the first ones), notes."""

    dataset: str
    goal: str = "auto"
    frames: int = 0
    posed: int = 0
    skipped: int = 0
    reasons: list[str] = field(default_factory=list)
    notes: tuple[str, ...] = ()

    def sentences(self) -> list[str]:
        """For the user, one line each."""
        lines = [f"{self.dataset}: {note}" for note in self.notes]
        if self.skipped:
            lines.append(f"{self.skipped} bad of {self.skipped + self.frames} frames left out, the first: ")
            lines[-1] += self.reasons[0]
        return lines


class _Sizes:
    """Images of one camera have one size, those of one set nearly one; depth and calibration fit the image."""

    def __init__(self) -> None:
        self._first: Sample | None = None
        self._of_camera: dict[str, tuple[int, ...]] = {}

    def check(self, sample: Sample) -> None:
        """Raise a FormatError that names the image if it does not fit those before."""
        image, size, camera = sample.file, sample.image.shape[:2], sample.camera
        for depth in (sample.depth, sample.reference_depth):
            if depth is not None and depth.z.shape != size:
                raise FormatError(
                    f"depth of image {image} is {_wh(depth.z.shape)}, the image {_wh(size)}; register depth to it first"
                )
        if camera is not None and (camera.height, camera.width) != size:
            raise FormatError(
                f"image {image} is {_wh(size)} but its calibration is for {camera.width}x{camera.height}; "
                "give the images the calibration belongs to"
            )
        first = self._first or sample
        known = size if camera is None else self._of_camera.get(camera.frame_id, size)
        largest = max(abs(a - b) / b for a, b in zip(size, first.image.shape[:2], strict=True))
        if known != size or largest > _SIZE_TOLERANCE:
            raise FormatError(
                f"image {image} is {_wh(size)} but {first.file.name} is {_wh(first.image.shape)}; "
                "put images of other sizes in a folder of their own"
            )
        self._first = first
        if camera is not None:
            self._of_camera[camera.frame_id] = size


def _wh(shape: tuple[int, ...]) -> str:
    return f"{shape[1]}x{shape[0]}"


def write(
    dataset: Dataset, writer: SequenceWriter, options: ReadOptions = ReadOptions(), progress: Progress | None = None
) -> Written:
    """Write a data set into a bag, frame by frame.

    Raises:
        SceneFactoryError: a file is missing or malformed and ``skip_bad`` is off, or no frame is left.
    """
    if options.depth_scale is not None and (dataset.depth_units is None or options.depth_scale <= 0):
        raise ConfigError(f"--depth-scale {options.depth_scale:g}: {dataset.name} has no depth it could scale")
    # With poses given, frames need no order: whatever their poses allow can be made of them.
    goal = "auto" if options.use_poses else dataset.goal
    done = Written(dataset.name, goal, notes=tuple(dataset.notes()))
    if dataset.readout_s:
        writer.shutter(dataset.readout_s)
    sizes = _Sizes()
    total = len(dataset)
    for read in dataset.samples():
        try:
            sample = read()
            sizes.check(sample)
        except SceneFactoryError as error:
            if not options.skip_bad:
                raise FormatError(f"{error} (--skip-bad leaves such frames out)") from error
            done.skipped += 1
            done.reasons += [str(error)] if len(done.reasons) < _KEPT_REASONS else []
            continue
        if not done.frames:
            _write_fixed(writer, dataset, sample.stamp_ns, options.limit)
        _write_sample(writer, sample, dataset.depth_encoding, options.use_poses)
        done.frames += 1
        done.posed += sample.pose is not None
        if progress is not None:
            progress(done.frames + done.skipped, total)
        if done.frames == options.limit:
            break
    if not done.frames:
        why = f": {done.reasons[0]}" if done.reasons else "; copy the data set again"
        raise FormatError(f"no frame of {dataset.path} ({dataset.name}) can be used{why}")
    if options.use_poses and not done.posed:
        raise FormatError(f"--use-poses: {dataset.path} ({dataset.name}) comes without poses; give some with --poses")
    return done


def _write_fixed(writer: SequenceWriter, dataset: Dataset, stamp_ns: int, limit: int | None) -> None:
    for parent, child, T in dataset.extrinsics():
        writer.tf_static(parent, child, T, stamp_ns)
    for part in islice(dataset.points(), limit):
        writer.cloud(TRUE_POINTS, PointCloud(part.points, part.colors, stamp_ns=stamp_ns, frame_id=MAP))


def _write_sample(writer: SequenceWriter, sample: Sample, depth_encoding: str, use_poses: bool) -> None:
    stamp = sample.stamp_ns
    frame = OPTICAL if sample.camera is None else sample.camera.frame_id
    if sample.camera is not None:
        writer.camera_info(INFO, stamp, sample.camera, sample.distortion)
    writer.image(COLOR, stamp, sample.image, frame)
    if sample.depth is not None:
        depth_ns = stamp if sample.depth_ns is None else sample.depth_ns
        writer.depth(DEPTH, depth_ns, sample.depth, frame, depth_encoding)
    if sample.sweep is not None:
        sweep_ns = stamp if sample.sweep_ns is None else sample.sweep_ns
        cloud = PointCloud(sample.sweep[:, :3], stamp_ns=sweep_ns, frame_id=LIDAR)
        writer.cloud(POINTS, cloud, sample.sweep[:, 3])
    if sample.pose is not None:
        for topic in (TRUE_POSE, topics.GIVEN_POSE.name) if use_poses else (TRUE_POSE,):
            writer.pose(topic, stamp, sample.pose, MAP)
    if sample.reference_depth is not None:
        writer.depth(TRUE_DEPTH, stamp, sample.reference_depth, frame, "32FC1")
