"""The compiled kernels, or a clear error when they have not been built."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import Any

from sf_interfaces.native import kernels


def native() -> Any:
    """The module ``sf_recon._native``.

    Raises:
        ConfigError: it is not installed.
    """
    return kernels("sf_recon")
