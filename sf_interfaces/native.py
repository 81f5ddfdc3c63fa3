"""Compiled kernels of a block, or a clear error when they have not been built."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import importlib
from typing import Any

from sf_interfaces.errors import ConfigError


def kernels(package: str) -> Any:
    """The module ``<package>._native``.

    Raises:
        ConfigError: it is not installed.
    """
    try:
        return importlib.import_module(f"{package}._native")
    except ImportError as error:
        raise ConfigError(
            f"the compiled kernels {package}._native are missing ({error}); run `make` in the repository"
        ) from error
