"""Numbers of tables on one line where the table has room; else they break between a value and its interval only."""

from __future__ import annotations

import re

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import Files
from mkdocs.structure.pages import Page

TABLE, ROW = re.compile(r"<table>.*?</table>", re.S), re.compile(r"<tr>.*?</tr>", re.S)
CELL = re.compile(r"(<t[dh][^>]*>)(.*?)(?=</t[dh]>)", re.S)
RIGHT = '<td style="text-align: right;">'
TAG = re.compile(r"(<[^>]*>)")
WHOLE = re.compile(".+", re.S)
PARTS = re.compile(
    r"\[[^][]*\]|\([^()]*\)|[\d.]+(?: [/±] [\d.]+)+|[\d.]+ (?:%|(?:s|m|km|ms)\b)"
)  # interval, pair, unit
WIDEST, WORDS, PADDING = 122, 20, 2.3  # letters: of a table, of a column of words, around a cell


def on_page_content(text: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """All tables of a page."""
    return TABLE.sub(lambda table: unbroken(table[0]), text)


def unbroken(table: str) -> str:
    """A table whose numbers (cells to the right) do not break, or in parts only."""
    pattern = WHOLE if width(table) <= WIDEST else PARTS
    return CELL.sub(lambda cell: cell[1] + (joined(cell[2], pattern) if cell[1] == RIGHT else cell[2]), table)


def width(table: str) -> float:
    """Letters of the widest row, with numbers on one line and words on several."""
    rows = [[(tag == RIGHT, len(TAG.sub("", text))) for tag, text in CELL.findall(row)] for row in ROW.findall(table)]
    return sum(max(n if right else min(n, WORDS) for right, n in column) + PADDING for column in zip(*rows))


def joined(cell: str, pattern: re.Pattern[str]) -> str:
    """A cell in which what fits a pattern stays on one line."""
    parts = TAG.split(cell)  # every second one is a tag
    parts[::2] = [pattern.sub(r'<span class="joined">\g<0></span>', part) for part in parts[::2]]
    return "".join(parts)
