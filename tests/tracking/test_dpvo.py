"""The DPVO network with random weights: names, shapes, size, forward, gradient, and files that do not fit."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sf_interfaces.config import build
from sf_interfaces.errors import ConfigError
from sf_tracking.config import TrackingConfig
from sf_tracking.core.tracker import Tracker, TrackingState
from tests.tracking.box_room import BoxRoom

torch = pytest.importorskip("torch")

from sf_tracking.core.dpvo import DPVONetwork, _neighbours, correlate  # noqa: E402
from sf_tracking.core.dpvo_operator import DPVOOperator  # noqa: E402


def test_it_has_the_checkpoints_names_shapes_and_size() -> None:
    network = DPVONetwork()
    shapes = {name: tuple(value.shape) for name, value in network.state_dict().items()}
    assert sum(p.numel() for p in network.parameters()) == 3_384_324
    assert sum(p.numel() for p in network.update.parameters()) == 3_004_804
    expected = {
        "patchify.fnet.conv1.weight": (32, 3, 7, 7),
        "patchify.fnet.layer2.0.downsample.0.weight": (64, 32, 1, 1),
        "patchify.inet.conv2.weight": (384, 64, 1, 1),
        "update.c1.2.weight": (384, 384),
        "update.agg_ij.h.bias": (384,),
        "update.gru.1.gate.0.weight": (384, 384),
        "update.gru.3.res.2.weight": (384, 384),
        "update.corr.0.weight": (384, 882),
        "update.corr.3.weight": (384,),
        "update.d.1.weight": (2, 384),
        "update.w.1.bias": (2,),
    }
    assert {name: shapes.get(name) for name in expected} == expected
    assert not [name for name in shapes if "norm" in name and "patchify" in name]


def test_a_step_is_finite_and_trains_every_tensor() -> None:
    torch.manual_seed(0)
    network = DPVONetwork()
    image = torch.rand(1, 3, 64, 96)
    features, context = network.patchify.fnet(image), network.patchify.inet(image)
    assert features.shape == (1, 128, 16, 24) and context.shape == (1, 384, 16, 24)
    patch, target = torch.tensor([0, 0, 0, 1, 1]), torch.tensor([1, 3, 2, 2, 1])
    patches, coords = features[0, :, 4:7, 4:7].expand(5, -1, -1, -1), torch.rand(5, 3, 3, 2) * 10
    corr = correlate(patches, features, coords)
    assert corr.shape == (5, 882)
    hidden, d, w = network.update(
        torch.zeros(5, 384), context[0, :, 3, :5].T, corr, patch, torch.zeros_like(patch), target
    )
    assert hidden.shape == (5, 384) and d.shape == w.shape == (5, 2)
    assert ((w > 0) & (w < 1)).all() and torch.isfinite(d).all()
    (d.square().sum() + w.sum()).backward()
    assert [n for n, p in network.named_parameters() if p.grad is None or not torch.isfinite(p.grad).all()] == []


def test_correlation_is_the_dot_product_with_what_lies_there() -> None:
    features = torch.randn(1, 128, 12, 16)
    patches = torch.randn(2, 128, 3, 3)
    coords = torch.tensor([6.0, 5.0]).expand(2, 3, 3, 2)
    corr = correlate(patches, features, coords).reshape(2, 7, 7, 3, 3, 2)
    dx, dy, row, col = 2, -1, 1, 2
    expected = (features[0, :, 5 + dy, 6 + dx] * patches[1, :, row, col]).sum()
    torch.testing.assert_close(corr[1, 3 + dx, 3 + dy, row, col, 0], expected, rtol=1e-4, atol=1e-4)


def test_neighbours_are_the_same_patch_in_the_previous_and_next_image() -> None:
    before, after = _neighbours(torch.tensor([0, 1, 0, 0]), torch.tensor([5, 1, 2, 9]))
    assert before.tolist() == [2, -1, -1, 0] and after.tolist() == [3, -1, 0, -1]


def test_a_checkpoint_is_loaded_by_its_names(tmp_path: Path) -> None:
    torch.manual_seed(1)
    saved = DPVONetwork().state_dict()
    file = tmp_path / "dpvo.pth"
    torch.save({**{f"module.{k}": v for k, v in saved.items()}, "module.update.lmbda": torch.zeros(1)}, file)
    loaded = DPVONetwork.load(file).state_dict()
    assert all(torch.equal(loaded[k], saved[k]) for k in saved)
    tracker = Tracker(build(TrackingConfig, {"operator": "dpvo", "checkpoint": str(file)}))
    assert tracker.track(BoxRoom().frame(0, np.eye(4), "dense")).state is TrackingState.TRACKING


def test_files_that_do_not_fit_are_refused_in_a_sentence(tmp_path: Path) -> None:
    file = tmp_path / "x.pth"
    with pytest.raises(ConfigError, match="cannot read checkpoint"):
        DPVONetwork.load(file)
    file.write_bytes(b"not a checkpoint")
    with pytest.raises(ConfigError, match="cannot read checkpoint"):
        DPVONetwork.load(file)
    wrong = DPVONetwork().state_dict()
    wrong["update.d.1.weight"] = torch.zeros(3, 384)
    torch.save(wrong, file)
    with pytest.raises(ConfigError, match=r"does not fit.*update\.d\.1\.weight"):
        DPVONetwork.load(file)
    with pytest.raises(ConfigError, match="choose patches or dpvo"):
        Tracker(build(TrackingConfig, {"operator": "magic"}))


def test_the_operator_gives_corrections_with_confidence() -> None:
    torch.manual_seed(2)
    operator = DPVOOperator(TrackingConfig(), DPVONetwork().eval())
    frame = BoxRoom().frame(0, np.eye(4), "dense")
    view = operator.view(frame.image)
    uv = np.random.default_rng(0).uniform((20, 20), (300, 220), (30, 2))
    update = operator(operator.describe(view, uv), view, uv, np.broadcast_to(np.eye(2), (30, 2, 2)))
    assert update.target.shape == (30, 2) and np.isfinite(update.target).all()
    assert (np.linalg.eigvalsh(update.information) > 0).all()
    again = operator(operator.describe(view, uv), view, uv, np.broadcast_to(np.eye(2), (30, 2, 2)))
    np.testing.assert_array_equal(update.target, again.target)
