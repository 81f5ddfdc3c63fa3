"""A page of numbers, figures and text in one ``report.html`` that needs nothing beside it."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import base64
import html
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

_STYLE = (
    "body{font-family:sans-serif;max-width:1300px;margin:2em auto;padding:0 1em}"
    "table{border-collapse:collapse}td,th{padding:.2em 1.2em .2em 0;border-bottom:1px solid #ddd;text-align:left}"
    "img{max-width:100%}pre{background:#f6f6f6;padding:1em;overflow:auto}nav a{margin-right:1.5em}"
)


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the result table."""

    name: str
    value: str


class Page:
    """Collects the parts of a page in reading order."""

    def __init__(self, title: str) -> None:
        self.title = title
        self._parts: list[str] = []
        self._links: list[str] = []

    def section(self, title: str) -> None:
        """A heading that the top of the page links to."""
        anchor = f"s{len(self._links)}"
        self._links.append(f'<a href="#{anchor}">{html.escape(title)}</a>')
        self._parts.append(f'<h2 id="{anchor}">{html.escape(title)}</h2>')

    def text(self, words: str) -> None:
        """A paragraph."""
        self._parts.append(f"<p>{html.escape(words)}</p>")

    def table(self, rows: Sequence[Sequence[str]], header: Sequence[str] = ()) -> None:
        """Rows of cells, as text."""
        lines = ["".join(f"<th>{html.escape(c)}</th>" for c in header)] if header else []
        lines += ["".join(f"<td>{html.escape(c)}</td>" for c in row) for row in rows]
        self._parts.append("<table>" + "".join(f"<tr>{line}</tr>" for line in lines) + "</table>")

    def figure(self, name: str, figure: Figure) -> None:
        """A figure under its name."""
        self._parts.append(f'<h3>{html.escape(name)}</h3><img src="data:image/webp;base64,{_embed(figure)}">')

    def image(self, name: str, path: Path) -> None:
        """A WebP file, still or moving, under its name."""
        data = base64.b64encode(path.read_bytes()).decode()
        self._parts.append(f'<h3>{html.escape(name)}</h3><img src="data:image/webp;base64,{data}">')

    def details(self, name: str, value: Any) -> None:
        """Text or values that open on a click."""
        words = value if isinstance(value, str) else json.dumps(value, indent=2, default=str)
        self._parts.append(f"<details><summary>{html.escape(name)}</summary><pre>{html.escape(words)}</pre></details>")

    def write(self, path: Path) -> None:
        """Write the page."""
        nav = f"<nav>{''.join(self._links)}</nav>" if len(self._links) > 1 else ""
        title = html.escape(self.title)
        path.write_text(
            f"<!doctype html><html><head><meta charset='utf-8'><title>{title}</title><style>{_STYLE}</style></head>"
            f"<body><h1>{title}</h1>{nav}{''.join(self._parts)}</body></html>"
        )


def _embed(figure: Figure) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="webp", dpi=90, pil_kwargs={"quality": 85})  # a tenth of what PNG takes for photos
    return base64.b64encode(buffer.getvalue()).decode()


def add_figures(page: Page, figures: Mapping[str, Figure]) -> None:
    """All figures, in their order."""
    for name, figure in figures.items():
        page.figure(name, figure)
