"""The CUDA rasteriser: it compiles where nvcc is, and equals the CPU where a GPU is."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import settings

from sf_interfaces.errors import ConfigError
from sf_interfaces.types import Camera
from sf_recon.config import ReconConfig
from sf_recon.core.ipr_reference import RasterOptions
from sf_recon.core.native import native
from sf_recon.core.rasterizer import make_rasterizer, rasterize
from sf_recon.core.rasterizer_cuda import CudaRasterizer
from tests.recon.test_rasterizer import ANY_CLOUD, CAMERA, CLOUDS, EVERYTHING, OPTIONS, POSE, assert_equals_definition

CSRC = Path(__file__).resolve().parents[2] / "sf_recon" / "csrc"
BUILT = hasattr(native(), "CudaRasterizer")
needs_gpu = pytest.mark.skipif(
    not (BUILT and torch.cuda.is_available()),
    reason="no CUDA device" if BUILT else "the kernels are built without CUDA (-DSF_CUDA=ON)",
)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("nvcc") is None, reason="no CUDA compiler (nvcc)")
@pytest.mark.parametrize("architecture", ["75", "120"])  # the oldest and the newest that the build lists
@pytest.mark.parametrize("source", ["ipr_cuda", "grid_cuda"])
def test_it_compiles(source: str, architecture: str, tmp_path: Path) -> None:
    command = ["nvcc", "-std=c++17", "-O1", "-fmad=false", "-Werror", "all-warnings", "-Xcompiler=-Wall,-fPIC"]
    code = f"arch=compute_{architecture},code=sm_{architecture}"
    command += ["-gencode", code, "-c", str(CSRC / f"{source}.cu"), "-o", str(tmp_path / "kernels.o")]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    if "Unsupported gpu architecture" in run.stderr:
        pytest.skip(f"this nvcc does not know sm_{architecture}")
    assert run.returncode == 0, run.stderr


@pytest.mark.skipif(BUILT, reason="the kernels are built with CUDA")
def test_without_cuda_it_says_how_to_build() -> None:
    with pytest.raises(ConfigError, match="SF_CUDA=ON"):
        make_rasterizer(ReconConfig(device="cuda"))


@needs_gpu
@pytest.mark.parametrize("name", CLOUDS)
@pytest.mark.parametrize("with_normals", [False, True])
def test_it_equals_the_cpu(name: str, with_normals: bool) -> None:
    cloud = CLOUDS[name].astype(np.float32)
    normals = np.random.default_rng(1).normal(size=cloud.shape).astype(np.float32) if with_normals else None
    expected = rasterize(cloud, CAMERA, POSE, OPTIONS, outputs=EVERYTHING, normals=normals)
    on_device = None if normals is None else torch.from_numpy(normals).cuda()
    got = CudaRasterizer().rasterize(
        torch.from_numpy(cloud).cuda(), CAMERA, POSE, OPTIONS, outputs=EVERYTHING, normals=on_device
    )
    np.testing.assert_array_equal(got["index"].cpu(), expected.index)
    np.testing.assert_allclose(got["depth"].cpu(), expected.depth, rtol=1e-5, equal_nan=True)
    np.testing.assert_allclose(got["position"].cpu(), expected.position, rtol=1e-4, atol=1e-5, equal_nan=True)
    np.testing.assert_allclose(got["weight"].cpu(), expected.weight, rtol=1e-3, atol=1e-5)
    normal = got["normal"].cpu().numpy()
    both = np.isfinite(normal) & np.isfinite(expected.normal)
    assert (np.isfinite(normal) != np.isfinite(expected.normal)).mean() < 1e-2
    np.testing.assert_allclose(normal[both], expected.normal[both], atol=2e-3)


@needs_gpu
@settings(max_examples=200, deadline=None)
@ANY_CLOUD
def test_it_equals_the_definition_on_any_cloud(**case: Any) -> None:
    assert_equals_definition(make_rasterizer(ReconConfig(device="cuda")), **case)


@needs_gpu
def test_streams_and_growing_clouds_share_one_workspace() -> None:
    rasterizer = CudaRasterizer()
    for name in ("one", "dense", "empty", "scattered"):
        with torch.cuda.stream(torch.cuda.Stream()):
            got = rasterizer.rasterize(torch.from_numpy(CLOUDS[name]).cuda(), CAMERA, POSE, OPTIONS)
            depth = got["depth"].cpu()
        np.testing.assert_allclose(depth, rasterize(CLOUDS[name], CAMERA, POSE, OPTIONS).depth, rtol=1e-5)


@needs_gpu
def test_clouds_of_the_cpu_are_sent_once_and_drawn_again_when_they_are_others() -> None:
    draw = make_rasterizer(ReconConfig(device="cuda"))
    for name in ("dense", "scattered", "dense", "one", "empty", "dense"):
        drawn = draw(CLOUDS[name], CAMERA, POSE, OPTIONS, outputs=("position", "index"))
        expected = rasterize(CLOUDS[name], CAMERA, POSE, OPTIONS, outputs=("position", "index"))
        np.testing.assert_array_equal(drawn.index, expected.index)
        np.testing.assert_allclose(drawn.depth, expected.depth, rtol=1e-5)
        assert drawn.normal is None


@needs_gpu
@pytest.mark.parametrize("radius", [0.001, 0.02])
def test_ten_million_points_equal_the_cpu(radius: float) -> None:
    points = np.random.default_rng(0).uniform([-1, -1, 0.1], [1, 1, 1], (10_000_000, 3)).astype(np.float32)
    camera, options = Camera(640, 480, 585, 585, 320, 240), RasterOptions(radius, 0.1, 0.02)
    drawn = CudaRasterizer().draw(points, camera, np.eye(4), options, outputs=("index",))
    expected = rasterize(points, camera, np.eye(4), options, outputs=("index",))
    np.testing.assert_array_equal(drawn.index, expected.index)
    np.testing.assert_allclose(drawn.depth, expected.depth, rtol=1e-5)
