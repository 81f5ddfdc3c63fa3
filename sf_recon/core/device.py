"""Where the map is drawn and learnt: on the CPU, or on an NVIDIA GPU with a build with ``-DSF_CUDA=ON``."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from sf_interfaces.errors import ConfigError
from sf_recon.core.native import native
from sf_recon.core.neural_points import CELL, SEARCH_RADIUS, Level

DEVICES = ("cpu", "cuda")
HOW_TO_BUILD = "build it with the CUDA toolkit: pip install . -Ccmake.define.SF_CUDA=ON"


def cuda_kernels() -> Any:
    """The compiled module, with its kernels for GPUs.

    Raises:
        ConfigError: it was built without CUDA, or torch finds no device.
    """
    module = native()
    if not hasattr(module, "CudaGrid"):
        raise ConfigError(f"recon.device=cuda: the compiled kernels know no CUDA; {HOW_TO_BUILD}")
    if not torch.cuda.is_available():
        raise ConfigError("recon.device=cuda: torch finds no CUDA device; install a CUDA build of torch")
    return module


def torch_device(name: str) -> torch.device:
    """The device that ``recon.device`` names.

    Raises:
        ConfigError: neither cpu nor cuda, or cuda is not to be had.
    """
    if name not in DEVICES:
        raise ConfigError(f"recon.device must be cpu or cuda, got '{name}'")
    if name == "cuda":
        cuda_kernels()
        return torch.device("cuda", torch.cuda.current_device())
    return torch.device("cpu")


class DeviceGrid:
    """Finds the points of a level that are nearest to places on a GPU; follows the level when its points change."""

    def __init__(self, level: Level, device: torch.device) -> None:
        self._level, self._device = level, device
        self._points: Any = None  # the array that was sent
        self._grid: Any = cuda_kernels().CudaGrid(device.index, CELL * level.spacing)

    def nearest(self, queries: Tensor, k: int) -> tuple[Tensor, Tensor]:
        """As :meth:`Level.nearest` for queries [N, 3] on the device: ids int32 and squared distances [N, k] there."""
        stream = torch.cuda.current_stream(self._device).cuda_stream
        points = self._level.points
        if points is not self._points:
            self._grid.build(torch.from_numpy(points).to(self._device), stream)
            torch.cuda.current_stream(self._device).synchronize()  # before the copy goes away
            self._points = points
        ids = torch.empty((len(queries), k), dtype=torch.int32, device=self._device)
        distance2 = torch.empty((len(queries), k), device=self._device)
        self._grid.knn(queries.contiguous(), SEARCH_RADIUS * self._level.spacing, ids, distance2, stream)
        return ids, distance2
