"""The compiled kernels, or a clear error when they have not been built."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import Any

from sf_interfaces.errors import ConfigError


def native() -> Any:
    """The module ``sf_recon._native``.

    Raises:
        ConfigError: it is not installed.
    """
    try:
        from sf_recon import _native  # type: ignore[attr-defined]
    except ImportError as error:
        raise ConfigError(
            f"the compiled kernels sf_recon._native are missing ({error}); run `make` in the repository"
        ) from error
    return _native
