"""The production line in one process: the paper's ``EstablishProductLine`` and ``Step`` (Algorithm 1).

The ROS graph runs the same cores on the same data; on a lossless replay both give the same result.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from sf_bringup.planner import Plan
from sf_bringup.preflight import BagInput
from sf_bringup.progress import Progress
from sf_bringup.result_writer import ResultWriter
from sf_bringup.run_folder import RunFolder
from sf_bringup.wiring import sync_values
from sf_interfaces.blocks import BlockSpec, Quantity, load_blocks
from sf_interfaces.config import ConfigFile, build
from sf_interfaces.corrections import Correction, Corrections
from sf_interfaces.errors import ConfigError, FormatError, TrackingLost
from sf_interfaces.io.bag import BagReader
from sf_interfaces.io.sequence_writer import SequenceWriter
from sf_interfaces.io.trajectory import write_tum
from sf_interfaces.ros.sensors import SensorInputs
from sf_interfaces.sync import SyncConfig
from sf_interfaces.timing import Timings
from sf_interfaces.types import Float64, Frame, Keyframe, Trajectory

PARTS_GROUP = "scenefactory.parts"
IMAGE_SET = "depth:mvd"  # the one-shot goal: all images at once


def make_part(block_id: str, config: ConfigFile) -> Any:
    """The core of an installed block mode, built from its section of the configuration.

    Raises:
        ConfigError: the block is not installed, or its section is wrong.
    """
    for point in entry_points(group=PARTS_GROUP):
        if point.name == block_id:
            return point.load()(config)
    raise ConfigError(f"no installed package provides a runnable '{block_id}'; see 'sf blocks'")


def load_map(path: Path) -> Any:
    """The reconstruction saved in an ``.sfmap`` file, ready to render."""
    return make_part("recon", ConfigFile({})).load(path)


class ProductionLine:
    """Parts in the order of the plan; each maps what it gets to what it completes."""

    def __init__(self, blocks: Sequence[str], config: ConfigFile, writer: ResultWriter, *, posed: bool) -> None:
        parts = {block: make_part(block, config) for block in blocks}
        owner = {quantity: s.id for s in load_blocks() if s.id in parts for quantity in s.provides}
        self._flexion = parts.get(owner.get(Quantity.IMAGE, ""))
        self._tracker_id = owner.get(Quantity.POSE, "")
        self.tracker = parts.get(self._tracker_id)
        self._depth = parts.get(owner.get(Quantity.DEPTH, ""))
        self._posed_depth = "depth:posed" in blocks
        self.reconstruction = parts.get("recon")
        self._writer, self._config, self._epoch = writer, config, 0
        self.timings = Timings()
        writer.posed = self.tracker is not None or posed
        self.keyframe_poses: dict[int, Float64] = {}
        self.completed = 0  # keyframes that got dense depth
        self._corrections = Corrections()

    def in_epoch(self, epoch: int) -> None:
        """A backward jump of time ends one sequence and begins another: the tracker starts anew."""
        if self.tracker is not None and epoch != self._epoch:
            self._finish_keyframes(self.tracker.finish())
            self.tracker = make_part(self._tracker_id, self._config)
        if self._depth is not None and epoch != self._epoch:
            self._completed(self._depth.finish())
        self._epoch = epoch

    def step(self, frame: Frame) -> Float64 | None:
        """Take one frame through the line; everything it completes goes to the writer.

        Returns:
            The metric pose just tracked, from which the motion during the next sweep is predicted.
        """
        if self._flexion is not None and frame.image is None:
            image = self._flexion(frame.depth, frame.camera)
            self._writer.flexion(frame, image)
            frame = replace(frame, image=image)
        if self.tracker is not None:
            with self.timings.measure("tracking"):
                update = self.tracker.track(frame)
            self._writer.tracked(frame, update)
            self._finish_keyframes(update)
            return update.T_odom_camera
        if frame.image is not None and frame.camera is not None:
            keyframe = Keyframe.of(frame)
            if not self._posed_depth:
                self._writer.keyframe(keyframe)
            self._complete(keyframe)
        return None

    def finish(self) -> None:
        """End of the input: the tracker's window becomes final, the colour field gets its last sweeps."""
        if self.tracker is not None:
            self._finish_keyframes(self.tracker.finish())
        if self._depth is not None:
            self._completed(self._depth.finish())
        if self.reconstruction is not None:
            self._correct(self._corrections.due())
            self.reconstruction.finish()

    def _finish_keyframes(self, update: Any) -> None:
        """Take final keyframes on, and the correction that comes with the last."""
        for keyframe, correction in update.corrected_keyframes():
            self.keyframe_poses[keyframe.stamp_ns] = keyframe.T_map_camera
            if correction is not None:
                self.keyframe_poses |= dict(zip((k := correction.keyframes).stamps_ns.tolist(), k.poses, strict=True))
                self._corrections.push(keyframe.stamp_ns, correction)
            self._writer.keyframe(keyframe, correction)
            self._complete(keyframe)

    @property
    def lacks_depth(self) -> bool:
        """Whether depth was all that this line had to complete, and none came of it."""
        return self._depth is not None and self.tracker is None and not self.completed

    @property
    def reasons(self) -> dict[str, int]:
        """Why keyframes got no depth, with counts."""
        return {} if self._depth is None else dict(self._depth.reasons)

    def _complete(self, keyframe: Keyframe) -> None:
        if self._depth is None:
            self._reconstruct(keyframe)
            return
        with self.timings.measure("depth"):
            dense = self._depth.add(keyframe)
        self._completed(dense)

    def _completed(self, keyframes: Sequence[Keyframe]) -> None:
        """Keyframes that have dense depth now; multi-view depth gives it some frames after they came."""
        for keyframe in keyframes:
            if self._posed_depth:
                self._writer.keyframe(replace(keyframe, depth=None))
            self._writer.dense(keyframe)
            self.completed += 1
            self._reconstruct(keyframe)

    def _reconstruct(self, keyframe: Keyframe) -> None:
        if self.reconstruction is not None:
            self._correct(self._corrections.due(keyframe.stamp_ns))
            with self.timings.measure("recon"):
                added = self.reconstruction.add(keyframe)
            self._writer.surface(keyframe.stamp_ns, added)

    def _correct(self, correction: Correction | None) -> None:
        if correction is not None:
            with self.timings.measure("correction"):
                self.reconstruction.correct(correction)


