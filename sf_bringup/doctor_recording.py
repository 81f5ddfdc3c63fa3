"""``sf doctor RECORDING``: does its depth lie on its colour, in space and in time?"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import numpy as np

from sf_bringup.doctor import Check
from sf_bringup.progress import Progress
from sf_bringup.recorded_shots import Mounting, Unchecked, recorded_shots
from sf_interfaces.geometry import se3
from sf_interfaces.geometry.depth_alignment import FEW_EDGES, FEW_FRAMES, REACH, Alignment, align
from sf_interfaces.geometry.edge_views import EdgeViews
from sf_interfaces.types import Float64

SHOTS = 60  # depth images that are looked at
_SPACE, _TIME, _LOST = "depth on colour", "depth in time", "frames lost"
_OFF = 1.5 / 640  # of the image width; what is off by less is well registered
_LATE_S = 0.004  # a smaller lag is none
_SURE = 1.5  # a finding is larger than so many times what two halves of the frames differ


def recording_checks(recording: Path) -> list[Check]:
    """What the edges of depth and colour tell about a recording.

    Raises:
        SceneFactoryError: it cannot be read, or it does not say how its cameras are mounted.
    """
    try:
        mounting, shots = recorded_shots(recording, SHOTS)
        views = EdgeViews(mounting.depth, mounting.color, mounting.T_color_depth)
        with Progress("looking", "frames") as progress:
            for done, shot in enumerate(shots, 1):
                views.add(shot)
                progress.update(done, SHOTS)
    except Unchecked as why:
        return [Check(_SPACE, True, f"nothing to check: {why}")]
    if not views.views:
        mend = "let both drivers stamp with one clock, and record them together"
        return [Check(_TIME, False, "no depth image has a stamp within 0.1 s of that of a colour image", mend)]
    return judge(views, mounting)


def judge(views: EdgeViews, mounting: Mounting) -> list[Check]:
    """What the edges of some tens of shots tell."""
    found = align(views)
    if found is None:
        return [_not_told(views)]
    start_ns = views.views[0].stamp_ns
    return [_space(found, mounting), _time(found, mounting), *_lost(found, start_ns)]


def _not_told(views: EdgeViews) -> Check:
    """Too few frames have a clear shift: for want of edges, or because it is larger than what is tried."""
    edges, reach = float(np.median([len(v.edges) for v in views.views])), REACH * views.camera.width * views.enlarged
    detail = f"cannot tell: of {len(views.views)} frames, too few have edges in depth that show in colour"
    if len(views.views) >= FEW_FRAMES and edges >= FEW_EDGES:
        detail += f" within {reach:.0f} px, though depth has them: they do not belong together, or lie farther apart"
    return Check(_SPACE, True, detail, "record some tens of frames with near and far things in view")


def _space(found: Alignment, mounting: Mounting) -> Check:
    limit = _OFF * mounting.color.width
    seen = f"{found.used} of {found.frames} frames, halves agree to {found.halves_px:.1f} px"
    scores = f"{found.score:.2f}, by chance {found.score_chance:.2f}"
    if found.off_px <= limit and found.halves_px <= 2 * limit:
        return Check(_SPACE, True, f"its edges lie within {found.off_px:.1f} px ({seen}; score {scores})")
    if not found.confirmed or found.off_px < _SURE * found.halves_px:
        detail = f"cannot tell: {found.off_px:.1f} px off, but {seen}"
        return Check(_SPACE, True, detail, "record more frames, with near and far things all over the image")
    right, down = found.offset_px
    detail = f"{found.off_px:.1f} px off: to lie on colour it has to move {right:+.1f} px right, {down:+.1f} px down"
    rest = float(np.nan_to_num(np.linalg.norm(found.near_far_px)))
    if rest > max(2 * limit, _SURE * found.halves_px) or found.halves_px > 2 * limit:
        detail += f", but no turn explains that: {seen}, near edges stay {rest:.1f} px off against far ones"
        return Check(_SPACE, False, detail, "calibrate both cameras, lenses and place: it is not the direction alone")
    alike = 1e3 * found.off_px * found.depth_m / mounting.color.fx
    detail += (
        f"; a turn of {np.degrees(np.linalg.norm(found.rotation)):.2f} deg brings the score to "
        f"{found.score_corrected:.2f} from {scores} ({seen}, {np.degrees(found.halves_rad):.2f} deg); at "
        f"{found.depth_m:.1f} m, where the edges are, a place that is {alike:.0f} mm off would look alike"
    )
    return Check(_SPACE, False, detail, _turn(found, mounting))


def _turn(found: Alignment, mounting: Mounting) -> str:
    """The corrected extrinsic, as numbers to put in."""
    if mounting.registered:
        x, y, z = np.degrees(found.rotation)
        q = _numbers(se3.to_quaternion(found.corrected(np.eye(4)))[1])
        return (
            f"register it again with T_color_depth turned from the left by ({x:.3f}, {y:.3f}, {z:.3f}) deg about x, y, "
            f"z of the colour camera (quaternion x y z w: {q})"
        )
    t, q = se3.to_quaternion(found.corrected(mounting.T_color_depth))
    names = zip(("x", "y", "z", "qx", "qy", "qz", "qw"), (*t, *q), strict=True)
    pose = " ".join(f"--{name} {value:.6f}" for name, value in names)
    pose += f" --frame-id {mounting.color.frame_id} --child-frame-id {mounting.depth.frame_id}"
    return f"the pose that fits, in place of that on /tf_static: ros2 run tf2_ros static_transform_publisher {pose}"


def _numbers(values: Float64) -> str:
    return " ".join(f"{v:.6f}" for v in values)


def _time(found: Alignment, mounting: Mounting) -> Check:
    if found.lag_s is None:
        return Check(
            _TIME, True, "cannot tell: the camera moves too little", "record it while the camera turns to and fro"
        )
    lag, apart = 1e3 * found.lag_s, 1e3 * found.halves_lag_s
    seen = f"halves of the frames agree to {apart:.1f} ms"
    if abs(found.lag_s) <= _LATE_S and apart <= 2e3 * _LATE_S:
        return Check(_TIME, True, f"taken together with colour to {abs(lag):.1f} ms ({seen})")
    if abs(found.lag_s) < _SURE * found.halves_lag_s:
        mend = "record it while the camera turns to and fro"
        return Check(_TIME, True, f"cannot tell: {abs(lag):.1f} ms apart, but {seen}", mend)
    word, sign = ("older", "subtract") if lag > 0 else ("younger", "add")
    moved = f"as the image moves, {abs(found.lag_s) * found.speed_px_s:.1f} px"
    detail = f"what depth shows is {abs(lag):.1f} ms {word} than its stamp says ({seen}; {moved})"
    return Check(_TIME, False, detail, f"{sign} {abs(lag):.1f} ms {'from' if lag > 0 else 'to'} the stamps of depth")


def _lost(found: Alignment, start_ns: int) -> list[Check]:
    """A change of the lag, if there is one."""
    if found.jump is None:
        return []
    first, last = (1e-9 * (ns - start_ns) for ns in (found.jump.after_ns, found.jump.before_ns))
    frames = abs(found.jump.seconds) / found.period_s
    slip = max(1, round(frames)) * found.period_s  # frames are lost as a whole
    word, image = ("younger", "depth") if found.jump.seconds < 0 else ("older", "colour")
    detail = (
        f"between {first:.2f} and {last:.2f} s after the first frame, depth becomes {frames:.1f} frames {word} than "
        f"before: {image} was lost there, or its stamps slipped"
    )
    sign = "add" if found.jump.seconds < 0 else "subtract"
    return [
        Check(_LOST, False, detail, f"from there on, {sign} {1e3 * slip:.0f} ms on the stamps of depth; or cut there")
    ]
