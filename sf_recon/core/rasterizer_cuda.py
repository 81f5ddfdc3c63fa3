"""The rasteriser on an NVIDIA GPU, for tensors that live there. Needs a build with ``-DSF_CUDA=ON``."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections import deque
from collections.abc import Collection
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sf_interfaces.types import Camera, Float32, Float64
from sf_recon.core.device import cuda_kernels
from sf_recon.core.ipr_reference import Raster, RasterOptions

KEPT = 8  # clouds that stay on the device from view to view: those of the levels of a map


class CudaRasterizer:
    """Draws points of one device; keeps the memory it needs from frame to frame.

    Raises:
        ConfigError: the kernels were built without CUDA, or torch finds no device.
    """

    def __init__(self, device: int = 0) -> None:
        self._device = torch.device("cuda", device)
        self._kernel: Any = cuda_kernels().CudaRasterizer(device)
        self._clouds: deque[tuple[Float32, Tensor]] = deque(maxlen=KEPT)

    def rasterize(
        self,
        points: Tensor,
        camera: Camera,
        T_camera_map: Float64,
        options: RasterOptions,
        *,
        outputs: Collection[str] = ("position",),
        normals: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """Draw float32 points [N, 3] (map frame) of the device.

        Returns:
            ``depth`` and the wanted images, shaped as in :class:`~sf_recon.core.ipr_reference.Raster`, queued
            on the current stream.
        """
        pixels = (camera.height, camera.width)
        shapes = {"depth": pixels, "position": (*pixels, 3), "normal": (*pixels, 3)}
        shapes |= dict.fromkeys(("index", "weight"), (*pixels, options.k_ray))
        images = {
            name: torch.empty(shape, dtype=torch.int32 if name == "index" else torch.float32, device=self._device)
            for name, shape in shapes.items()
            if name == "depth" or name in outputs
        }
        self._kernel.rasterize(
            points.contiguous(),
            np.ascontiguousarray(T_camera_map, dtype=np.float32),
            *(camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height),
            *(options.radius, options.near, options.max_half, options.k_ray, options.layer_gap, options.sigma),
            None if normals is None else normals.contiguous(),
            *(images.get(name) for name in ("depth", "position", "index", "weight", "normal")),
            torch.cuda.current_stream(self._device).cuda_stream,
        )
        return images

    def draw(
        self,
        points: Float32,
        camera: Camera,
        T_camera_map: Float64,
        options: RasterOptions,
        *,
        outputs: Collection[str] = ("position",),
        normals: Float32 | None = None,
    ) -> Raster:
        """Draw points [N, 3] that lie on the CPU; the images come back there.

        The array is sent when it is seen first, so it must not be changed in place afterwards.
        """
        on_device = None if normals is None else torch.from_numpy(normals).to(self._device)
        images = self.rasterize(self._sent(points), camera, T_camera_map, options, outputs=outputs, normals=on_device)
        return Raster(**{name: image.cpu().numpy() for name, image in images.items()})

    def _sent(self, points: Float32) -> Tensor:
        for i, (known, tensor) in enumerate(self._clouds):
            if known is points:
                del self._clouds[i]  # what is drawn again and again outlasts what is made for one view
                self._clouds.append((points, tensor))
                return tensor
        tensor = torch.from_numpy(np.ascontiguousarray(points, dtype=np.float32)).to(self._device)
        self._clouds.append((points, tensor))
        return tensor
