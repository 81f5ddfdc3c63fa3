"""The compiled kernels of the colour field against what they stand for in torch and numpy."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import threading

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sf_recon.config import ReconConfig
from sf_recon.core.color_field import ColorField, Neighbourhood
from sf_recon.core.kernels import (
    ColorNetwork,
    FieldLevel,
    decode_colors,
    decode_image,
    direction_basis,
    interpolate,
)
from sf_recon.core.native import native
from sf_recon.core.neural_points import SEARCH_RADIUS, NeuralPoints
from sf_recon.core.trainer import BETAS, EPSILON, RowAdam

RNG = np.random.default_rng(3)


def surface(n: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-1, 1, (n, 2))
    return np.column_stack([xy, 2 + 0.3 * np.sin(4 * xy[:, 0])]).astype(np.float32)


def make_field(features: int = 8, view_directions: bool = False) -> ColorField:
    points = NeuralPoints(0.03, levels=3, multiplier=3.0)
    field = ColorField(points, ReconConfig(features=features, hidden=20, view_directions=view_directions))
    cloud = surface(20000)
    field.grow(points.allocate(cloud, 0.5 + 0.4 * np.sin(cloud)))
    generator = torch.Generator().manual_seed(1)
    torch.nn.init.xavier_uniform_(field.network[-1].weight, generator=generator)
    field.features = [torch.randn(f.shape, generator=generator) for f in field.features]
    return field


def levels_of(field: ColorField) -> list[FieldLevel]:
    return [
        FieldLevel(level.grid, f.numpy(), SEARCH_RADIUS * level.spacing, field.sigma * level.spacing**2)
        for level, f in zip(field.points.levels, field.features, strict=True)
    ]


def expected_colors(field: ColorField, queries: np.ndarray, base: np.ndarray | None = None) -> np.ndarray:
    """The network on interpolated features in torch, without the field's own colour features."""
    near = field.neighbourhoods(queries)
    with torch.no_grad():
        out = field.network(field.encode(near))
        if base is not None:
            out = out + torch.logit((torch.from_numpy(base)[near[0].ids] * near[0].weights[..., None]).sum(1), eps=0.02)
        return torch.sigmoid(out).numpy()


def layers_of(network: torch.nn.Sequential) -> list[tuple[np.ndarray, np.ndarray]]:
    return [(m.weight.detach().numpy(), m.bias.detach().numpy()) for m in network if isinstance(m, torch.nn.Linear)]


@pytest.mark.parametrize("features", [3, 8, 11])
@pytest.mark.parametrize("colour_base", [False, True])
def test_decoded_colours_equal_the_torch_field(features: int, colour_base: bool) -> None:
    field = make_field(features)
    base = RNG.uniform(size=(len(field.points.levels[0]), 3)).astype(np.float32) if colour_base else None
    network = ColorNetwork(layers_of(field.network), field.neighbours, base=base)
    ordered = surface(1500, seed=5)[np.argsort(surface(1500, seed=5)[:, 0])]
    far = np.array([[5, 5, 5], [0, 0, 2.6]], np.float32)  # without any neighbour, and with some levels only
    for queries in (ordered, surface(1037, seed=6), far, np.zeros((0, 3), np.float32)):
        got = decode_colors(queries, levels_of(field), network)
        np.testing.assert_allclose(got, expected_colors(field, queries, base), atol=3e-6)


def test_image_equals_its_points_and_leaves_holes_black() -> None:
    field = make_field()
    network = ColorNetwork(layers_of(field.network), field.neighbours)
    v, u = np.mgrid[0:37, 0:53]
    z = 2 + 0.3 * np.sin(0.2 * u)
    position = np.stack([(u - 26) / 30 * z, (v - 18) / 30 * z, z], axis=-1).astype(np.float32)
    position[3:9, 5:20] = np.nan
    T = np.eye(4)
    got = decode_image(position, T, levels_of(field), network)
    hole = np.isnan(position[..., 0])
    assert not got[hole].any()
    np.testing.assert_allclose(got[~hole], expected_colors(field, position[~hole]), atol=3e-6)
    for threads in (1, 3):
        assert got.tobytes() == decode_image(position, T, levels_of(field), network, threads).tobytes()


