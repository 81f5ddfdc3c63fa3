"""Configuration of the reconstruction block."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass

from sf_interfaces.config import option

MESHES = ("none", "tsdf", "poisson")


@dataclass(frozen=True, slots=True)
class ReconConfig:
    """All lengths scale with ``resolution``, so that a desk and a campus use the same settings."""

    resolution: float = option(
        0.0, "spacing of the finest points, m; 0: the median pixel footprint of the first keyframe", low=0.0
    )
    min_resolution: float = option(0.005, "lower bound of the automatic resolution for metric depth, m", low=0.0)
    levels: int = option(3, "number of resolutions", low=1, high=8)
    multiplier: float = option(4.0, "ratio of successive resolutions", low=1.5, high=16.0)
    features: int = option(6, "length of a point's feature on each level; the first three hold colour", low=3, high=64)
    neighbours: int = option(4, "points interpolated on each level (K)", low=1, high=16)
    sigma: float = option(1.0, "interpolation weight exp(-d2 / (sigma * resolution2))", low=0.01, high=100.0)
    hidden: int = option(32, "width of the two hidden layers of the colour network", low=4, high=256)
    view_directions: bool = option(True, "the viewing direction enters the colour network (a light field)")
    detail: int = option(4, "nearest keyframe images that refine a drawn view; 0: the colour network alone", low=0)
    detail_reach: float = option(
        0.5, "view distance (rotation in rad plus translation over depth) up to which they do", low=0.01
    )
    sharpen: int = option(3, "nearest keyframes that cut near surfaces back to their borders; 0: none", low=0)
    fill_holes: bool = option(True, "colour pixels without a surface from the nearest keyframe image (depth stays NaN)")
    iterations: int = option(40, "training iterations for each keyframe", low=0)
    final_iterations: int = option(200, "training iterations after the last keyframe", low=0)
    pixels: int = option(4096, "pixels of one training iteration (n_train)", low=1)
    feature_rate: float = option(1e-2, "Adam step of the features", low=0.0)
    network_rate: float = option(1e-3, "Adam step of the colour network", low=0.0)
    jump_iterations: int = option(5, "first iterations with ten times the step", low=0)
    max_relative_sigma: float = option(
        0.1, "largest depth standard deviation used, as a fraction of the depth", low=0.0
    )
    merge_gap: float = option(
        4.0,
        "depth within this many resolutions of the surface drawn so far adds no points; 0: always add",
        low=0.0,
    )
    memory_mb: float = option(0.0, "budget for points and keyframe images, MB; 0: none", low=0.0)
    mesh: str = option("tsdf", "mesh.ply at the end of a run: none, tsdf or poisson")
    mesh_voxel: float = option(
        0.0, "voxel of the mesh, in resolutions; 0: one, or two where the map is large", low=0.0, high=16.0
    )
    live_turns: int = option(200, "live: training iterations of a keyframe after which it rests", low=1)
    view_port: int = option(0, "live: port of the viewer's page on this machine; 0: none", low=0, high=65535)
    psnr_goal: float = option(25.0, "live: timing.json says how long a keyframe takes to reach this, dB", low=0.0)
    rasterizer: str = option("native", "native (compiled) or reference (numpy, slow)")
    device: str = option("cpu", "cpu, or cuda to draw and learn on a GPU (a build with SF_CUDA, a CUDA build of torch)")
    k_ray: int = option(8, "points drawn into one pixel at most (K_ray)", low=1, high=64)
    coverage: float = option(2.0, "side of a point's window on screen, in resolutions", low=0.1, high=10.0)
    layer_gap: float = option(4.0, "step in depth that ends the first layer, in resolutions", low=0.0)
    ray_sigma: float = option(0.5, "screen weight exp(-q2 / ray_sigma), q in half-widths of the window", low=0.01)
    max_window: int = option(64, "cap of a window's half-width, px", low=1, high=1024)
    threads: int = option(0, "threads of the compiled kernels; 0: all", low=0)
    seed: int = option(0, "seed of all random draws", low=0)
