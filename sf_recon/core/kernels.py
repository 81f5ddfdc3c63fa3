"""Python side of the compiled kernels of the colour field, with what each one computes in numpy.

The kernels take float32 and int32 arrays on the CPU (numpy, or ``tensor.numpy()``), release the interpreter
lock, and give the same result for any number of threads. A grid may be searched by several threads while
another adds points; a search then sees the points before or after, never half of them.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sf_interfaces.types import Float32, Float64
from sf_recon.core.native import native

Int32 = NDArray[np.int32]


@dataclass(frozen=True, slots=True)
class FieldLevel:
    """One resolution as the decoder sees it. Arrays are not copied."""

    grid: Any  # native().PointGrid
    features: Float32  # [M, F], row i of point i; a point without a row yet counts as no neighbour
    radius: float  # of the neighbour search, m
    sigma: float  # of the weight exp(-d2 / sigma), m^2


@dataclass(frozen=True, slots=True)
class ColorNetwork:
    """A perceptron with ReLU between its layers and a sigmoid at its end.

    Its input is: the features of all levels, finest first; the viewing direction (see ``direction_basis``);
    further inputs given per query.
    """

    layers: Sequence[tuple[Float32, Float32]]  # weight [out, in], bias [out]; the last has three outputs
    neighbours: int  # K of the interpolation, at most 16
    degree: int = 0  # of the viewing direction in the input
    base: Float32 | None = None  # [M, 3] colours of the finest points: the output is added to their logit


def interpolate(table: Float32, ids: Int32, weights: Float32, threads: int = 0) -> Float32:
    """Weighted sum of rows, [N, C]: sum_j weights[:, j] * table[ids[:, j]]; entries of weight 0 are left out.

    Raises:
        IndexError: an id with a weight is no row of the table [M, C].
    """
    out: Float32 = native().interpolate(table, ids, weights, threads)
    return out


def direction_basis(directions: Float32, degree: int) -> Float32:
    """The viewing direction as inputs of the network, [N, 0 | 3 | 8], of unit vectors [N, 3] (map frame).

    Degree 1: x y z. Degree 2: also xy, yz, xz, x2 - y2, 3 z2 - 1 (spherical harmonics up to constants).
    """
    x, y, z = directions.T
    terms = [x, y, z, x * y, y * z, x * z, x * x - y * y, 3 * z * z - 1]
    return np.stack(terms, axis=1)[:, : (0, 3, 8)[degree]].astype(np.float32)


def decode_colors(
    queries: Float32,
    levels: Sequence[FieldLevel],
    network: ColorNetwork,
    eye: Float64 | None = None,
    extra: Float32 | None = None,
    threads: int = 0,
) -> Float32:
    """Colours [N, 3] in 0..1 of surface points [N, 3] (m, map frame): Sec. IV-A-2 and IV-A-3 in one pass.

    Fast where rows that follow one another lie together in space.

    Args:
        queries: surface points, float32.
        levels: the neural points, finest first.
        network: what decodes their features.
        eye: camera centre [3] m, map frame; needed when the network sees the viewing direction.
        extra: further inputs [N, E] of the network.
        threads: 0 for all.

    Raises:
        IndexError: a query is not finite or lies a million cells from the map origin.
        ValueError: the layers do not fit the features.
    """
    out: Float32 = native().decode_colors(
        np.ascontiguousarray(queries, dtype=np.float32),
        [(level.grid, level.features, level.radius, level.sigma) for level in levels],
        list(network.layers),
        network.neighbours,
        None if eye is None else np.ascontiguousarray(eye, dtype=np.float32),
        network.degree,
        network.base,
        extra,
        threads,
    )
    return out


def decode_image(
    position: Float32,
    T_map_camera: Float64,
    levels: Sequence[FieldLevel],
    network: ColorNetwork,
    threads: int = 0,
) -> Float32:
    """Colours [H, W, 3] in 0..1 of what the rasteriser drew: ``Raster.position`` [H, W, 3], camera frame.

    The fastest way to a picture: it goes through the image in small squares, whose pixels share neighbours.
    Holes (NaN) are black.
    """
    out: Float32 = native().decode_image(
        np.ascontiguousarray(position, dtype=np.float32),
        np.ascontiguousarray(T_map_camera, dtype=np.float32),
        [(level.grid, level.features, level.radius, level.sigma) for level in levels],
        list(network.layers),
        network.neighbours,
        network.degree,
        network.base,
        threads,
    )
    return out
