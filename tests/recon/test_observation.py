"""Which pixels of a keyframe become points."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace

import numpy as np

from sf_interfaces.types import DepthMap
from sf_recon.config import ReconConfig
from sf_recon.core.observation import observe, supported
from tests.recon.scene import view


def test_a_pixel_that_flies_before_the_surface_is_left_out() -> None:
    key = view(0)
    z = np.array(key.depth.z)
    z[40, 50] *= 0.1  # alone before a wall
    z[60:63, 70:73] = np.nan
    z[61, 71] = 0.3  # alone in a hole
    out = np.zeros(z.shape, bool)
    out.flat[observe(replace(key, depth=DepthMap(z)), ReconConfig()).pixels] = True
    assert not out[40, 50] and not out[61, 71]
    assert out[39:42, 49:52].sum() == 8 and out[59, 70]
    np.testing.assert_array_equal(supported(key.depth.z), key.depth.valid)


def test_stated_variance_and_sparse_depth_are_taken_as_they_are() -> None:
    key = view(0)
    z = np.array(key.depth.z)
    z[40, 50] *= 0.1
    sure = DepthMap(z, np.full_like(z, 1e-6))
    assert len(observe(replace(key, depth=sure), ReconConfig()).pixels) == z.size
    impossible = np.full_like(z, 1e-6)
    impossible[3, 4], impossible[5, 6] = -1e-6, np.nan
    seen = observe(replace(key, depth=DepthMap(z, impossible)), ReconConfig())
    assert len(seen.pixels) == z.size - 2 and np.isfinite(seen.sigmas).all()
    sparse = np.full_like(z, np.nan)
    sparse[::5, ::5] = z[::5, ::5]
    assert len(observe(replace(key, depth=DepthMap(sparse)), ReconConfig()).pixels) == np.isfinite(sparse).sum()
