"""What the tests of the reconstruction share."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest

from sf_recon.config import ReconConfig
from sf_recon.core.reconstruction import Reconstruction
from tests.recon.scene import view


@pytest.fixture(scope="module")
def room() -> Reconstruction:
    out = Reconstruction(ReconConfig(pixels=1024, iterations=5))
    for i in range(0, 8, 2):
        out.add(view(i))
    return out
