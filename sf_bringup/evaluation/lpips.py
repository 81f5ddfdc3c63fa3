"""LPIPS, a learned perceptual distance of images, where its weights are on this machine."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional

from sf_bringup.evaluation.image import unit_pair
from sf_interfaces.errors import FormatError
from sf_interfaces.types import Float64, UInt8

VARIABLE = "SF_LPIPS"  # environment variable: folder with the two weight files below
ALEX, LINEAR = "alexnet-owt-7be5be79.pth", "alex.pth"
CONVOLUTIONS = (0, 3, 6, 8, 10)  # in torchvision's AlexNet.features


class Lpips:
    """Learned perceptual distance of AlexNet features (Zhang 2018, version 0.1), from weights found on this machine."""

    _STRIDES, _PADDING = (4, 1, 1, 1, 1), (2, 2, 1, 1, 1)
    _SHIFT, _SPREAD = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)

    def __init__(self, alexnet: dict[str, Tensor], linear: dict[str, Tensor]) -> None:
        self._convolutions = [(alexnet[f"features.{k}.weight"], alexnet[f"features.{k}.bias"]) for k in CONVOLUTIONS]
        self._linear = [linear[f"lin{k}.model.1.weight"] for k in range(5)]

    @staticmethod
    def find() -> Lpips:
        """From ``$SF_LPIPS`` or the cache of torch hub; ``benchmarks/lpips_weights.py`` puts them there.

        Raises:
            FormatError: a weight file is missing; says where it was looked for.
        """
        folders = [Path(torch.hub.get_dir()) / "checkpoints"]
        if VARIABLE in os.environ:
            folders.insert(0, Path(os.environ[VARIABLE]))
        found = [next((f / name for f in folders if (f / name).is_file()), None) for name in (ALEX, LINEAR)]
        if None in found:
            missing = [n for n, path in zip((ALEX, LINEAR), found, strict=True) if path is None]
            raise FormatError(
                f"LPIPS needs {' and '.join(missing)} in {' or '.join(map(str, folders))}; set {VARIABLE} to a folder "
                "that has them, or see benchmarks/lpips_weights.py"
            )
        return Lpips(*(torch.load(path, map_location="cpu", weights_only=True) for path in found if path))

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
