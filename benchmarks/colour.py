"""Held-out colour on a real RGB-D recording, all methods with the same poses and depth.

    python benchmarks/colour.py FOLDER/rgbd_7scenes_redkitchen_000_199 [--step 10] [--frames 200] [--set k=v]
    sf simulate room0 room0.mcap --depth exact --mesh room0.ply
    python benchmarks/colour.py room0.mcap --mesh room0.ply --methods ours

Every ``step``-th frame is a keyframe; the frames half-way between are rendered and compared. Methods: the
reconstruction, the same without keyframe detail, Open3D's 5 mm colour TSDF ray-cast, and the keyframe before warped
by its own depth. With the true mesh of a simulated bag, the reconstructed one is measured too.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import time
from collections.abc import Callable
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
from common import Benchmark, load_frames, print_rows

from sf_bringup.evaluation import Samples, psnr, ssim
from sf_interfaces.config import ConfigFile
from sf_interfaces.geometry import se3
from sf_interfaces.io.datasets.indoor import SevenScenes
from sf_interfaces.types import Float64, Keyframe, UInt8
from sf_recon.config import ReconConfig
from sf_recon.core.mesh import extract
from sf_recon.core.reconstruction import Reconstruction

Drawn = tuple[UInt8, np.ndarray]  # image [H, W, 3], pixels the method fills [H, W]
Method = Callable[[Keyframe], Drawn]

_VOXEL, _TRUNCATION, _FAR = 0.005, 8.0, 5.0  # Open3D's usual setting for a Kinect


def load(data: Path, frames: int, step: int) -> tuple[list[Keyframe], list[Keyframe]]:
    """(keyframes, held-out frames) with registered depth, of a 7-Scenes folder or a simulated bag."""
    if data.is_dir():
        readers = list(islice(SevenScenes(data).samples(), frames))
        samples = {i: readers[i]().undistorted() for i in range(len(readers)) if i % step in (0, step // 2)}
        made = {i: Keyframe(s.stamp_ns, s.camera, s.image, s.pose, s.depth) for i, s in samples.items()}
    else:
        every = enumerate(load_frames(data)[:frames])
        made = {i: Keyframe(f.stamp_ns, f.camera, f.image, f.T_map_camera, f.depth) for i, f in every}
    keys = [k for i, k in made.items() if i % step == 0]
    return keys, [k for i, k in made.items() if i % step == step // 2]


def surface(built: Reconstruction, keys: list[Keyframe], truth: Path, count: int = 100_000) -> dict[str, float]:
    """Distances from samples of one mesh to the triangles of the other, where a keyframe saw the surface.

    A true sample counts if a keyframe's depth shows it: parts inside the furniture are nobody's to complete.
    """
    made, true = extract(built, built.config.mesh), o3d.io.read_triangle_mesh(str(truth))
    samples = [Samples(np.asarray(m.vertices), np.asarray(m.triangles)).draw(count) for m in (made, true)]
    seen = np.zeros(count, bool)
    for key in keys:
        uv, z = key.camera.project(se3.transform(se3.inverse(key.T_map_camera), samples[1]))
        column, row = np.floor(uv).astype(int).T
        inside = (z > 0) & (column >= 0) & (column < key.camera.width) & (row >= 0) & (row < key.camera.height)
        assert key.depth is not None
        seen[inside] |= np.abs(key.depth.z[row[inside], column[inside]] - z[inside]) < 0.01 * z[inside]
    accuracy, completion = _distance(samples[0], true), _distance(samples[1][seen], made)
    return {
        "Acc cm": 100 * float(accuracy.mean()),
        "Comp cm": 100 * float(completion.mean()),
        "ratio %": 100 * float((completion < 0.05).mean()),
    }


def _distance(points: Float64, mesh: o3d.geometry.TriangleMesh) -> np.ndarray:
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(mesh))
    return scene.compute_distance(o3d.core.Tensor(points.astype(np.float32))).numpy()


def ours(keys: list[Keyframe], config: ReconConfig, mesh: Path | None) -> tuple[Method, dict[str, Any]]:
    """The reconstruction, what it cost, and how good its surface is."""
    built = Reconstruction(config)
    started = time.perf_counter()
    for key in keys:
        built.add(key)
    built.finish()
    seconds = time.perf_counter() - started
    drawing: list[float] = []

    def draw(frame: Keyframe) -> Drawn:
        started = time.perf_counter()
        view = built.render(frame.camera, frame.T_map_camera)
        drawing.append(time.perf_counter() - started)
        return view.image, view.depth.valid

    facts = {"train s": round(seconds, 1), "points": len(built.surface()), "draw ms": drawing}
    return draw, facts if mesh is None else facts | surface(built, keys, mesh)


def tsdf(keys: list[Keyframe]) -> Method:
    """Open3D's colour TSDF and its ray caster."""
    names, kinds, sizes = ("tsdf", "weight", "color"), (o3d.core.float32,) * 3, ((1), (1), (3))
    grid = o3d.t.geometry.VoxelBlockGrid(names, kinds, sizes, _VOXEL, 16, 20000, o3d.core.Device("CPU:0"))
    K = o3d.core.Tensor(keys[0].camera.K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]))
    for key in keys:
        assert key.depth is not None
        depth = o3d.t.geometry.Image(np.nan_to_num(key.depth.z))
        color = o3d.t.geometry.Image(key.image.astype(np.float32) / np.float32(255))
        T = o3d.core.Tensor(se3.inverse(key.T_map_camera))
        blocks = grid.compute_unique_block_coordinates(depth, K, T, 1.0, _FAR, _TRUNCATION)
        grid.integrate(blocks, depth, color, K, K, T, 1.0, _FAR, _TRUNCATION)

    def draw(frame: Keyframe) -> Drawn:
        T = o3d.core.Tensor(se3.inverse(frame.T_map_camera))
        width, height, blocks = frame.camera.width, frame.camera.height, grid.hashmap().key_tensor()
        cast = grid.ray_cast(blocks, K, T, width, height, ["color", "depth"], 1.0, 0.2, _FAR, 1.0, _TRUNCATION)
        image = np.clip(np.rint(255 * cast["color"].numpy()), 0, 255).astype(np.uint8)
        return image, cast["depth"].numpy()[..., 0] > 0

    return draw


