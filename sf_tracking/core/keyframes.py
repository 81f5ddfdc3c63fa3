"""Keyframes of the tracker: what is kept of them, where their patches lie, and when a new one is made."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera, DepthMap, Float64, Frame, Keyframe, PointCloud, Scale
from sf_tracking.config import TrackingConfig
from sf_tracking.core.native import dense, intrinsics, native
from sf_tracking.core.patches import Patches
from sf_tracking.core.shape import Shape, ShapeFit, shape_of
from sf_tracking.core.update import View

_LANDMARK_SIGMA = 0.2  # relative deviation of inverse depth up to which a patch is published as a landmark
SHEAR = (0.2, 5.0)  # change of a patch's area between two views, beyond which it is not looked for
_WAITED = 2.0  # flow and loss of overlap, relative to what makes a keyframe, up to which depth is waited for
_MIN_FLOW = 0.25  # of the flow that makes a keyframe: without it a loss of overlap is no reason for one


@dataclass(slots=True)
class TrackedKeyframe:
    """A keyframe inside the optimisation window; its pose and the depth of its patches still move."""

    frame: Frame
    view: View
    patches: Patches
    described: Any  # of the patches, by the update operator
    T_cw: Float64  # world to camera
    seen: dict[int, tuple[Float64, Float64]] = field(default_factory=dict)  # stamp -> uv [M, 2], information [M, 2, 2]
    shape: Shape | None = None  # of its depth, once asked for
    moved: dict[int, ShapeFit] = field(default_factory=dict)  # stamp -> T_other_self by alignment of the shapes
    best_share: float = 0.0  # of its patches found in one frame so far

    @property
    def camera(self) -> Camera:
        """Intrinsics; the tracker only takes frames that have them."""
        assert self.frame.camera is not None
        return self.frame.camera

    def measured_shape(self, config: TrackingConfig) -> Shape | None:
        """The surface of its depth, made when first asked for; None without depth."""
        if self.shape is None:
            self.shape = shape_of(self.frame, config)
        return self.shape

    def final(self, scale: Scale) -> Keyframe:
        """What leaves the window: the pose is final now."""
        camera, frame, patches = self.camera, self.frame, self.patches
        assert frame.image is not None
        depth: DepthMap | None = frame.depth
        if frame.sparse_depth is not None:
            depth = frame.sparse_depth.to_map(camera.height, camera.width)
        known = (patches.w > 0) & (patches.sigma < _LANDMARK_SIGMA * patches.w)
        points = patches.points(camera)[known].astype(np.float32)
        landmarks = PointCloud(points, None, None, frame.stamp_ns, camera.frame_id)
        return Keyframe(frame.stamp_ns, camera, frame.image, se3.inverse(self.T_cw), depth, landmarks, scale)


@dataclass(frozen=True, slots=True)
class Reprojection:
    """The patches of one keyframe as another view has them."""

    uv: Float64  # [M, 2] px
    warp: Float64  # [M, 2, 2] how offsets from the patch centre map
    J_w: Float64  # [M, 2] d(uv)/d(inverse depth)
    w: Float64  # [M] inverse depth there
    visible: NDArray[np.bool_]  # [M] inside the image and not too distorted


def reproject(keyframe: TrackedKeyframe, T_cw: Float64) -> Reprojection:
    """All patches of a keyframe in the view of a camera at T_cw: Pi(G_ij Pi^-1(P'_k)) with its derivatives.

    Compiled; :mod:`.reproject_reference` is the same in numpy.
    """
    camera, patches = keyframe.camera, keyframe.patches
    T = T_cw @ se3.inverse(keyframe.T_cw)
    return Reprojection(
        *native().reproject(
            intrinsics(camera), T, dense(patches.uv), dense(patches.w), dense(patches.slope),
            camera.width, camera.height, *SHEAR,
        )
    )  # fmt: skip


def wants_keyframe(
    config: TrackingConfig, keyframe: TrackedKeyframe, flow_px: Float64, share: float, *, measured: bool = True
) -> bool:
    """Enough motion for new information, or too little overlap to go on with the old patches.

    The overlap counts relative to the best since the keyframe was made, so that a scene half of which moves
    does not make a keyframe of every frame. Where the keyframe has depth and the frame lacks it, a frame
    that has it is waited for.

    Args:
        flow_px: displacement of the keyframe's patches found in the frame, [E] px.
        share: how many of its patches were found again, 0 to 1.
        measured: the frame has depth.
    """
    flow = float(flow_px.mean()) / (config.keyframe_flow * keyframe.camera.width) if len(flow_px) else 1.0
    keyframe.best_share = max(keyframe.best_share, share)
    wait = 1.0 if measured or not keyframe.patches.measured.any() else _WAITED
    return flow > wait or (flow > _MIN_FLOW and share < config.keyframe_overlap / wait * keyframe.best_share)