@pytest.mark.parametrize("degree", [1, 2])
def test_network_sees_the_viewing_direction_and_further_inputs(degree: int) -> None:
    field = make_field()
    queries, eye = surface(300, seed=7), np.array([0.1, -0.2, 0.3])
    extra = RNG.normal(size=(300, 2)).astype(np.float32)
    rays = (queries - eye) / np.linalg.norm(queries - eye, axis=1, keepdims=True)
    encoded = field.encode(field.neighbourhoods(queries))
    inputs = torch.cat([encoded, torch.from_numpy(direction_basis(rays, degree)), torch.from_numpy(extra)], dim=1)
    head = torch.nn.Sequential(torch.nn.Linear(inputs.shape[1], 9), torch.nn.ReLU(), torch.nn.Linear(9, 3))
    with torch.no_grad():
        expected = torch.sigmoid(head(inputs)).numpy()
    network = ColorNetwork(layers_of(head), field.neighbours, degree)
    got = decode_colors(queries, levels_of(field), network, eye, extra)
    np.testing.assert_allclose(got, expected, atol=3e-6)


def test_what_does_not_fit_is_said() -> None:
    field = make_field()
    network = ColorNetwork(layers_of(field.network), field.neighbours)
    queries = surface(10)
    with pytest.raises(ValueError, match="fit the features"):
        decode_colors(queries, levels_of(field)[:2], network)
    with pytest.raises(ValueError, match="needs the eye"):
        decode_colors(queries, levels_of(field), ColorNetwork(network.layers, 4, degree=1))
    with pytest.raises(IndexError, match="not finite"):
        decode_colors(np.full((70, 3), np.nan, np.float32), levels_of(field), network)
    with pytest.raises(IndexError, match="out of range"):
        interpolate(queries, np.array([[10]], np.int32), np.ones((1, 1), np.float32))


def test_interpolation_equals_embedding_bag() -> None:
    table = RNG.normal(size=(50, 11)).astype(np.float32)
    ids = RNG.integers(0, 50, (1300, 4)).astype(np.int32)
    weights = RNG.uniform(size=(1300, 4)).astype(np.float32)
    weights[3] = 0
    expected = (table[ids] * weights[..., None]).sum(axis=1)
    np.testing.assert_allclose(interpolate(table, ids, weights), expected, rtol=1e-5, atol=1e-6)


def near_of(ids: np.ndarray, weights: np.ndarray) -> Neighbourhood:
    return Neighbourhood(torch.from_numpy(ids), torch.from_numpy(weights))


def test_adam_moves_touched_rows_as_torch_does() -> None:
    start = RNG.normal(size=(40, 8)).astype(np.float32)
    parameter = torch.nn.Parameter(torch.from_numpy(start.copy()))
    table, rows = torch.from_numpy(start.copy()), RowAdam(8)
    rows.grow(40)
    adam = torch.optim.Adam([parameter], lr=0.01, betas=BETAS, eps=EPSILON)
    ids = np.arange(40, dtype=np.int32).reshape(20, 2)  # every row every time: then torch counts the same steps
    for seed in range(30):
        rng = np.random.default_rng(seed)
        weights = rng.uniform(0.1, 1, (20, 2)).astype(np.float32)
        gradient = rng.normal(size=(20, 8)).astype(np.float32)
        parameter.grad = torch.from_numpy((weights[..., None] * gradient[:, None]).reshape(40, 8))
        adam.step()
        rows.step(table, near_of(ids, weights), torch.from_numpy(gradient), 0.01)
    moved = np.abs(parameter.detach().numpy() - start).mean()
    assert np.abs(table.numpy() - parameter.detach().numpy()).max() < 0.01 * moved  # moments have 11 bits
    before = table.clone()
    rows.step(table, near_of(ids[:1], np.array([[1, 0]], np.float32)), torch.ones(1, 8), 0.01)
    assert np.flatnonzero((table != before).any(dim=1)).tolist() == [0] and rows.steps.tolist() == [31, *[30] * 39]


