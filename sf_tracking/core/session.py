"""Tracking across what ends a tracker: a changed calibration, or the death of its process.

The map and the trajectory go on. A tracker starts at its own origin; the session finds where that lies in
the map, from the keyframes it remembers, and moves everything the tracker says there.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import zipfile
from collections import deque
from dataclasses import replace
from pathlib import Path

import numpy as np

from sf_interfaces.errors import FormatError
from sf_interfaces.geometry import se3
from sf_interfaces.io.atomic import replace_file
from sf_interfaces.types import Camera, Float64, Frame, Keyframe, PointCloud, Scale, Trajectory
from sf_tracking.config import TrackingConfig
from sf_tracking.core.patches import to_gray
from sf_tracking.core.rejoin import rejoin, view
from sf_tracking.core.tracker import Tracker, TrackingState, TrackingUpdate

_REMEMBERED = 4  # views of the last seconds, and as many final keyframes, to find the map by
_VIEW_EVERY_NS = 1_000_000_000
_PARTS = ("gray", "pose", "points", "camera", "stamp")  # of a remembered keyframe in a snapshot

Poses = dict[int, Float64]  # stamp ns -> T_map_camera


class TrackingSession:
    """One map and one trajectory over any number of trackers."""

    def __init__(self, config: TrackingConfig) -> None:
        self._config = config
        self._tracker = Tracker(config)
        self._camera: Camera | None = None
        self._T_map_start: Float64 | None = np.eye(4)  # None: where the new tracker starts is still to be found
        self._finals: deque[Keyframe] = deque(maxlen=_REMEMBERED)
        self._views: deque[Keyframe] = deque(maxlen=2 * _REMEMBERED)
        self._poses: Poses = {}  # of trackers that have ended
        self._keyframes: Poses = {}
        self._scale = Scale.METRIC
        self._restored = False

    def track(self, frame: Frame) -> TrackingUpdate:
        """Pose of the next frame; see :meth:`Tracker.track`.

        Raises:
            FormatError: the frame has no image or camera, or its stamp does not increase.
        """
        ended: tuple[Keyframe, ...] = ()
        if self._camera is not None and frame.camera is not None and frame.camera != self._camera:
            ended = self._succeed()
        self._camera = frame.camera
        update = self._rejoin(frame) if self._T_map_start is None else self._placed(self._tracker.track(frame))
        self._look(frame, update.T_map_camera)
        return replace(update, keyframes=(*ended, *update.keyframes)) if ended else update

    def finish(self) -> TrackingUpdate:
        """End of the input: every keyframe still in the window becomes final."""
        return self._placed(self._tracker.finish()) if self._T_map_start is not None else self._lost(0)

    def trajectory(self) -> Trajectory:
        """T_map_camera of every tracked frame, also those before a restart."""
        poses = dict(self._poses)
        if self._T_map_start is not None:
            own = self._tracker.trajectory()
            self._scale = own.scale
            poses |= {t: self._T_map_start @ T for t, T in zip(own.stamps_ns.tolist(), own.poses, strict=True)}
        return Trajectory.from_pairs(list(poses.items()), self._scale)

    def keyframe_trajectory(self) -> Trajectory:
        """T_map_camera of the final keyframes, also those before a restart."""
        return Trajectory.from_pairs(list(self._keyframes.items()), self._scale)

    # ---- succession of trackers

    def _succeed(self) -> tuple[Keyframe, ...]:
        """The calibration has changed: this tracker ends, another goes on in the same map."""
        ended = self.finish().keyframes
        trajectory = self.trajectory()
        self._poses = dict(zip(trajectory.stamps_ns.tolist(), trajectory.poses, strict=True))
        self._tracker = Tracker(self._config)
        self._T_map_start = self._start()
        return ended

    def _start(self) -> Float64 | None:
        """Where a new tracker starts in the map; None: to be found.

        Without a metric scale a new tracker measures in another unit, and no image of the map tells which:
        it goes on from the last pose, and its part of the map has its own scale.
        """
        if not self._poses:
            return np.eye(4)
        return None if self._scale is Scale.METRIC else self._poses[max(self._poses)]

    def _rejoin(self, frame: Frame) -> TrackingUpdate:
        """Find the frame in the map; the tracker starts with the first that is found and can start it."""
        T = self._found(frame)
        if T is None:
            return self._lost(frame.stamp_ns)
        tracker = Tracker(self._config)
        update = tracker.track(frame)
        if update.T_map_camera is None:
            return update
        self._tracker, self._T_map_start = tracker, T @ se3.inverse(update.T_map_camera)
        return self._placed(update)

    def _found(self, frame: Frame) -> Float64 | None:
        """T_map_camera by the remembered keyframes; of a camera that merely changed its lens, the last pose serves."""
        if frame.image is None or frame.camera is None:
            raise FormatError("tracking needs an image and its camera_info in every frame")
        T = rejoin([*self._views, *self._finals], frame.image, frame.camera)
        if T is not None or self._restored:
            return T
        return self._poses[max(self._poses)]

    def _look(self, frame: Frame, T_map_camera: Float64 | None) -> None:
        """Remember a tracked frame now and then."""
        if T_map_camera is None or (self._views and frame.stamp_ns - self._views[-1].stamp_ns < _VIEW_EVERY_NS):
            return
        if (seen := view(frame, T_map_camera)) is not None:
            self._views.append(seen)

    def _lost(self, stamp_ns: int) -> TrackingUpdate:
        return TrackingUpdate(stamp_ns, None, TrackingState.LOST, scale=self._scale)

    def _placed(self, update: TrackingUpdate) -> TrackingUpdate:
        """The update in the map's frame; its keyframes are remembered."""
        start = self._T_map_start
        assert start is not None
        self._scale = update.scale
        moved = tuple(replace(k, T_map_camera=start @ k.T_map_camera) for k in update.keyframes)
        self._finals.extend(moved)
        self._keyframes |= {k.stamp_ns: k.T_map_camera for k in moved}
        T = None if update.T_map_camera is None else start @ update.T_map_camera
        return replace(update, keyframes=moved, T_map_camera=T)

    # ---- snapshots

    def save(self, path: Path) -> None:
        """Write what a successor process needs: the trajectory and the remembered keyframes, without pickle."""
        trajectory, keyframes = self.trajectory(), self.keyframe_trajectory()
        arrays: dict[str, np.ndarray] = {
            "version": np.array(1),
            "metric": np.array(self._scale is Scale.METRIC),
            "stamps": trajectory.stamps_ns,
            "poses": trajectory.poses,
            "keyframe_stamps": keyframes.stamps_ns,
            "keyframe_poses": keyframes.poses,
        }
        for i, k in enumerate([*self._finals, *self._views]):
            camera = k.camera
            arrays[f"{i}.gray"] = to_gray(k.image)
            arrays[f"{i}.pose"] = k.T_map_camera
            arrays[f"{i}.points"] = _landmarks(k)
            arrays[f"{i}.camera"] = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
            arrays[f"{i}.stamp"] = np.array(k.stamp_ns)
        with replace_file(path) as draft, draft.open("wb") as file:
            np.savez(file, allow_pickle=False, **arrays)

    @staticmethod
    def restore(config: TrackingConfig, path: Path) -> TrackingSession:
        """The session of a process that died; it is lost until a frame is found in the map.

        Raises:
            FormatError: not a snapshot.
        """
        out = TrackingSession(config)
        try:
            with np.load(path, allow_pickle=False) as file:
                a = {name: file[name] for name in file.files}
            out._scale = Scale.METRIC if a["metric"] else Scale.ARBITRARY
            out._poses = dict(zip(a["stamps"].tolist(), a["poses"], strict=True))
            out._keyframes = dict(zip(a["keyframe_stamps"].tolist(), a["keyframe_poses"], strict=True))
            for i in range(sum(name.endswith(".gray") for name in a)):
                out._views.append(_keyframe({k: a[f"{i}.{k}"] for k in _PARTS}))
        except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
            raise FormatError(f"{path} is no snapshot of the tracker ({error}); delete it and start anew") from error
        out._T_map_start, out._restored = out._start(), True
        return out


def _keyframe(a: dict[str, np.ndarray]) -> Keyframe:
    height, width = a["gray"].shape
    camera = Camera(width, height, *(float(v) for v in a["camera"]))
    return Keyframe(int(a["stamp"]), camera, a["gray"], a["pose"], None, PointCloud(a["points"].astype(np.float32)))


def _landmarks(keyframe: Keyframe) -> Float64:
    """Landmarks of a keyframe, [N, 3], optical frame."""
    return np.zeros((0, 3)) if keyframe.landmarks is None else keyframe.landmarks.points.astype(np.float64)