def run_inproc(folder: RunFolder, given: BagInput, made: Plan, config: ConfigFile, rate: float) -> dict[str, int]:
    """Take a bag through the line in this process and record the same topics the graph would.

    Args:
        rate: only the graph plays live; must be 0 here.

    Returns:
        Why input was dropped, with counts.

    Raises:
        ConfigError: a rate was given.
    """
    if rate:
        raise ConfigError("--rate plays live through the graph; add --engine ros")
    if made.ids == (IMAGE_SET,):
        return _run_image_set(folder, given, made, config)
    inputs = _inputs(given, made, config)
    with (
        BagReader(given.bag) as reader,
        ResultWriter(SequenceWriter(folder.result)) as writer,
        Progress("running", "frames") as progress,
    ):
        line = ProductionLine(made.ids, config, writer, posed=Quantity.POSE in made.available)
        done = 0
        for message in _messages(reader, given):
            inputs.push(*message)
            done += _advance(line, inputs)
            progress.update(done, given.leading_messages)
        inputs.assembler.end()
        done += _advance(line, inputs)
        if not done:
            raise _unused(given, inputs)
        line.finish()
        if line.lacks_depth:
            raise FormatError(f"no frame of {given.bag} got depth: {'; '.join(line.reasons) or 'nothing was measured'}")
        if line.tracker is not None and not len(line.tracker.trajectory()):
            raise untracked(given)
        _save(folder, line, writer)
    return dict(inputs.assembler.reasons) | line.reasons


def untracked(given: BagInput) -> TrackingLost:
    """What to say of an input of which no frame got a pose."""
    return TrackingLost(
        f"none of the frames of {given.bag} could be tracked: it takes texture and, without depth, "
        "a camera that moves sideways; give such images, depth, or --poses"
    )


