"""The tracker: patches, edges, corrections, bundle adjustment, keyframes, in the paper's order (Sec. III-A)."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from sf_interfaces.errors import FormatError
from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera, Float64, Frame, Keyframe, Scale, Trajectory, UInt8
from sf_tracking.config import TrackingConfig
from sf_tracking.core.bundle import Edges, adjust, residuals
from sf_tracking.core.keyframes import TrackedKeyframe, wants_keyframe
from sf_tracking.core.patches import extract, to_gray
from sf_tracking.core.search import relocate
from sf_tracking.core.update import PatchAlignment, UpdateOperator


class TrackingState(Enum):
    """What the tracker knows about the newest frame."""

    INITIALISING = "initialising"  # no keyframe with depth yet
    TRACKING = "tracking"
    LOST = "lost"  # no pose for this frame; the map is kept and searched again with the next


@dataclass(frozen=True, slots=True)
class TrackingUpdate:
    """The result of one frame.

    Args:
        T_map_camera: provisional pose, None while lost or before the first depth.
        keyframes: those whose pose became final with this frame, oldest first.
        edges: observations used for the pose; inliers: those that agree with it.
    """

    stamp_ns: int
    T_map_camera: Float64 | None
    state: TrackingState
    keyframes: tuple[Keyframe, ...] = ()
    scale: Scale = Scale.METRIC
    edges: int = 0
    inliers: int = 0


class Tracker:
    """Tracks frames with measured depth (RGB-D, RGB-L); the first camera with depth is the map's origin.

    Frames without depth in between are tracked against the patches that exist. Deterministic: the same
    frames and configuration give the same poses.
    """

    def __init__(self, config: TrackingConfig, operator: UpdateOperator | None = None) -> None:
        self._config = config
        self._operator: UpdateOperator = operator or PatchAlignment(config)
        self._window: list[TrackedKeyframe] = []
        self._final: dict[int, Float64] = {}  # stamp of keyframe -> T_map_camera
        self._relative: dict[int, tuple[int, Float64]] = {}  # stamp -> (stamp of its keyframe, T_keyframe_frame)
        self._recent: list[tuple[int, Float64]] = []  # the last two (stamp, T_cw), for the motion model
        self.state = TrackingState.INITIALISING

    def track(self, frame: Frame) -> TrackingUpdate:
        """Pose of the next frame.

        Raises:
            FormatError: the frame has no image or camera, or its stamp does not increase.
        """
        camera = self._check(frame)
        assert frame.image is not None
        gray = self._operator.prepare(to_gray(frame.image))
        if not self._window:
            return self._start(frame, gray)
        T_cw, edges, inliers = self._locate(frame, gray, camera)
        if T_cw is None:
            self.state = TrackingState.LOST
            self._recent.clear()
            return TrackingUpdate(frame.stamp_ns, None, self.state, edges=len(edges))
        self.state = TrackingState.TRACKING
        finished = self._remember(frame, gray, camera, T_cw, edges)
        T_map_camera = self._pose_of(frame.stamp_ns)
        self._recent = [*self._recent, (frame.stamp_ns, se3.inverse(T_map_camera))][-2:]
        return TrackingUpdate(frame.stamp_ns, T_map_camera, self.state, finished, edges=len(edges), inliers=inliers)

    def finish(self) -> TrackingUpdate:
        """End of the input: every keyframe still in the window becomes final."""
        stamp = self._window[-1].frame.stamp_ns if self._window else 0
        finished = tuple(self._retire() for _ in range(len(self._window)))
        return TrackingUpdate(stamp, None, self.state, finished)

    def trajectory(self) -> Trajectory:
        """T_map_camera of every tracked frame; final for those whose keyframe has left the window."""
        stamps = [*self._final, *(k.frame.stamp_ns for k in self._window), *self._relative]
        return Trajectory.from_pairs([(stamp, self._pose_of(stamp)) for stamp in stamps])

    def keyframe_trajectory(self) -> Trajectory:
        """T_map_camera of the final keyframes."""
        return Trajectory.from_pairs(list(self._final.items()))

    # ---- the steps

    def _check(self, frame: Frame) -> Camera:
        if frame.image is None or frame.camera is None:
            raise FormatError("tracking needs an image and its camera_info in every frame")
        if self._recent and frame.stamp_ns <= self._recent[-1][0]:
            raise FormatError(f"frame stamp {frame.stamp_ns} does not increase; reset the tracker on a time jump")
        if self._window and frame.camera != self._window[-1].camera:
            raise FormatError("the camera changed within the sequence; start a new run for another camera")
        return frame.camera

    def _start(self, frame: Frame, gray: UInt8) -> TrackingUpdate:
        """The first frame with enough measured patches fixes the map's origin."""
        patches = extract(frame, gray, self._config)
        if len(patches) < self._config.min_inliers:
            return TrackingUpdate(frame.stamp_ns, None, self.state)
        self._window.append(TrackedKeyframe(frame, gray, patches, np.eye(4)))
        self._recent = [(frame.stamp_ns, np.eye(4))]
        self.state = TrackingState.TRACKING
        return TrackingUpdate(frame.stamp_ns, np.eye(4), self.state)

    def _predict(self, stamp_ns: int) -> Float64:
        """Damped constant motion: exp(damping * dt ratio * log(T_n-1 T_n-2^-1)) T_n-1."""
        if len(self._recent) < 2:
            return self._recent[-1][1] if self._recent else self._window[-1].T_cw
        (t0, T0), (t1, T1) = self._recent
        ratio = min(3.0, (stamp_ns - t1) / (t1 - t0))
        # Damping guards the rare frame after a gap; with regular frames the full motion predicts best.
        share = self._config.damping + (1 - self._config.damping) * float(ratio <= 1.5)
        return se3.exp(share * ratio * se3.log(T1 @ se3.inverse(T0))) @ T1

    def _locate(self, frame: Frame, gray: UInt8, camera: Camera) -> tuple[Float64 | None, Edges, int]:
        """Pose from the prediction; failing that with the full search range; failing that by descriptors."""
        known = len(self._recent) == 2
        attempts = ([(self._predict(frame.stamp_ns), False)] if known else []) + [(self._predict(frame.stamp_ns), True)]
        edges = Edges.concatenate([])
        for start, wide in attempts:
            T_cw, edges, inliers = self._align(gray, camera, start, wide)
            if T_cw is not None:
                return T_cw, edges, inliers
        found = relocate(self._window[-self._config.lifetime :], gray, camera, self._config)
        if found is not None:
            T_cw, edges, inliers = self._align(gray, camera, found, False)
            return T_cw, edges, inliers
        return None, edges, 0

    def _align(self, gray: UInt8, camera: Camera, T_cw: Float64, wide: bool) -> tuple[Float64 | None, Edges, int]:
        """Edges of all recent patches to the image and the pose they agree on (None: too few agree)."""
        sources = self._window[-self._config.lifetime :]
        for repeat in range(3 if wide else 1):
            edges = self._edges(sources, gray, camera, T_cw, wide and repeat == 0)
            poses = np.stack([*(k.T_cw for k in sources), T_cw])
            free = np.arange(len(poses)) == len(sources)
            # Far from the truth the kernel has to be wide, or it would reject the right edges.
            for scale in (10 * self._config.robust_sigmas, self._config.robust_sigmas):
                poses = adjust(camera, poses, edges, free, scale)
            T_cw = poses[-1]
        r, _, _, valid = residuals(camera, poses, edges)
        inliers = int((valid & (np.linalg.norm(r, axis=1) < self._config.inlier_px)).sum())
        enough = inliers >= self._config.min_inliers and inliers > 0.3 * len(edges)
        return (T_cw if enough else None), edges, inliers

    def _edges(self, sources: list[TrackedKeyframe], gray: UInt8, camera: Camera, T_cw: Float64, wide: bool) -> Edges:
        """One edge per patch that the update operator finds; poses are numbered as ``sources``, then the image."""
        parts = []
        for index, keyframe in enumerate(sources):
            moved = se3.transform(T_cw @ se3.inverse(keyframe.T_cw), keyframe.patches.points)
            start, z = camera.project(moved)
            start[z <= 0.1] = np.nan
            update = self._operator(keyframe.gray, keyframe.patches, gray, start, wide=wide)
            ok = update.valid
            ends = np.full(int(ok.sum()), index), np.full(int(ok.sum()), len(sources))
            parts.append(Edges(*ends, keyframe.patches.points[ok], update.target[ok], update.information[ok]))
        return Edges.concatenate(parts)

    def _remember(self, frame: Frame, gray: UInt8, camera: Camera, T_cw: Float64, edges: Edges) -> tuple[Keyframe, ...]:
        """Store the frame relative to the newest keyframe, or make it a keyframe and optimise the window."""
        newest = self._window[-1]
        sources = self._window[-self._config.lifetime :]
        own = edges.source == len(sources) - 1
        moved = camera.project(edges.points[own])[0]
        flow = np.linalg.norm(edges.uv[own] - moved, axis=1)
        share = float(own.sum()) / max(1, len(newest.patches))
        patches = None
        if wants_keyframe(self._config, camera, flow, share):
            patches = extract(frame, gray, self._config)
        if patches is None or len(patches) < self._config.min_inliers:
            self._relative[frame.stamp_ns] = (newest.frame.stamp_ns, newest.T_cw @ se3.inverse(T_cw))
            return ()
        keyframe = TrackedKeyframe(frame, gray, patches, T_cw)
        for index, source in enumerate(sources):
            mine = edges.source == index
            part = Edges(*(getattr(edges, name)[mine] for name in ("source", "target", "points", "uv", "information")))
            keyframe.observed.append((source.frame.stamp_ns, part))
            source.observed.append((frame.stamp_ns, self._edges([keyframe], source.gray, camera, source.T_cw, False)))
        self._window.append(keyframe)
        self._optimise(camera)
        return (self._retire(),) if len(self._window) > self._config.window else ()

    def _optimise(self, camera: Camera) -> None:
        """Windowed bundle adjustment; the two oldest keyframes hold the gauge."""
        index = {k.frame.stamp_ns: i for i, k in enumerate(self._window)}
        parts = []
        for target, keyframe in enumerate(self._window):
            for stamp, e in keyframe.observed:
                if stamp in index:
                    ends = np.full(len(e), index[stamp]), np.full(len(e), target)
                    parts.append(Edges(*ends, e.points, e.uv, e.information))
        free = np.arange(len(self._window)) >= min(2, len(self._window) - 1)
        poses = np.stack([k.T_cw for k in self._window])
        poses = adjust(camera, poses, Edges.concatenate(parts), free, self._config.robust_sigmas)
        for keyframe, T_cw in zip(self._window, poses, strict=True):
            keyframe.T_cw = T_cw

    def _retire(self) -> Keyframe:
        """The oldest keyframe leaves the window: its pose is final."""
        oldest = self._window.pop(0)
        keyframe = oldest.final()
        self._final[keyframe.stamp_ns] = keyframe.T_map_camera
        return keyframe

    def _pose_of(self, stamp_ns: int) -> Float64:
        if stamp_ns in self._final:
            return self._final[stamp_ns]
        for keyframe in self._window:
            if keyframe.frame.stamp_ns == stamp_ns:
                return se3.inverse(keyframe.T_cw)
        owner, T_owner_frame = self._relative[stamp_ns]
        return self._pose_of(owner) @ T_owner_frame