def test_adam_in_torch_operations_equals_the_kernel() -> None:
    rng = np.random.default_rng(3)
    tables, rows = [torch.zeros(60, 6) for _ in range(2)], [RowAdam(6) for _ in range(2)]
    for one in rows:
        one.grow(60)
    for _ in range(20):
        ids = rng.integers(0, 50, (40, 4)).astype(np.int32)  # many twice, some never
        near = near_of(ids, (rng.uniform(0, 1, (40, 4)) * (rng.random((40, 4)) < 0.8)).astype(np.float32))
        gradient = torch.from_numpy(rng.normal(size=(40, 6)).astype(np.float32))
        rows[0].step(tables[0], near, gradient, 0.01)
        rows[1].step_by_torch(tables[1], near, gradient, 0.01)
    assert torch.equal(rows[0].steps, rows[1].steps) and not tables[1][50:].any()
    np.testing.assert_allclose(tables[1], tables[0], atol=1e-3 * float(tables[0].abs().max()))  # moments have 11 bits


@given(value=st.floats(-7e4, 7e4, width=32), steps=st.integers(0, 9))
@settings(max_examples=300, deadline=None)
def test_moments_are_rounded_to_the_nearest_half(value: float, steps: int) -> None:
    """One row, one query, weight 1: the moments after a step are those of the formula in numpy's half floats."""
    rows, table = RowAdam(1), torch.zeros(1, 1)
    rows.grow(1)
    rows.steps[:] = steps
    rows.mean[:], rows.root[:] = 0.25, 3e-6  # the second lies below the normal range of a half
    mean, root = np.float32(rows.mean.item()), np.float32(rows.root.item())
    one = near_of(np.zeros((1, 1), np.int32), np.ones((1, 1), np.float32))
    rows.step(table, one, torch.tensor([[value]]), 0.01)
    g, (b1, b2) = np.float32(value), (np.float32(b) for b in BETAS)
    mean = b1 * mean + (np.float32(1) - b1) * g
    square = b2 * root * root + (np.float32(1) - b2) * g * g
    assert rows.mean.item() == np.float16(np.clip(mean, -6e4, 6e4))
    assert rows.root.item() == np.float16(np.clip(np.sqrt(square), np.float32(1e-7), 6e4))
    count = steps + 1
    step = 0.01 / (1 - BETAS[0] ** count) * mean / (np.sqrt(square / (1 - BETAS[1] ** count)) + EPSILON)
    assert table.item() == pytest.approx(-step, rel=1e-5, abs=1e-9)


def test_adam_gives_the_same_for_any_number_of_threads() -> None:
    ids = RNG.integers(0, 500, (3000, 4)).astype(np.int32)
    weights, gradient = (
        RNG.uniform(0, 1, (3000, 4)).astype(np.float32),
        torch.from_numpy(RNG.normal(size=(3000, 6)).astype(np.float32)),
    )
    tables = []
    for threads in (1, 3):
        rows, table = RowAdam(6), torch.zeros(500, 6)
        rows.grow(500)
        for _ in range(3):
            rows.step(table, near_of(ids, weights), gradient, 0.01, threads)
        tables.append(table)
    assert torch.equal(*tables)
    with pytest.raises(IndexError, match="adam_rows"):
        rows.step(table, near_of(ids + 1, weights), gradient, 0.01)


def test_a_grid_can_be_searched_while_it_grows() -> None:
    grid = native().PointGrid(0.05)
    grid.add(surface(2000))
    stop = threading.Event()

    def grow() -> None:
        for seed in range(1, 40):
            grid.add(surface(2000, seed))
        stop.set()

    writer = threading.Thread(target=grow)
    writer.start()
    queries = surface(3000, seed=99)
    while not stop.is_set():
        ids, d2 = grid.knn(queries, 4, 0.2)
        assert (ids >= 0).all() and (np.diff(d2, axis=1) >= 0).all()
    writer.join()
    assert len(grid) == 80000


@pytest.mark.parametrize("sided", [False, True])
def test_field_decodes_as_it_trains(sided: bool) -> None:
    field = make_field(view_directions=sided)
    queries, eye = surface(500, seed=7), np.array([0.1, -0.2, 0.3])
    directions = (queries - eye) / np.linalg.norm(queries - eye, axis=1, keepdims=True)
    near = field.neighbourhoods(queries)
    with torch.no_grad():
        trained = field.decode(field.encode(near), near, directions.astype(np.float32)).numpy()
    np.testing.assert_allclose(field.color(queries, eye), trained, atol=3e-6)