def joined(given: BagInput, made: Plan, config: ConfigFile) -> Iterator[Frame]:
    """The frames that the head of a line gets, without the line."""
    inputs = _inputs(given, made, config)
    with BagReader(given.bag) as reader:
        for message in _messages(reader, given):
            inputs.push(*message)
            yield from inputs.assembler.ready()
    inputs.assembler.end()
    yield from inputs.assembler.ready()


def _inputs(given: BagInput, made: Plan, config: ConfigFile) -> SensorInputs:
    """The sensor streams the line joins."""
    roles = given.mapping.roles
    head = replace(made.steps[0], spec=_head_spec(made))
    values = {**sync_values(made, roles, head), **config.sections.get("sync", {})}
    values["image"] = "rgb" in roles
    return SensorInputs(build(SyncConfig, values, "section 'sync'"), lossless=True)


def _messages(reader: BagReader, given: BagInput) -> Iterator[tuple[str, Any]]:
    """(kind, message) of everything the line takes in."""
    kinds = {topic: _KIND[role] for role, topic in given.mapping.roles.items()}
    kinds |= {topic: topic[1:] for topic in given.transform_topics}
    for raw in reader.messages(list(kinds)):
        yield kinds[raw.topic], reader.decode(raw)


def _unused(given: BagInput, inputs: SensorInputs) -> FormatError:
    reasons = "; ".join(inputs.assembler.reasons) or "it has no message on the chosen topics"
    return FormatError(f"no frame of {given.bag} could be used: {reasons}")


def _run_image_set(folder: RunFolder, given: BagInput, made: Plan, config: ConfigFile) -> dict[str, int]:
    """All images at once, with the intrinsics and poses there are."""
    inputs = _inputs(given, made, config)
    with BagReader(given.bag) as reader:
        for message in _messages(reader, given):
            inputs.push(*message)
    inputs.assembler.end()
    frames = list(inputs.assembler.ready())
    if not frames:
        raise _unused(given, inputs)
    with ResultWriter(SequenceWriter(folder.result)) as writer, Progress("estimating", "images") as progress:
        found = make_part(IMAGE_SET, config).estimate(frames, lambda done: progress.update(done, len(frames)))
        for keyframe in found.keyframes:
            writer.keyframe(keyframe)
            writer.dense(keyframe)
    found.save_products(folder.path)
    return dict(inputs.assembler.reasons) | found.reasons


def _advance(line: ProductionLine, inputs: SensorInputs) -> int:
    """Step through the frames that are ready; returns how many there were."""
    done = 0
    for frame in inputs.assembler.ready():
        line.in_epoch(inputs.assembler.epoch)
        with line.timings.measure("frame"):
            pose = line.step(frame)
        inputs.assembler.feed_back(frame.stamp_ns, pose)
        done += 1
    return done


_KIND = {"rgb": "image", "camera_info": "camera_info", "depth": "depth", "lidar": "lidar", "pose": "pose"}


def _head_spec(made: Plan) -> BlockSpec:
    """What all blocks together take from the sensors: in one process there is one head."""
    first = made.steps[0].spec
    requires = frozenset().union(*(step.spec.requires for step in made.steps))
    optional = frozenset().union(*(step.spec.optional for step in made.steps))
    return replace(first, requires=requires, optional=optional)


def _save(folder: RunFolder, line: ProductionLine, writer: ResultWriter) -> None:
    """The files that the nodes of the graph write at their end, and where the time went."""
    (folder.path / "timing.json").write_text(json.dumps(line.timings.to_dict()))
    if line.tracker is not None:
        trajectory = line.tracker.trajectory()
        write_tum(folder.path / "trajectory.tum", trajectory)
        write_tum(
            folder.path / "keyframes.tum", Trajectory.from_pairs(list(line.keyframe_poses.items()), trajectory.scale)
        )
        writer.path(trajectory)
    if line.reconstruction is not None:
        line.reconstruction.save_products(folder.path)
