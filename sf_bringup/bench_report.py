"""All benchmark results of a folder on one page: the tables of its JSON files and the plots of the runs below it."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from sf_bringup import figures
from sf_bringup.report import Page, add_figures
from sf_bringup.run_folder import RunFolder
from sf_bringup.summary import run_figures
from sf_interfaces.errors import FormatError

FLIGHT = "flight.webp"  # in the folder of a run
_FACTS = ("machine", "versions", "models", "command", "seconds")


def is_run(path: Path) -> bool:
    """Whether a folder is that of a run."""
    return (path / "run.json").is_file()


def write_bench_page(folder: Path) -> Path:
    """Render every JSON file of ``folder``, and the figures of every run folder below it, into ``report.html``.

    Raises:
        FormatError: no such folder, nothing in it to report, or a file that is no JSON.
    """
    results = {path: _load(path) for path in sorted(folder.glob("*.json"))}
    runs = sorted(path.parent for path in folder.glob("*/**/run.json") if (path.parent / "summary.json").is_file())
    if not results and not runs:
        raise FormatError(f"{folder} holds no results: give the folder of a run, or one with the JSON of benchmarks")
    page = Page("SceneFactory benchmarks")
    for path, result in results.items():
        _add_result(page, path.stem, result)
    for run in runs:
        made = run_figures(RunFolder(run))
        if made:
            page.section(str(run.relative_to(folder)))
            add_figures(page, made)
            if (run / FLIGHT).is_file():
                page.image("flight through the map, no frame of it a view that was given", run / FLIGHT)
            figures.close(made)
    page.write(folder / "report.html")
    return folder / "report.html"


def _load(path: Path) -> dict[str, Any]:
    try:
        loaded = json.loads(path.read_text())
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise FormatError(
            f"{path} is no JSON of a benchmark ({error}); remove it or run the benchmark again"
        ) from error
    return loaded if isinstance(loaded, dict) else {"rows": loaded}


def _add_result(page: Page, name: str, result: Mapping[str, Any]) -> None:
    page.section(str(result.get("title", name)))
    for note in result.get("notes", ()):
        page.text(str(note))
    rest = {k: v for k, v in result.items() if k not in (*_FACTS, "title", "notes")}
    for title, rows in tables(rest):
        page.text(title)
        columns = list(dict.fromkeys(key for row in rows for key in row))
        page.table([[_cell(row.get(c, "")) for c in columns] for row in rows], columns)
    page.details("machine, versions, models", {k: result[k] for k in _FACTS if k in result})


def tables(value: Any, title: str = "") -> Iterator[tuple[str, Sequence[Mapping[str, Any]]]]:
    """(title, rows) of every table in a JSON value: lists of objects, and objects whose values are plain."""
    if isinstance(value, list) and value and all(isinstance(row, dict) for row in value):
        yield title, [_flat(row) for row in value]
    elif isinstance(value, dict):
        inner = {k: v for k, v in value.items() if isinstance(v, dict | list) and v}
        if inner and all(isinstance(v, dict) and not any(isinstance(x, dict | list) for x in v.values())
                         for v in inner.values()):  # fmt: skip
            yield title, [{"": name, **row} for name, row in inner.items()]
        else:
            for name, part in inner.items():
                yield from tables(part, f"{title} {name}".strip())
        plain = {k: v for k, v in value.items() if k not in inner}
        if plain:
            yield title, [plain]


def _flat(row: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    out: dict[str, Any] = {}
    for key, value in row.items():
        out |= _flat(value, f"{prefix}{key} ") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return out


def _cell(value: Any) -> str:
    if isinstance(value, bool) or not isinstance(value, float):
        return str(value)
    return f"{value:.4g}" if abs(value) < 1000 else f"{value:.0f}"
