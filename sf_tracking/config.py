"""Configuration of the tracking block."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass

from sf_interfaces.config import option


@dataclass(frozen=True, slots=True)
class TrackingConfig:
    """Defaults suit 640x480 to 1242x375 images at 10 to 30 Hz."""

    operator: str = option("patches", "update operator: patches (alignment) or dpvo (network)")
    checkpoint: str = option("", "file of the DPVO network's weights, for operator dpvo")
    patches: int = option(200, "patches per keyframe (M); three times as many without depth", low=20, high=4000)
    window: int = option(9, "keyframes whose patches are aligned and whose poses are optimised", low=3, high=100)
    edges: int = option(600, "patches aligned to a frame that becomes no keyframe", low=50, high=20000)
    patch_px: int = option(11, "side of an aligned patch, px", low=5, high=41)
    search_px: int = option(15, "side of a patch in the search over levels, px", low=5, high=41)
    levels: int = option(3, "pyramid levels above full resolution once motion is known", low=0, high=6)
    wide_levels: int = option(5, "pyramid levels while the motion is unknown", low=0, high=8)
    iterations: int = option(5, "steps of an alignment at most", low=1, high=50)
    max_residual: float = option(20.0, "grey-level residual above which an edge is rejected", low=1.0)
    min_explained: float = option(0.7, "share of a patch's variance that has to be found again", low=0.0, high=1.0)
    image_sigma: float = option(2.0, "noise of grey levels, below which a residual says nothing", low=0.1)
    position_sigma: float = option(0.05, "floor of an edge's standard deviation, px", low=0.001)
    robust_sigmas: float = option(3.0, "error where the robust kernel sets in, standard deviations", low=0.1)
    bundle_iterations: int = option(4, "steps of a bundle adjustment", low=1, high=50)
    damping: float = option(0.5, "share of the last motion that predicts the next", low=0.0, high=1.0)
    min_inliers: int = option(25, "edges that a pose has to agree with", low=6)
    inlier_px: float = option(2.0, "reprojection error of an agreeing edge, px", low=0.1)
    keyframe_flow: float = option(0.05, "mean flow that makes a keyframe, as part of the image width", low=0.001)
    keyframe_overlap: float = option(0.6, "share of patches still aligned below which a keyframe is made", high=1.0)
    renew_s: float = option(60.0, "a place seen again makes a keyframe after so long, each time twice as late", low=0.0)
    parallax: float = option(0.005, "flow without rotation that starts a map without depth, per width", low=0.001)
    depth_gap: float = option(0.05, "relative depth step near a patch above which it is rejected", low=0.0)
    depth_sigma: float = option(0.004, "noise of dense inverse depth, 1/m (depth errs with z^2)", low=1e-6)
    registration_px: float = option(1.0, "how well depth is registered to the image, standard deviation, px", low=0.0)
    shape_trust: float = option(1.0, "how much aligned surfaces count beside patches; 0: not at all", low=0.0, high=1.0)
    shape_keyframes: int = option(3, "keyframes to whose surface that of a new keyframe is aligned", low=0, high=20)
    lidar_sigma: float = option(0.015, "noise of LiDAR depth, m", low=1e-4)
    min_quality: float = option(0.002, "corner quality of a patch relative to the image's best", low=0.0, high=1.0)
    max_depth: float = option(80.0, "measured depths beyond are not used, m", low=0.1)
    readout_s: float = option(
        0.0, "s from the first to the last row of a rolling shutter; 0: global", low=-0.1, high=0.1
    )
    depth_readout_s: float = option(0.0, "the same of depth images", low=-0.1, high=0.1)
    loops: bool = option(True, "close loops: correct the keyframes where the camera comes back to a known place")
    patience: int = option(8, "lost frames after which the whole map is searched", low=1)
    seed: int = option(0, "seed of the wide search")
