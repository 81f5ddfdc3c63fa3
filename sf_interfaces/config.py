"""One frozen dataclass per block is its whole configuration.

The YAML file, the ROS parameters and ``--set key=value`` are derived from the dataclass: field names are
the keys, defaults the values, ``metadata["help"]`` the text. An unknown key is an error.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, TypeVar

import yaml

from sf_interfaces.errors import ConfigError

C = TypeVar("C")


def option(default: Any, help: str, *, low: float | None = None, high: float | None = None) -> Any:
    """A configuration field: its default, one line of help with the unit, and its inclusive range."""
    return field(default=default, metadata={"help": help, "low": low, "high": high})


def _parse(text: str, where: str) -> Any:
    """A value in YAML, without running anything it might ask for."""
    try:
        return yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ConfigError(
            f"{where}: cannot read '{text}' ({' '.join(str(error).split())}); write it as YAML"
        ) from error


def _typed(key: str, value: Any, default: Any) -> Any:
    """``value`` in the type of ``default``. A YAML string is parsed first, an int may stand for a float."""
    if isinstance(value, str) and not isinstance(default, str):
        value = _parse(value, f"config key '{key}'")
    if isinstance(default, bool) and isinstance(value, bool):
        return value
    if isinstance(default, float) and isinstance(value, (int, float)) and not isinstance(value, bool):
        return float(value)
    if isinstance(default, tuple) and isinstance(value, (list, tuple)):
        return tuple(value)
    if type(value) is type(default):
        return value
    raise ConfigError(f"config key '{key}' must be a {type(default).__name__}, got {value!r}")


def build(cls: type[C], values: Mapping[str, Any], where: str = "config") -> C:
    """Make a configuration from key-value pairs.

    Raises:
        ConfigError: unknown key, wrong type, or out of range; names the key and the allowed values.
    """
    known = {f.name: f for f in fields(cls)}  # type: ignore[arg-type]
    checked: dict[str, Any] = {}
    for key, value in values.items():
        if key not in known:
            near = difflib.get_close_matches(key, known, n=1)
            hint = f"did you mean '{near[0]}'?" if near else f"known keys: {', '.join(known)}"
            raise ConfigError(f"{where}: unknown key '{key}'; {hint}")
        f = known[key]
        checked[key] = value = _typed(key, value, f.default)
        low, high = f.metadata.get("low"), f.metadata.get("high")
        if (low is not None and value < low) or (high is not None and value > high):
            raise ConfigError(f"{where}: '{key}' = {value} is outside [{low}, {high}]")
    return cls(**checked)


def to_dict(config: Any) -> dict[str, Any]:
    """The effective values, tuples as lists, ready for YAML, JSON or ROS parameters."""
    return {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(config).items()}


@dataclass(frozen=True, slots=True)
class ConfigFile:
    """A YAML file of sections, one per block (``tracking: {patches: 128}``), plus ``--set`` overrides."""

    sections: Mapping[str, Mapping[str, Any]]

    @staticmethod
    def load(path: Path | None, overrides: Mapping[str, str] = {}) -> ConfigFile:
        """Read the file (None: empty) and lay ``section.key=value`` overrides over it.

        Raises:
            ConfigError: no such file, not YAML, not sections of keys, or an override without a section.
        """
        sections: dict[str, dict[str, Any]] = {}
        if path is not None:
            try:
                loaded = yaml.safe_load(path.read_text()) or {}
            except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:
                raise ConfigError(f"cannot read config {path}: {error}; give a YAML file") from error
            if not isinstance(loaded, dict) or not all(isinstance(v, dict) for v in loaded.values()):
                raise ConfigError(f"{path} must hold sections of keys, such as 'tracking: {{patches: 128}}'")
            sections = {name: dict(values) for name, values in loaded.items()}
        for dotted, value in overrides.items():
            section, _, key = dotted.partition(".")
            if not key:
                raise ConfigError(f"--set {dotted}={value}: write it as section.key=value")
            sections.setdefault(section, {})[key] = _parse(value, f"--set {dotted}")
        return ConfigFile(sections)

    def build(self, section: str, cls: type[C]) -> C:
        """The configuration of one section."""
        return build(cls, self.sections.get(section, {}), where=f"section '{section}'")

    def with_default(self, section: str, key: str, value: Any) -> ConfigFile:
        """The same, with a value where neither the file nor an override says otherwise."""
        return ConfigFile({**self.sections, section: {key: value, **self.sections.get(section, {})}})

    def check_sections(self, known: set[str]) -> None:
        """Raise ConfigError for a section no block has."""
        for name in self.sections:
            if name not in known:
                raise ConfigError(f"config: unknown section '{name}'; known: {', '.join(sorted(known))}")