def warp(keys: list[Keyframe]) -> Method:
    """The last keyframe before a frame, its pixels moved by their own depth, nearest wins."""

    def draw(frame: Keyframe) -> Drawn:
        key = max((k for k in keys if k.stamp_ns < frame.stamp_ns), key=lambda k: k.stamp_ns)
        assert key.depth is not None
        valid, camera = key.depth.valid, key.camera
        T = se3.inverse(frame.T_map_camera) @ key.T_map_camera
        local = camera.unproject(camera.pixel_grid()[valid], key.depth.z[valid].astype(np.float64))
        uv, z = camera.project(se3.transform(T, local))
        column, row = np.floor(uv).astype(int).T
        inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height) & (z > 0)
        order = np.argsort(-z[inside], kind="stable")
        at = row[inside][order], column[inside][order]
        image, filled = np.zeros_like(frame.image), np.zeros(frame.image.shape[:2], bool)
        image[at], filled[at] = key.image[valid][inside][order], True
        return image, filled

    return draw


def gain_bias(image: UInt8, truth: UInt8, mask: np.ndarray) -> Float64:
    """The image after the best gain and bias of each channel."""
    out = np.zeros(truth.shape)
    for c in range(3):
        x, y = image[mask][:, c].astype(float), truth[mask][:, c].astype(float)
        gain, bias = np.polyfit(x, y, 1) if x.std() > 0 else (1.0, 0.0)
        out[..., c] = np.clip(gain * image[..., c] + bias, 0, 255)
    return out


def score(method: Method, held: list[Keyframe], others: list[np.ndarray] | None) -> dict[str, float]:
    """Means over the held-out frames; ``others`` are the pixels that the warped keyframe fills."""
    rows = []
    for index, frame in enumerate(held):
        image, filled = method(frame)
        corrected = np.rint(gain_bias(image, frame.image, filled)).astype(np.uint8)
        row = {
            "PSNR filled": psnr(image, frame.image, filled),
            "gain/bias": psnr(corrected, frame.image, filled),
            "filled %": 100 * float(filled.mean()),
            "PSNR whole": psnr(image, frame.image),
            "SSIM": ssim(image, frame.image),
        }
        if others is not None:
            row["PSNR warp's"] = psnr(image, frame.image, others[index])
        rows.append(row)
    return {name: round(float(np.mean([r[name] for r in rows])), 3) for name in rows[0]}


def main() -> None:
    """Build, render, compare."""
    bench = Benchmark("colour", __doc__ or "")
    bench.parser.add_argument("recording", type=Path, nargs="?", help="a 7-Scenes sequence, or a simulated bag")
    bench.parser.add_argument("--data", type=Path, help="in its place: a folder that holds such a sequence")
    bench.parser.add_argument("--mesh", type=Path, help="true surface of a simulated bag")
    bench.parser.add_argument("--frames", type=int, default=200)
    bench.parser.add_argument("--step", type=int, default=10)
    bench.parser.add_argument("--methods", nargs="+", default=["ours", "field", "tsdf", "warp"])
    bench.parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="of section recon")
    args = bench.parse()
    folders = sorted((args.data or Path()).iterdir())
    recording = args.recording or next((folder for folder in folders if SevenScenes.matches(folder)), None)
    if recording is None:
        bench.parser.error(f"no 7-Scenes sequence in {args.data or Path()}; name one, or a simulated bag")
    keys, held = load(recording, args.frames, args.step)
    given = dict(pair.split("=", 1) for pair in args.set)
    filled = [warp(keys)(frame)[1] for frame in held]
    rows = []
    for name in args.methods:
        facts: dict[str, Any] = {}
        if name in ("ours", "field"):
            values = given | ({"detail": "0"} if name == "field" else {})
            config = ConfigFile.load(None, {f"recon.{k}": v for k, v in values.items()}).build("recon", ReconConfig)
            method, facts = ours(keys, config, args.mesh)
        else:
            method = {"tsdf": tsdf, "warp": warp}[name](keys)
        measured = score(method, held, filled)
        if "draw ms" in facts:
            facts["draw ms"] = round(1e3 * float(np.median(facts["draw ms"])))
        rows.append({"method": name, **measured, **facts})
    print_rows(rows)
    bench.write(
        "Held-out colour, all methods with the same poses and depth",
        {f"{len(keys)} keyframes, {len(held)} held out": rows},
    )


if __name__ == "__main__":
    main()
