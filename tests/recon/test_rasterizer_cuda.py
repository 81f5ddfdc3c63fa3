"""The CUDA rasteriser: it compiles where nvcc is, and equals the CPU where a GPU is."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch

from sf_interfaces.errors import ConfigError
from sf_recon.core.native import native
from sf_recon.core.rasterizer import rasterize
from sf_recon.core.rasterizer_cuda import CudaRasterizer
from tests.recon.test_rasterizer import CAMERA, CLOUDS, EVERYTHING, OPTIONS, POSE

CSRC = Path(__file__).resolve().parents[2] / "sf_recon" / "csrc"
BUILT = hasattr(native(), "CudaRasterizer")
needs_gpu = pytest.mark.skipif(
    not (BUILT and torch.cuda.is_available()),
    reason="no CUDA device" if BUILT else "the kernels are built without CUDA (-DSF_CUDA=ON)",
)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("nvcc") is None, reason="no CUDA compiler (nvcc)")
@pytest.mark.parametrize("architecture", ["75", "120"])  # the oldest and the newest that the build lists
def test_it_compiles(architecture: str, tmp_path: Path) -> None:
    command = ["nvcc", "-std=c++17", "-O1", "-fmad=false", "-Werror", "all-warnings", "-Xcompiler=-Wall,-fPIC"]
    code = f"arch=compute_{architecture},code=sm_{architecture}"
    command += ["-gencode", code, "-c", str(CSRC / "ipr_cuda.cu"), "-o", str(tmp_path / "ipr_cuda.o")]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    if "Unsupported gpu architecture" in run.stderr:
        pytest.skip(f"this nvcc does not know sm_{architecture}")
    assert run.returncode == 0, run.stderr


@pytest.mark.skipif(BUILT, reason="the kernels are built with CUDA")
def test_without_cuda_it_says_how_to_build() -> None:
    with pytest.raises(ConfigError, match="SF_CUDA=ON"):
        CudaRasterizer()


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
def test_streams_and_growing_clouds_share_one_workspace() -> None:
    rasterizer = CudaRasterizer()
    for name in ("one", "dense", "empty", "scattered"):
        with torch.cuda.stream(torch.cuda.Stream()):
            got = rasterizer.rasterize(torch.from_numpy(CLOUDS[name]).cuda(), CAMERA, POSE, OPTIONS)
            depth = got["depth"].cpu()
        np.testing.assert_allclose(depth, rasterize(CLOUDS[name], CAMERA, POSE, OPTIONS).depth, rtol=1e-5)
