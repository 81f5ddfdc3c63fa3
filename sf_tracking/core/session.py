"""Tracking across what a tracker does not survive: drift, loss, a changed calibration, the death of its process.

The map and the trajectory go on. A tracker starts at its own origin; the session finds where that lies in the
map, from the places it remembers, and moves everything the tracker says there. Where the camera comes back to a
known place, the keyframes are corrected, and all frames with them.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections import deque
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path

import numpy as np

from sf_interfaces.corrections import Correction
from sf_interfaces.errors import FormatError
from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera, Float64, Frame, Keyframe, PointCloud, Scale, Trajectory
from sf_tracking.config import TrackingConfig
from sf_tracking.core import sim3, snapshot
from sf_tracking.core.beside import beside
from sf_tracking.core.keyframe_map import KeyframeMap, Recognised
from sf_tracking.core.places import Features, Place, features, place_of_frame, place_of_keyframe
from sf_tracking.core.recognise import Sighting, sight
from sf_tracking.core.shape import fit_points
from sf_tracking.core.tracker import Tracker, TrackingState, TrackingUpdate

_VIEWS = 8  # of the last seconds, to find the map by where its newest keyframes are not final yet
_VIEW_EVERY_NS = 1_000_000_000
_HELD = 60  # keyframes of a tracker whose place is still unknown


class TrackingSession:
    """One map and one trajectory over any number of trackers."""

    def __init__(self, config: TrackingConfig) -> None:
        self._config = config
        self._map = KeyframeMap(loops=config.loops)
        # Of the last seconds: stamp, what was seen there, T_map_camera.
        self._views: deque[tuple[int, Future[Place | None], Float64]] = deque(maxlen=_VIEWS)
        self._poses: dict[int, Float64] = {}  # stamp ns -> T_map_camera, of trackers that have ended
        self._T_map_odom = np.eye(4)
        self._camera: Camera | None = None
        self._near = True  # the next tracker can only start where the last one ended
        self._begin(np.eye(4))

    def _begin(self, start: Float64 | None) -> None:
        """A new tracker; ``start`` is the similarity of its world to the map, None: to be found."""
        self._tracker = Tracker(self._config)
        self._start = start
        self._anchors: list[Float64] = []  # of each of its final keyframes: the tracker's world to the map
        self._held: deque[Keyframe] = deque(maxlen=_HELD)
        self._hint: tuple[Float64, Recognised] | None = None  # a start that waits for a second sighting
        self._sighted: int | None = None  # stamp of the keyframe that was looked for last
        self._again: Keyframe | None = None  # the newest one, where it sees what an older one does
        self._lost = 0  # frames in a row

    def track(self, frame: Frame) -> TrackingUpdate:
        """Pose of the next frame; see :meth:`Tracker.track`.

        Raises:
            FormatError: the frame has no image or camera, or its stamp does not increase.
        """
        if frame.image is None or frame.camera is None:
            raise FormatError("tracking needs an image and its camera_info in every frame")
        ended: tuple[Keyframe, ...] = ()
        changed = self._camera is not None and frame.camera != self._camera
        if changed or (self._lost >= self._config.patience and len(self._map)):
            ended = self._succeed(near=changed)
        self._camera = frame.camera
        update = self._tracker.track(frame)
        self._lost = self._lost + 1 if update.state is TrackingState.LOST else 0
        update = self._placed(update, ended) if self._start is not None else self._search(frame, update, ended)
        self._look(frame, update.T_map_camera)
        return update

    def finish(self) -> TrackingUpdate:
        """End of the input: every keyframe still in the window becomes final."""
        update = self._tracker.finish()
        return self._placed(update, (), end=True) if self._start is not None else self._unknown(update, ())

    def trajectory(self) -> Trajectory:
        """T_map_camera of every tracked frame, corrected, also those before a restart."""
        poses = dict(self._poses)
        if self._start is not None and len(own := self._tracker.trajectory()):
            # A frame moves with the last final keyframe before it; those after the newest move as the tracker does.
            finals = np.array(self._map.stamps[len(self._map) - len(self._anchors) :], np.int64)
            owner = np.maximum(np.searchsorted(finals, own.stamps_ns, side="right") - 1, 0)
            owner[own.stamps_ns > (finals[-1] if len(finals) else -1)] = len(finals)
            S = np.array([*self._anchors, self._start])[owner]
            poses |= dict(zip(own.stamps_ns.tolist(), sim3.rigid(S @ own.poses), strict=True))
        return Trajectory.from_pairs(list(poses.items()), self._map.scale)

    def keyframe_trajectory(self) -> Trajectory:
        """T_map_camera of the final keyframes, corrected, also those before a restart."""
        return Trajectory.from_pairs(list(self._map.poses().items()), self._map.scale)

    # ---- a tracker whose place is known

    def _placed(
        self, update: TrackingUpdate, ended: tuple[Keyframe, ...], found: Recognised | None = None, *, end: bool = False
    ) -> TrackingUpdate:
        """The update in the map's frame; its keyframes enter the map, and loops take effect."""
        assert self._start is not None
        if not len(self._map):
            self._map.scale = update.scale
        keyframes: tuple[Keyframe, ...] = ()
        for keyframe in map(self._moved, update.keyframes):
            keyframes += self._enter(keyframe, found)
            found = None
        if end:
            self._map.complete()
            keyframes += self._revisited()
        elif not update.keyframes:
            self._map.work()
        correction = None
        if keyframes and (motion := self._map.correct()) is not None:
            correction = self._corrected(motion)
            last = replace(_grown(keyframes[-1], motion[-1]), T_map_camera=correction.keyframes.poses[-1])
            keyframes = (*keyframes[:-1], last)
        T = None if update.T_map_camera is None else sim3.rigid(self._start @ update.T_map_camera)
        return replace(
            update,
            keyframes=(*ended, *keyframes),
            T_map_camera=T,
            scale=self._map.scale,
            correction=correction,
            T_map_odom=self._T_map_odom,
        )

    def _enter(self, keyframe: Keyframe, found: Recognised | None) -> tuple[Keyframe, ...]:
        """A keyframe enters the map; those that are new to it.

        One that sees what an older one does stays only if it tells something, which is known when the next one comes.
        """
        assert self._start is not None
        new = self._revisited()
        again = found is None and not self._map.news and self._map.knows(keyframe, self._config)
        self._map.add(keyframe, found)
        self._anchors.append(self._start)
        if again:
            self._again = keyframe
            return new
        return (*new, keyframe)

    def _revisited(self) -> tuple[Keyframe, ...]:
        """The keyframe that waits, if it told something; else the map forgets it."""
        again, self._again = self._again, None
        if again is None or self._map.told:
            return () if again is None else (again,)
        self._map.drop()
        self._anchors.pop()
        return ()

    def _moved(self, keyframe: Keyframe) -> Keyframe:
        """A keyframe of the tracker in the map's frame and unit."""
        return replace(_grown(keyframe, self._start), scale=self._map.scale)

    def _corrected(self, motion: Float64) -> Correction:
        """Let the motions [N, 4, 4] of the keyframes take effect on everything that has a place."""
        stamps = np.array(self._map.stamps)
        own = len(self._anchors)
        self._anchors = list(motion[len(motion) - own :] @ np.array(self._anchors))
        self._start = motion[-1] @ self._start
        self._T_map_odom = sim3.rigid(motion[-1] @ self._T_map_odom)
        if self._poses:
            owner = np.maximum(np.searchsorted(stamps, list(self._poses), side="right") - 1, 0)
            self._poses = dict(
                zip(self._poses, sim3.rigid(motion[owner] @ np.array(list(self._poses.values()))), strict=True)
            )
        self._views = deque(((stamp, seen, sim3.rigid(motion[-1] @ T)) for stamp, seen, T in self._views), _VIEWS)
        metric = self._map.scale is Scale.METRIC
        return Correction(self.keyframe_trajectory(), np.ones(len(stamps)) if metric else sim3.scale_of(self._map.S))

    # ---- a tracker whose place is still to be found

    def _succeed(self, *, near: bool) -> tuple[Keyframe, ...]:
        """This tracker ends, another goes on in the same map.

        Args:
            near: the camera is where it was, so the last pose serves where no image of the map is recognised.
                Without a metric scale the new tracker measures in another unit then, until a loop tells it.
        """
        ended = self.finish().keyframes
        self._poses = dict(zip((known := self.trajectory()).stamps_ns.tolist(), known.poses, strict=True))
        self._near = near
        last = self._poses[max(self._poses)] if self._poses else np.eye(4)
        self._begin(last if not self._poses or (near and self._map.scale is Scale.ARBITRARY) else None)
        return ended

    def _search(self, frame: Frame, update: TrackingUpdate, ended: tuple[Keyframe, ...]) -> TrackingUpdate:
        """Look for the frame in the map; what the tracker found out so far is placed with it."""
        self._held.extend(update.keyframes)
        found = None if update.T_map_camera is None else self._found(frame, update)
        if found is None:
            return self._unknown(update, ended)
        start, recognised = found
        held = (*self._held,)
        self._start, self._held = start, deque(maxlen=_HELD)
        return self._placed(replace(update, keyframes=held), ended, recognised)

    def _found(self, frame: Frame, update: TrackingUpdate) -> tuple[Float64, Recognised | None] | None:
        """Where the tracker's world lies in the map, and the place that tells it."""
        assert frame.image is not None and frame.camera is not None and update.T_map_camera is not None
        metric = self._map.scale is Scale.METRIC
        back = se3.inverse(update.T_map_camera)
        if metric:
            seen = features(frame.image)
            recognised, near = self._map.recognise(seen, frame.camera), self._among_views(seen, frame.camera)
            if near is not None and (recognised is None or near.inliers >= recognised.inliers):
                points = [se3.transform(T, place.points) for place, T in self._known_views()]
                return self._aligned(frame, near.T, near.sigma, points) @ back, None
            if recognised is not None:
                points = self._map.points_near(recognised.index)
                S = self._aligned(frame, recognised.S, recognised.sigma[:6], points)
                recognised = replace(recognised, S=S)
            depth = 0.0 if recognised is None else self._map.places[recognised.index].depth
        else:
            keyframe = self._tracker.known_keyframe()
            if keyframe is None or keyframe.stamp_ns == self._sighted:
                return None
            self._sighted, back = keyframe.stamp_ns, se3.inverse(keyframe.T_map_camera)
            seen = features(keyframe.image)
            place = place_of_keyframe(keyframe, seen)
            recognised, depth = self._map.recognise(seen, frame.camera, place), place.depth
        if recognised is None:
            return (self._poses[max(self._poses)] @ back, None) if self._near and metric else None
        start = recognised.S @ back
        hint, self._hint = self._hint, (start, recognised)
        if self._near or (hint is not None and self._map.agree(hint[0] @ se3.inverse(back), recognised.S, depth)):
            return start, recognised
        return None

    def _aligned(self, frame: Frame, T: Float64, sigma: Float64, points: list[Float64]) -> Float64:
        """T_map_camera of corners, which are few and repeat, made better by the frame's depth and points of the map."""
        prior = np.diag(sigma**-2.0)
        found = fit_points(frame, np.concatenate(points), se3.inverse(T), prior, self._config)
        return T if found is None else se3.inverse(found.T)

    def _among_views(self, seen: Features, camera: Camera) -> Sighting | None:
        """An image that shows what was seen in the last seconds."""
        views = self._known_views()
        return sight([p for p, _ in views], np.array([T for _, T in views]), seen, camera) if views else None

    def _known_views(self) -> list[tuple[Place, Float64]]:
        """What was seen in the last seconds, with T_map_camera."""
        return [(place, T) for _, seen, T in self._views if (place := seen.result()) is not None]

    def _unknown(self, update: TrackingUpdate, ended: tuple[Keyframe, ...]) -> TrackingUpdate:
        """Nothing can be said in the map's frame."""
        return TrackingUpdate(update.stamp_ns, None, TrackingState.LOST, ended, self._map.scale)

    def _look(self, frame: Frame, T_map_camera: Float64 | None) -> None:
        """Remember a tracked frame now and then."""
        if T_map_camera is None or (self._views and frame.stamp_ns - self._views[-1][0] < _VIEW_EVERY_NS):
            return
        if frame.measured:
            self._views.append((frame.stamp_ns, beside(place_of_frame, frame), T_map_camera))

    # ---- snapshots

    def save(self, path: Path) -> None:
        """Write what a successor process needs: the trajectory, the map of keyframes and its places, no pickle."""
        trajectory = self.trajectory()
        snapshot.write(path, self._map, trajectory, self._known_views())

    @staticmethod
    def restore(config: TrackingConfig, path: Path) -> TrackingSession:
        """The session of a process that died; it is lost until a frame is found in the map.

        Raises:
            FormatError: not a snapshot.
        """
        out = TrackingSession(config)
        out._poses, views = snapshot.read(path, out._map)
        out._views.extend((place.stamp_ns, beside(lambda known: known, place), T) for place, T in views)
        out._near = False
        out._begin(None if out._poses else np.eye(4))
        return out


def _grown(keyframe: Keyframe, S: Float64) -> Keyframe:
    """A keyframe moved by a similarity, with the landmarks in the new unit."""
    T, cloud, unit = S @ keyframe.T_map_camera, keyframe.landmarks, float(sim3.scale_of(S))
    if cloud is not None and unit != 1.0:
        cloud = PointCloud(cloud.points * np.float32(unit), cloud.colors, None, cloud.stamp_ns, cloud.frame_id)
    return replace(keyframe, T_map_camera=sim3.rigid(T), landmarks=cloud)
