"""The kernels under the address and undefined-behaviour sanitizers: a C++ program without Python, by g++ alone."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
KERNELS = {
    "depth": ("dense_ba", "diffusion", "plane_sweep"),
    "recon": ("color_decoder", "ipr_bins", "ipr_cpu", "point_grid", "rows", "view_blend"),
    "tracking": ("align", "bundle", "pose", "reproject", "surface"),
}
# Run-time choice of vectors is off: it picks the function before the sanitizer has started.
FLAGS = [
    "-std=c++17",
    "-O1",
    "-g",
    "-Wno-psabi",
    "-ffp-contract=off",
    "-DSF_NO_CLONES",
    "-fopenmp",
    "-fno-omit-frame-pointer",
]
SANITIZERS = ["-fsanitize=address,undefined,float-cast-overflow", "-fno-sanitize-recover=all"]


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="no g++")
@pytest.mark.parametrize("block", KERNELS)
def test_hostile_input_under_the_sanitizers(block: str, tmp_path: Path) -> None:
    csrc, program = ROOT / f"sf_{block}" / "csrc", tmp_path / "kernels_test"
    sources = [str(ROOT / "tests" / block / "csrc" / "kernels_test.cpp")]
    sources += [str(csrc / f"{name}.cpp") for name in KERNELS[block]]
    build = [
        "g++",
        *FLAGS,
        *SANITIZERS,
        f"-I{csrc}",
        f"-I{ROOT / 'sf_interfaces' / 'include'}",
        *sources,
        "-o",
        str(program),
    ]
    subprocess.run(build, check=True, capture_output=True, text=True)
    run = subprocess.run([str(program)], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert "all kernels behave" in run.stdout
