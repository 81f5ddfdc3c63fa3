"""The tracker: patches, edges, corrections, bundle adjustment, keyframes, in the paper's order (Sec. III-A)."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from sf_interfaces.corrections import Correction
from sf_interfaces.errors import FormatError
from sf_interfaces.geometry import se3
from sf_interfaces.geometry.rolling_shutter import nearness
from sf_interfaces.types import Camera, Float64, Frame, Keyframe, Scale, Trajectory
from sf_tracking.config import TrackingConfig
from sf_tracking.core.between import Between
from sf_tracking.core.initialise import Initialiser
from sf_tracking.core.keyframes import wants_keyframe
from sf_tracking.core.locate import Location, Locator, blind_location
from sf_tracking.core.relief import known_points
from sf_tracking.core.search import relocate
from sf_tracking.core.shape import fit, shape_of
from sf_tracking.core.shutter import Shutter
from sf_tracking.core.update import UpdateOperator, View, make_operator
from sf_tracking.core.window import Window

_REGULAR = 1.5  # frame interval relative to the last, up to which frames count as regular
_SAME_SURFACE = 0.6  # share of depth points that must lie on the keyframe's surface where nothing else tells the pose
_SETTLED = 2  # frames between keyframes solved again with each frame
_LONGEST = 3.0  # relative frame interval over which motion is extrapolated at most


class TrackingState(Enum):
    """What the tracker knows about the newest frame."""

    INITIALISING = "initialising"  # no depth and not enough parallax yet
    TRACKING = "tracking"
    LOST = "lost"  # no pose for this frame; the map is kept and searched again with the next


@dataclass(frozen=True, slots=True)
class TrackingUpdate:
    """The result of one frame.

    Args:
        T_map_camera: provisional pose, None while lost or before the map exists.
        keyframes: those whose pose became final with this frame, oldest first.
        scale: ARBITRARY where the map began without depth.
        edges: observations used for the pose; inliers: those that agree with it; excess: their squared errors
            relative to what alignment claims, typically, at least 1.
        correction: of all final keyframes, where a loop was closed; ``keyframes`` that are not the last of this
            update still have pose and unit from before it.
        T_map_odom: what loops have corrected so far.
    """

    stamp_ns: int
    T_map_camera: Float64 | None
    state: TrackingState
    keyframes: tuple[Keyframe, ...] = ()
    scale: Scale = Scale.METRIC
    edges: int = 0
    inliers: int = 0
    excess: float = 1.0
    correction: Correction | None = None
    T_map_odom: Float64 | None = None

    def corrected_keyframes(self) -> Iterator[tuple[Keyframe, Correction | None]]:
        """The keyframes, and with the last one the correction: it holds from just before that one on."""
        for keyframe in self.keyframes:
            yield keyframe, self.correction if keyframe is self.keyframes[-1] else None

    @property
    def T_odom_camera(self) -> Float64 | None:
        """The pose in metres that no correction makes jump; None while lost or without a metric scale."""
        if self.T_map_camera is None or self.scale is not Scale.METRIC:
            return None
        return self.T_map_camera if self.T_map_odom is None else se3.inverse(self.T_map_odom) @ self.T_map_camera


class Tracker:
    """Tracks frames with dense, sparse or no depth; the first camera of the map is its origin.

    A map that begins with measured depth is metric and stays so through frames without; one that begins
    without depth has an arbitrary scale. Deterministic: the same frames and configuration give the same poses.
    """

    def __init__(self, config: TrackingConfig, operator: UpdateOperator | None = None) -> None:
        self._config = config
        self._operator: UpdateOperator = operator or make_operator(config)
        self._locate = Locator(config, self._operator)
        self._window = Window(config, self._operator)
        self._initialiser = Initialiser(config, self._operator, self._window, self._locate)
        self._between = Between(config.window)
        self._shutter = Shutter(config)
        self._final: dict[int, Float64] = {}  # stamp of keyframe -> T_map_camera
        self._relative: dict[int, tuple[int, Float64]] = {}  # stamp -> (stamp of its keyframe, T_keyframe_frame)
        self._recent: list[tuple[int, Float64]] = []  # the last two (stamp, T_cw), for the motion model
        self._newest: int | None = None  # stamp of the last frame
        self.state = TrackingState.INITIALISING

    @property
    def scale(self) -> Scale:
        """Whether the map is metric; so until a map without depth has begun."""
        return self._initialiser.scale

    def track(self, frame: Frame) -> TrackingUpdate:
        """Pose of the next frame.

        Raises:
            FormatError: the frame has no image or camera, or its stamp does not increase.
        """
        camera = self._check(frame)
        self._newest = frame.stamp_ns
        if not len(self._window):
            return self._start(frame)
        frame, view, found = self._seen(frame, camera)
        if self._config.shape_trust and (found is None or found.doubtful):
            found = self._fit_shape(frame, found)
        if found is None:
            self.state = TrackingState.LOST
            self._recent.clear()
            return TrackingUpdate(frame.stamp_ns, None, self.state, scale=self.scale)
        self.state = TrackingState.TRACKING
        finished = self._remember(frame, view, found)
        return self._tracked(frame.stamp_ns, finished, found)

    def finish(self) -> TrackingUpdate:
        """End of the input: every keyframe still in the window becomes final."""
        stamp = self._window.keyframes[-1].frame.stamp_ns if len(self._window) else 0
        finished = tuple(self._retire() for _ in range(len(self._window)))
        self._settle(None)
        return TrackingUpdate(stamp, None, self.state, finished, self.scale)

    def trajectory(self) -> Trajectory:
        """T_map_camera of every tracked frame; final for those whose keyframe has left the window."""
        stamps = [*self._final, *(k.frame.stamp_ns for k in self._window.keyframes), *self._relative]
        return Trajectory.from_pairs([(stamp, self._pose_of(stamp)) for stamp in stamps], self.scale)

    def keyframe_trajectory(self) -> Trajectory:
        """T_map_camera of the final keyframes."""
        return Trajectory.from_pairs(list(self._final.items()), self.scale)

    def known_keyframe(self) -> Keyframe | None:
        """The newest keyframe half of whose patches are landmarks, as it is now; None before there is one."""
        for tracked in reversed(self._window.keyframes):
            keyframe = tracked.final(self.scale)
            if keyframe.landmarks is not None and 2 * len(keyframe.landmarks) >= len(tracked.patches):
                return keyframe
        return None

    # ---- the steps

    def _check(self, frame: Frame) -> Camera:
        if frame.image is None or frame.camera is None:
            raise FormatError("tracking needs an image and its camera_info in every frame")
        if self._newest is not None and frame.stamp_ns <= self._newest:
            raise FormatError(f"frame stamp {frame.stamp_ns} does not increase; reset the tracker on a time jump")
        if len(self._window) and frame.camera != self._window.keyframes[-1].camera:
            raise FormatError("the camera changed within the sequence; start a new run for another camera")
        return frame.camera

    def _start(self, rolled: Frame) -> TrackingUpdate:
        """The first frame with depth, or frames with parallax between them, begin the map."""
        frame = self._shutter.before_map(rolled)
        poses = [] if frame is None else self._initialiser(frame, self._view(frame))
        if not len(self._window):
            return TrackingUpdate(rolled.stamp_ns, None, self.state, scale=self.scale)
        first = self._window.keyframes[0]
        for stamp, T_cw, sights in poses:
            self._relative[stamp] = (first.frame.stamp_ns, first.T_cw @ se3.inverse(T_cw))
            self._between.add(stamp, sights, self._window.keyframes)
        self.state = TrackingState.TRACKING
        return self._tracked(rolled.stamp_ns, (), None)

    def _tracked(self, stamp_ns: int, finished: tuple[Keyframe, ...], found: Location | None) -> TrackingUpdate:
        T_map_camera = self._pose_of(stamp_ns)
        self._recent = [*self._recent, (stamp_ns, se3.inverse(T_map_camera))][-2:]
        edges, inliers, excess = (0, 0, 1.0) if found is None else (len(found.sights), found.inliers, found.excess)
        return TrackingUpdate(stamp_ns, T_map_camera, self.state, finished, self.scale, edges, inliers, excess)

    def _predict(self, stamp_ns: int) -> Float64:
        """Damped constant motion: exp(damping * dt ratio * log(T_n-1 T_n-2^-1)) T_n-1."""
        if len(self._recent) < 2:
            return self._recent[-1][1] if self._recent else self._window.keyframes[-1].T_cw
        (t0, T0), (t1, T1) = self._recent
        ratio = min(_LONGEST, (stamp_ns - t1) / (t1 - t0))
        # Damping guards the rare frame after a gap; with regular frames the full motion predicts best.
        share = self._config.damping if ratio > _REGULAR else 1.0
        return se3.exp(share * ratio * se3.log(T1 @ se3.inverse(T0))) @ T1

    def _seen(self, rolled: Frame, camera: Camera) -> tuple[Frame, View, Location | None]:
        """The frame as a global shutter takes it, its view and its pose; once more where the pose tells better."""
        window = self._window.keyframes
        if not self._shutter:
            view = self._view(rolled)
            return rolled, view, self._find(rolled.stamp_ns, view, camera)
        near = nearness(camera, *known_points(window, self._predict(rolled.stamp_ns)))
        frame = self._shutter.expected(rolled, self._recent, near)
        view = self._view(frame)
        found = self._find(frame.stamp_ns, view, camera)
        better = None if found is None else self._shutter.corrected(rolled, self._recent, found.T_cw, near)
        if found is None or better is None:
            return frame, view, found
        view = self._view(better)
        return better, view, self._locate.align(window, view, found.T_cw) or found

    def _view(self, frame: Frame) -> View:
        assert frame.image is not None
        return self._operator.view(frame.image)

    def _find(self, stamp_ns: int, view: View, camera: Camera) -> Location | None:
        """Pose from the prediction; failing that with the full search range; failing that by descriptors."""
        window, predicted = self._window.keyframes, self._predict(stamp_ns)
        for wide in (False, True) if len(self._recent) == 2 else (True,):
            found = self._locate(window, view, predicted, wide=wide)
            if found is not None:
                return found
        T_cw = relocate(window, view.gray, camera, self._config)
        return None if T_cw is None else self._locate(window, view, T_cw, wide=False)

    def _fit_shape(self, frame: Frame, found: Location | None) -> Location | None:
        """The pose that also aligns the frame's depth with the newest keyframe's, weighed by both informations.

        Without patches to rely on (a bare wall) it is the predicted motion that the depth corrects.
        """
        newest = self._window.keyframes[-1]
        shape, known = shape_of(frame, self._config), newest.measured_shape(self._config)
        if shape is None or known is None:
            return found
        blind = found is None
        base = blind_location(self._predict(frame.stamp_ns)) if found is None else found
        T = newest.T_cw @ se3.inverse(base.T_cw)
        fitted = fit(newest.camera, shape, known, T, base.seen_from(T), self._config.shape_trust)
        if fitted is None or (blind and fitted.share < _SAME_SURFACE):
            return found
        overlap = fitted.overlap if blind else base.overlap
        return replace(base, T_cw=se3.inverse(fitted.T) @ newest.T_cw, overlap=overlap)

    def _remember(self, frame: Frame, view: View, found: Location) -> tuple[Keyframe, ...]:
        """Store the frame relative to a keyframe, or make it a keyframe and optimise the window."""
        seen = [*self._window.keyframes]  # what the sights index
        newest = seen[-1]
        own = found.sights.keyframe == len(self._window) - 1
        flow = np.linalg.norm(found.sights.uv[own] - newest.patches.uv[found.sights.patch[own]], axis=1)
        wanted = wants_keyframe(self._config, newest, flow, found.overlap, measured=frame.measured)
        done = self._window.work()
        if wanted and not done:
            self._window.complete()
        finished = tuple(self._retire() for _ in range((wanted or done) and self._window.full))
        again, keyframe = None, None
        if wanted:
            again = self._locate.align(self._window.keyframes, view, found.T_cw, thorough=True)
            if again is None and not found.inliers:
                again = found  # no patches, but a surface that tells the pose
            elif again is not None and again.doubtful and self._config.shape_trust:
                again = self._fit_shape(frame, again)
            keyframe = None if again is None else self._window.make(frame, view, again.T_cw)
        if again is not None and keyframe is not None:
            self._window.add(keyframe, again, fixed=1 if self._unsettled else 2)
        else:
            anchor = self._window.settled
            self._relative[frame.stamp_ns] = (anchor.frame.stamp_ns, anchor.T_cw @ se3.inverse(found.T_cw))
            self._between.add(frame.stamp_ns, found.sights, seen)
        self._settle(_SETTLED)
        return finished

    @property
    def _unsettled(self) -> bool:
        """The motion between the first two keyframes, which two views alone told, may still be refined."""
        return self.scale is Scale.ARBITRARY and not self._final

    def _retire(self) -> Keyframe:
        """The oldest keyframe leaves the window: its pose is final."""
        oldest = self._window.retire()
        keyframe = oldest.final(self.scale)
        self._between.settle(oldest)
        self._final[keyframe.stamp_ns] = keyframe.T_map_camera
        return keyframe

    def _settle(self, most: int | None) -> None:
        """Solve frames between keyframes again whose keyframes are final, at most so many."""
        for stamp, sights, keyframes in self._between.due(most):
            T_cw = self._locate.again(keyframes, sights, se3.inverse(self._pose_of(stamp)))
            if T_cw is not None:
                owner = self._relative[stamp][0]
                self._relative[stamp] = (owner, se3.inverse(self._pose_of(owner)) @ se3.inverse(T_cw))

    def _pose_of(self, stamp_ns: int) -> Float64:
        if stamp_ns in self._final:
            return self._final[stamp_ns]
        for keyframe in self._window.keyframes:
            if keyframe.frame.stamp_ns == stamp_ns:
                return se3.inverse(keyframe.T_cw)
        owner, T_owner_frame = self._relative[stamp_ns]
        return self._pose_of(owner) @ T_owner_frame
