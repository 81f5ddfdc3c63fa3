"""The Gaussian process against its dense solution; bases, holes, calibration, real recordings."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator

from sf_bringup.simulate.simulator import Simulator
from sf_bringup.simulate.spec import SimulationSpec
from sf_depth.config import DepthConfig
from sf_depth.core import gaussian_process as gp
from sf_depth.core.conditioning import choose, observe
from sf_depth.core.depthcov import DepthCov, DepthCovNet
from sf_depth.core.scalecov import complete
from sf_interfaces.errors import ConfigError, FormatError
from sf_interfaces.geometry.lidar import project_sweep
from sf_interfaces.types import Camera, DepthMap

CONFIG = DepthConfig()


@pytest.fixture(scope="module")
def rooms() -> list[tuple[np.ndarray, np.ndarray]]:
    """Image and exact depth of a simulated room, twice."""
    simulator = Simulator(SimulationSpec("room1", width=320, height=240, focal=240.0, supersampling=1, seed=3))
    return [simulator.frame(index)[:2] for index in (0, 90)]


def points(rng: np.random.Generator, count: int) -> gp.Points:
    x = rng.uniform(0, 20, (1, count, 2)).astype(np.float32)
    a = rng.standard_normal((1, count, 2, 2))
    E = 9.0 * (a @ a.transpose(0, 1, 3, 2) + np.eye(2))
    shape = np.stack([E[..., 0, 0], E[..., 0, 1], E[..., 1, 1]], axis=-1).astype(np.float32)
    feature = rng.standard_normal((1, count, 2)).astype(np.float32)
    return gp.Points(torch.from_numpy(x), torch.from_numpy(shape), torch.from_numpy(feature))


def dense_kernel(a: gp.Points, b: gp.Points) -> np.ndarray:
    """The covariance function written out for every pair, in double precision."""
    K = np.empty((a.x.shape[1], b.x.shape[1]))
    for i in range(K.shape[0]):
        for j in range(K.shape[1]):
            E1, E2 = (np.array([[e[0], e[1]], [e[1], e[2]]], float) for e in (a.E[0, i].numpy(), b.E[0, j].numpy()))
            d = (a.x[0, i] - b.x[0, j]).double().numpy()
            r = np.sqrt(3 * 0.5 * d @ np.linalg.solve(E1 + E2, d))
            norm = 2 * (np.linalg.det(E1) * np.linalg.det(E2)) ** 0.25 / np.sqrt(np.linalg.det(E1 + E2))
            off = float(((a.feature[0, i] - b.feature[0, j]).double() ** 2).sum())
            K[i, j] = norm * (1 + r) * np.exp(-r) * np.exp(-0.5 * off)
    return K


def test_regression_equals_the_dense_solution() -> None:
    rng = np.random.default_rng(0)
    n, f = points(rng, 20), points(rng, 30)
    s, noise = rng.standard_normal(20), rng.uniform(0.05, 0.2, 20)
    mean, variance = gp.predict(gp.condition(n, torch.tensor(s[None]).float(), torch.tensor(noise[None]).float()), f)
    K_fn, K_nn = dense_kernel(f, n), dense_kernel(n, n) + np.diag(noise)
    np.testing.assert_allclose(mean[0], K_fn @ np.linalg.solve(K_nn, s), atol=2e-3)
    np.testing.assert_allclose(variance[0], 1 - (K_fn * np.linalg.solve(K_nn, K_fn.T).T).sum(1), atol=2e-3)


def test_a_tile_in_a_gap_sees_all_sides_of_it_once() -> None:
    measured = np.ones((200, 200), bool)
    cv2.circle(hole := np.zeros((200, 200), np.uint8), (100, 100), 40, 1, -1)
    measured[hole > 0] = False
    observed = observe(np.ones((200, 200), np.float32), np.zeros((200, 200), np.float32), measured)
    chosen = observed.index[choose(observed, np.array([[105.0, 90.0]]), 16)[0].numpy()]
    assert len(np.unique(chosen, axis=0)) == 16
    nearest = np.argwhere(measured)
    nearest = nearest[np.argsort(((nearest - [105, 90]) ** 2).sum(1), kind="stable")[:16]]
    assert widest_gap(chosen) < np.radians(120) < np.radians(240) < widest_gap(nearest)


def widest_gap(pixels: np.ndarray) -> float:
    """Greatest angle seen from (105, 90) without a pixel."""
    angle = np.sort(np.arctan2(pixels[:, 0] - 105.0, pixels[:, 1] - 90.0))
    return float(np.diff(np.append(angle, angle[0] + 2 * np.pi)).max())


def test_hidden_observations_are_never_chosen() -> None:
    measured = np.random.default_rng(0).random((120, 120)) < 0.05
    observed = observe(np.ones((120, 120), np.float32), np.zeros((120, 120), np.float32), measured)
    center, radius = observed.index[:50].astype(float), np.linspace(0, 20, 50)
    chosen = observed.index[choose(observed, center, 16, excluded=radius).numpy()]
    assert (np.linalg.norm(chosen - center[:, None], axis=2) > radius[:, None]).all()


def test_a_base_of_unknown_scale_gives_its_structure(rooms: list[tuple[np.ndarray, np.ndarray]]) -> None:
    image, truth = rooms[0]
    row, col = np.mgrid[:240, :320]
    base = (0.13 * truth * np.exp(0.1 * np.sin(row / 60.0) * np.cos(col / 80.0))).astype(np.float32)
    kept = np.random.default_rng(1).random(truth.shape) < 0.002
    observed = DepthMap(np.where(kept, truth, np.nan))
    with_base, without = (np.abs(complete(b, observed, image, CONFIG).z / truth - 1) for b in (base, None))
    assert np.median(with_base) < 0.02 and with_base.mean() < 0.5 * without.mean()


@pytest.mark.parametrize("index", [0, 1])
def test_a_room_is_completed_better_than_by_interpolation(
    rooms: list[tuple[np.ndarray, np.ndarray]], index: int
) -> None:
    image, truth = rooms[index]
    rng = np.random.default_rng(2)
    kept = (rng.random(truth.shape) < 0.25) & (np.arange(240) % 5 == 0)[:, None]
    noisy = truth * (1 + 0.002 * rng.standard_normal(truth.shape))
    depth = complete(None, DepthMap(np.where(kept, noisy, np.nan)), image, DepthConfig(depth_sigma=0.001))
    pixels, grid = np.argwhere(kept), np.argwhere(~kept)
    linear = LinearNDInterpolator(pixels, noisy[kept])(grid)
    linear = np.where(np.isfinite(linear), linear, NearestNDInterpolator(pixels, noisy[kept])(grid))
    error = np.abs(depth.z - truth)[~kept]
    assert error.mean() < 0.85 * np.abs(linear - truth[~kept]).mean()
    measured_error = np.abs(depth.z - noisy)[~kept]
    assert 0.55 < (measured_error < np.sqrt(depth.variance[~kept])).mean() < 0.8


def test_the_noise_of_observations_is_heeded() -> None:
    rng = np.random.default_rng(4)
    image, kept = np.full((120, 160), 90, np.uint8), rng.random((120, 160)) < 0.1
    z = np.where(kept, 4.0 + 0.01 * rng.standard_normal(kept.shape), np.nan)
    z[:, 80:] += 0.4 * rng.standard_normal((120, 80))
    variance = np.full(z.shape, 0.01**2)
    variance[:, 80:] = 0.4**2
    depth = complete(None, DepthMap(z, variance), image, CONFIG)
    assert np.median(depth.variance[:, 100:]) > 20 * np.median(depth.variance[:, :60])


@pytest.mark.parametrize("base", [np.ones((3, 3), np.float32), np.zeros((60, 80), np.float32)])
def test_a_base_that_cannot_be_used_is_refused(base: np.ndarray) -> None:
    with pytest.raises(FormatError, match="base"):
        complete(base, DepthMap(np.ones((60, 80))), np.zeros((60, 80), np.uint8), CONFIG)


def test_the_network_predicts_positive_definite_covariances(tmp_path: Path) -> None:
    torch.manual_seed(0)
    net = DepthCovNet()
    assert 8.9e6 < sum(p.numel() for p in net.parameters()) < 9.1e6
    levels = net(torch.rand(1, 3, 64, 96))
    assert [tuple(level.shape) for level in levels] == [(1, 3, 64 // k, 96 // k) for k in (8, 4, 2, 1)]
    torch.save(net.state_dict(), tmp_path / "net.pt")
    image = np.random.default_rng(0).integers(0, 255, (120, 160, 3), dtype=np.uint8)
    pixels = DepthCov.load(tmp_path / "net.pt")(image, 5.0)
    xx, xy, yy = pixels.shape.unbind(dim=-1)
    assert pixels.shape.shape == (120, 160, 3) and (xx > 0).all() and (xx * yy - xy * xy > 0).all()
    kept = np.random.default_rng(1).random((120, 160)) < 0.05
    config = DepthConfig(covariance="depthcov", covariance_weights=str(tmp_path / "net.pt"))
    depth = complete(None, DepthMap(np.where(kept, 3.0, np.nan)), image, config)
    np.testing.assert_allclose(depth.z, 3.0, rtol=1e-3)


def test_a_checkpoint_that_does_not_fit_is_refused(tmp_path: Path) -> None:
    torch.save({"weight": torch.zeros(3)}, tmp_path / "other.pt")
    (tmp_path / "text.pt").write_text("no checkpoint")
    for name in ("other.pt", "text.pt", "missing.pt"):
        with pytest.raises(ConfigError, match=name):
            DepthCov.load(tmp_path / name)


def test_half_of_a_real_sweep_tells_the_other_half(shared_data: Callable[[str], Path]) -> None:
    folder = shared_data("rgbl_kitti_odometry04_000_017") / "sequences/04"
    rows = dict(line.split(":", 1) for line in (folder / "calib.txt").read_text().splitlines() if ":" in line)
    P, Tr = (np.array(rows[key].split(), float).reshape(3, 4) for key in ("P2", "Tr"))
    image = np.ascontiguousarray(cv2.imread(str(folder / "image_2/000009.png"))[..., ::-1])
    camera = Camera(image.shape[1], image.shape[0], P[0, 0], P[1, 1], P[0, 2] + 0.5, P[1, 2] + 0.5)
    T = np.vstack([Tr, [0, 0, 0, 1]])
    T[:3, 3] += np.linalg.solve(P[:, :3], P[:, 3])
    sweep = np.fromfile(folder / "velodyne/000009.bin", np.float32).reshape(-1, 4)[:, :3]
    full = project_sweep(sweep, camera, T).to_map(*image.shape[:2])
    given = np.random.default_rng(9).random(full.z.shape) < 0.5
    scored = full.valid & ~given
    depth = complete(None, DepthMap(np.where(given, full.z, np.nan)), image, CONFIG)
    known = full.valid & given
    linear = LinearNDInterpolator(np.argwhere(known), full.z[known])(np.argwhere(scored))
    inside = np.isfinite(linear)
    error = np.abs(depth.z - full.z)[scored]
    assert error[inside].mean() < 0.87 * np.abs(linear - full.z[scored])[inside].mean()
    assert depth.density == 1.0 and 0.6 < (error < np.sqrt(depth.variance[scored])).mean() < 0.76
