"""One HTML page that works from a file without a network.

plotly.js is inside once; a figure is drawn when it comes into view, so that a long page opens at once.
"""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from itertools import repeat
from types import MappingProxyType
from typing import Any

from dlkf.report.drawing import Figure, library, template


@dataclass
class Page:
    """A page as it grows: title, the answer on top (one line each), then what is added, in its order."""

    title: str
    answer: Sequence[str]
    parts: list[str] = field(default_factory=list)
    warnings: Sequence[str] = ()  # below the answer

    def heading(self, text: str, note: str = "") -> None:
        """A section's title and a line about it."""
        self.parts.append(f"<h2>{html.escape(text)}</h2>" + (f"<p class=note>{html.escape(note)}</p>" if note else ""))

    def figure(self, name: str, figure: Figure) -> None:
        """An interactive figure; ``name`` is its id in the page. A map brings its switch for streets, and of several
        areas the choice."""
        if any(trace["type"] == "scattermap" for trace in figure.data):
            meta = figure.layout["meta"]
            if len(meta["areas"]) > 1:
                options = "".join(
                    f"<option value={k}{' selected' if k == meta['first'] else ''}>{html.escape(area['name'])}</option>"
                    for k, area in enumerate(meta["areas"])
                )
                self.parts.append(
                    f'<label>area <select class=area data-map="{name}">{options}</select></label> &emsp; '
                )
            self.parts.append(
                f'<label><input type=checkbox class=streets data-map="{name}"> streets '
                "(loads tiles from openstreetmap.org)</label>"
            )
        height = figure.layout.get("height", 450)
        data = figure.to_json().replace("</", "<\\/")
        self.parts.append(
            f'<div class=figure id="{name}" style="height:{height:.0f}px"><p class=waiting>…</p></div>'
            f'<script type="application/json" id="data-{name}">{data}</script>'
        )

    def table(
        self, columns: Sequence[str], rows: Sequence[Sequence[str]], *, marks: Sequence[str] = (), tall: bool = False,
        words: bool = False, titles: Mapping[str, str] = MappingProxyType({}),
    ) -> None:  # fmt: skip
        """A table; ``marks`` are attributes of its rows (class, data-lat …), ``tall`` scrolls in a box of its own,
        ``words`` are left-aligned and wrap; a text in ``titles`` shows its longer form under the pointer."""
        more = {text: f' title="{html.escape(longer)}"' for text, longer in titles.items()}
        text = [k > 0 and not words and _has_words([row[k] for row in rows]) for k in range(len(columns))]
        sides = [" class=text" if has_words else "" for has_words in text]

        def cell(tag: str, content: str, side: str) -> str:
            return f"<{tag}{side}{more.get(content, '')}>{html.escape(content)}</{tag}>"

        head = "".join(map(cell, repeat("th"), columns, sides)).replace("\n", "<br>")
        attributes = list(marks) or [""] * len(rows)
        cells = ("".join(map(cell, repeat("td"), row, sides)) for row in rows)
        body = "".join(f"<tr {a}>{row}</tr>" for row, a in zip(cells, attributes))
        table = f"<table{' class=words' if words else ''}><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
        self.parts.append(f'<div class="{"scroll tall" if tall else "scroll"}">{table}</div>')

    def note(self, text: str) -> None:
        """Small print."""
        self.parts.append(f"<p class=note>{html.escape(text)}</p>")

    def picture(self, caption: str, source: str) -> None:
        """One picture (data URI)."""
        words = html.escape(caption)
        self.parts.append(f'<h2>{words}</h2><img loading=lazy alt="{words}" src="{source}">')

    def protocol(self, values: Mapping[str, Any]) -> None:
        """How the numbers were made, as words: nested settings indented, numbers as they are written by hand."""
        rows = "".join(
            f"<tr><td>{'&emsp;' * depth}{html.escape(words(key))}</td><td><code>{html.escape(text)}</code></td></tr>"
            for depth, key, text in flatten_settings(values)
        )
        self.parts.append(f"<h2>How this was made</h2><div class=scroll><table class=protocol>{rows}</table></div>")

    def html(self) -> str:
        """The whole page."""
        form = files("dlkf.report").joinpath("page.html").read_text(encoding="utf-8")
        answer = "".join(f"<p>{html.escape(a)}</p>" for a in self.answer)
        answer += "".join(f"<p class=warning>{html.escape(w)}</p>" for w in self.warnings)
        filled = form.replace("{{title}}", html.escape(self.title)).replace("{{answer}}", answer)
        drawn = any("class=figure" in part for part in self.parts)
        filled = filled.replace("{{template}}", template() if drawn else "{}")
        return filled.replace("{{body}}", "\n".join(self.parts)).replace("{{plotly}}", library() if drawn else "")


def _has_words(column: Sequence[str]) -> bool:
    """Whether the cells are words: one begins with a letter, none with a digit or a sign."""
    first = {cell[:1] for cell in column}
    return any(map(str.isalpha, first)) and not first & set("0123456789+-−<")


def embed_png(png: bytes) -> str:
    """A PNG as data URI."""
    return f"data:image/png;base64,{base64.b64encode(png).decode()}"


def words(key: str) -> str:
    """``noise_density`` → ``noise density``."""
    return key.replace("_", " ")


def flatten_settings(values: Mapping[str, Any], depth: int = 0) -> list[tuple[int, str, str]]:
    """(depth, key, text) of nested settings; lists and numbers in one line."""
    out: list[tuple[int, str, str]] = []
    for key, value in values.items():
        if isinstance(value, Mapping) and value:
            out += [(depth, str(key), ""), *flatten_settings(value, depth + 1)]
        else:
            out.append((depth, str(key), format_setting(value)))
    return out


def format_setting(value: Any) -> str:
    """A value for a reader: – for none, an empty list as none, numbers with six digits at most."""
    if value is None or (isinstance(value, Mapping) and not value):
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, (list, tuple)):
        return ", ".join(map(format_setting, value)) or "none"
    return str(value)
