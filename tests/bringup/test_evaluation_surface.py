"""Measures of surfaces and images on cases with known answers."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from sf_bringup import cli
from sf_bringup.eval_files import read_surface
from sf_bringup.evaluation import Samples, psnr, ssim, surface_error
from sf_bringup.evaluation.lpips import Lpips
from sf_bringup.evaluation.mesh import icp, seen_by_any
from sf_bringup.evaluation.seen_surface import seen_surface_error
from sf_interfaces.errors import FormatError
from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera

SQUARE = np.array([[0, 1, 2], [0, 2, 3]])


def square(z: float, side: float = 1.0) -> Samples:
    """A square of the plane at height z, centred, m."""
    h = side / 2
    return Samples(np.array([[-h, -h, z], [h, -h, z], [h, h, z], [-h, h, z]]), SQUARE)


def test_parallel_planes_are_as_far_apart_as_they_are() -> None:
    error = surface_error(square(0.0), square(0.02), samples=20_000)
    # Samples lie up to their spacing of 7 mm beside each other, so the distance is a little more than the gap.
    assert 2.0 < error.accuracy < 2.1 and 2.0 < error.completion < 2.1
    assert error.completion_ratio == error.precision == error.f_score == 100
    far = surface_error(square(0.0), square(0.5), samples=5000)
    assert far.completion_ratio == far.f_score == 0 and far.accuracy == pytest.approx(50, abs=0.1)


def test_half_a_surface_is_accurate_but_not_complete() -> None:
    half = Samples(square(0.0).vertices * (0.5, 1, 1) + (0.25, 0, 0), SQUARE)
    error = surface_error(half, square(0.0), samples=50_000)
    assert error.accuracy < 0.5 and error.precision == 100
    assert error.completion == pytest.approx(12.5, abs=0.5)  # the missing half lies 0..50 cm away, 25 on average
    assert error.completion_ratio == pytest.approx(55, abs=1)  # half, and 5 of the missing 50 cm
    assert error.f_score == pytest.approx(2 * 100 * 55 / 155, abs=1)


def test_nice_culling_ignores_what_no_view_sees() -> None:
    camera = Camera(100, 100, 100.0, 100.0, 50.0, 50.0)  # sees the unit square at z = 1
    poses = np.eye(4)[None]
    wide = Samples(np.concatenate([square(1.0).vertices, square(-3.0).vertices]), np.concatenate([SQUARE, SQUARE + 4]))
    culled = surface_error(square(1.0), wide, (camera, poses), samples=20_000)
    assert culled.completion_ratio == 100 and culled.samples == pytest.approx(10_000, rel=0.05)
    assert surface_error(square(1.0), wide, samples=20_000).completion_ratio == pytest.approx(50, abs=2)
    edge = np.array([[0.499, 0, 1], [0.501, 0, 1], [0, 0, -1]])
    assert seen_by_any(edge, camera, poses).tolist() == [True, False, False]
    with pytest.raises(FormatError, match="one frame"):
        surface_error(square(-1.0), wide, (camera, poses), samples=1000)


def test_what_is_hidden_does_not_count_and_equal_surfaces_have_no_distance() -> None:
    camera = Camera(100, 100, 100.0, 100.0, 50.0, 50.0)  # sees the unit square at z = 1, and one hidden behind it
    poses = np.eye(4)[None]
    both = Samples(np.concatenate([square(1.0).vertices, square(1.5).vertices]), np.concatenate([SQUARE, SQUARE + 4]))
    error = seen_surface_error(square(1.0), both, camera, poses, samples=5000)
    assert error.accuracy == pytest.approx(0, abs=1e-4) and error.completion == pytest.approx(0, abs=1e-4)
    assert error.completion_ratio == 100 and error.samples == pytest.approx(2500, rel=0.1)
    off = seen_surface_error(square(1.02), both, camera, poses, samples=5000)
    assert off.accuracy == pytest.approx(2, abs=1e-3) and off.completion == pytest.approx(2, abs=1e-3)
    cloud = Samples(square(1.0).draw(50_000), np.zeros((0, 3), np.int64))
    assert seen_surface_error(cloud, both, camera, poses, samples=5000).completion < 0.4
    with pytest.raises(FormatError, match="triangles"):
        seen_surface_error(square(1.0), cloud, camera, poses)
    with pytest.raises(FormatError, match="one frame"):
        seen_surface_error(square(-1.0), both, camera, poses, samples=100)


def test_icp_finds_a_small_motion() -> None:
    corner = Samples(
        np.concatenate([square(0.0).vertices, square(0.0).vertices[:, [2, 0, 1]], square(0.0).vertices[:, [0, 2, 1]]]),
        np.concatenate([SQUARE + 4 * k for k in range(3)]),
    )
    T = se3.exp(np.array([0.02, -0.01, 0.015, 0.01, 0.0, -0.01]))
    found = icp(corner.moved(T), corner, samples=5000)
    assert np.abs(se3.log(found @ T)).max() < 3e-3
    with pytest.raises(FormatError, match="ICP"):
        icp(square(5.0), corner, samples=100)


def test_empty_surfaces_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    nothing = Samples(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    with pytest.raises(FormatError, match="empty"):
        surface_error(nothing, square(0.0))
    with pytest.raises(FormatError, match="area"):
        Samples(np.zeros((3, 3)), np.array([[0, 1, 2]])).draw(10)
    empty = tmp_path / "empty.ply"
    header = ["ply", "format ascii 1.0", "element vertex 0", *(f"property float {c}" for c in "xyz"), "end_header"]
    empty.write_text("\n".join(header) + "\n")
    with pytest.raises(FormatError, match="empty"):
        read_surface(empty)
    assert cli.main(["eval", "mesh", str(empty), "--reference", str(empty)]) == 2
    assert "empty.ply is empty" in capsys.readouterr().err
    assert cli.main(["eval", "mesh", str(tmp_path / "no.ply"), "--reference", str(empty)]) == 2


def test_psnr_of_a_known_error() -> None:
    black = np.zeros((4, 4, 3), np.uint8)
    assert psnr(black, black) == float("inf")
    assert psnr(np.full_like(black, 255), black) == pytest.approx(0.0)
    mask = np.zeros((4, 4), bool)
    mask[0, 0] = True
    half = black.copy()
    half[1:] = 255
    assert psnr(half, black, mask) == float("inf")


def naive_ssim(x: np.ndarray, y: np.ndarray) -> float:
    """The definition, window by window, of one channel in [0, 1]."""
    t = np.arange(11) - 5
    w = np.exp(-(t[:, None] ** 2 + t**2) / (2 * 1.5**2))
    w /= w.sum()
    values = []
    for r in range(x.shape[0] - 10):
        for c in range(x.shape[1] - 10):
            a, b = x[r : r + 11, c : c + 11], y[r : r + 11, c : c + 11]
            ma, mb = (w * a).sum(), (w * b).sum()
            va, vb, ab = (w * (a - ma) ** 2).sum(), (w * (b - mb) ** 2).sum(), (w * (a - ma) * (b - mb)).sum()
            values.append((2 * ma * mb + 1e-4) * (2 * ab + 9e-4) / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4)))
    return float(np.mean(values))


def test_ssim_equals_its_definition() -> None:
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (24, 30, 3), np.uint8)
    noisy = np.clip(image + rng.normal(0, 20, image.shape), 0, 255).astype(np.uint8)
    expected = np.mean([naive_ssim(image[..., k] / 255, noisy[..., k] / 255) for k in range(3)])
    assert ssim(image, noisy) == pytest.approx(expected, abs=1e-12) and 0.5 < expected < 0.99
    assert ssim(image, image) == 1.0
    dark, bright = np.full((20, 20), 51, np.uint8), np.full((20, 20), 102, np.uint8)
    assert ssim(dark, bright) == pytest.approx((2 * 0.2 * 0.4 + 1e-4) / (0.2**2 + 0.4**2 + 1e-4))
    with pytest.raises(FormatError, match="11x11"):
        ssim(dark[:8], bright[:8])
    with pytest.raises(FormatError, match="size"):
        psnr(dark, image)


def test_lpips_needs_its_weights_and_is_zero_for_equal_images(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SF_LPIPS", str(tmp_path))
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path / "hub"))
    with pytest.raises(FormatError, match="SF_LPIPS"):
        Lpips.find()
    g = torch.Generator().manual_seed(0)
    shapes = ((0, 64, 3, 11), (3, 192, 64, 5), (6, 384, 192, 3), (8, 256, 384, 3), (10, 256, 256, 3))
    weights = {f"features.{k}.weight": torch.randn(o, i, n, n, generator=g) / 9 for k, o, i, n in shapes}
    weights |= {f"features.{k}.bias": torch.zeros(o) for k, o, _, _ in shapes}
    torch.save(weights, tmp_path / "alexnet-owt-7be5be79.pth")
    linear = {f"lin{j}.model.1.weight": torch.ones(1, o, 1, 1) / o for j, (_, o, _, _) in enumerate(shapes)}
    torch.save(linear, tmp_path / "alex.pth")
    distance = Lpips.find()
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (70, 80, 3), np.uint8)
    near = np.clip(image + rng.normal(0, 8, image.shape), 0, 255).astype(np.uint8)
    assert distance(image, image) == 0
    assert 0 < distance(image, near) < distance(image, rng.integers(0, 256, image.shape, np.uint8))
