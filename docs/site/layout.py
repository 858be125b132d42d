"""How tables and pictures are laid out.

Numbers of a table stay on one line where the table has room; else they break between a value and its interval only. A
picture has its text as caption and opens in full size.
"""

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
    r"\[[^][]*\]|\([^()]*\)|[\d.]+(?:(?: [/±]|,) [\d.]+)+|[\d.]+ (?:%|(?:s|m|km|ms)\b)"
)  # interval, numbers, unit
UNIT = re.compile(r"(?:\d+ )?[^ ]+ \[[^][]*\]")  # of a head, with the word before it
PICTURES = re.compile(r"<p>((?:\s*<img [^>]*/?>)+)\s*</p>")
PICTURE = re.compile(r'<img alt="([^"]*)" src="([^"]*)"[^>]*>')
CODE, OPTION = re.compile(r"<code>[^<]*</code>"), re.compile(r"(?<![\w-])--[\w-]+")
JOINED = r'<span class="joined">\g<0></span>'
UNNAMED = "Output of the cell above"  # of a notebook
WIDEST, WORDS, PADDING = 122, 20, 2.3  # letters: of a table, of a column of words, around a cell


def on_page_content(text: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """All tables, pictures and options in code of a page."""
    text = CODE.sub(lambda code: OPTION.sub(JOINED, code[0]), text)
    text = TABLE.sub(lambda table: unbroken(table[0]), text)
    return PICTURES.sub(lambda found: PICTURE.sub(captioned, found[1]) if PICTURE.search(found[1]) else found[0], text)


def captioned(picture: re.Match[str]) -> str:
    """A picture that opens in full size, above its text."""
    words = f"<figcaption>{picture[1]}</figcaption>" if picture[1] not in ("", UNNAMED) else ""
    return f'<figure><a href="{picture[2]}">{picture[0]}</a>{words}</figure>'


def unbroken(table: str) -> str:
    """A table whose numbers (cells to the right) do not break, or in parts only."""
    numbers = WHOLE if width(table) <= WIDEST else PARTS

    def laid_out(cell: re.Match[str]) -> str:
        pattern = numbers if cell[1] == RIGHT else UNIT if cell[1].startswith("<th") else None
        return cell[1] + (cell[2] if pattern is None else joined(cell[2], pattern))

    return CELL.sub(laid_out, table)


def width(table: str) -> float:
    """Letters of the widest row, with numbers on one line and words on several."""
    rows = [[(tag == RIGHT, len(TAG.sub("", text))) for tag, text in CELL.findall(row)] for row in ROW.findall(table)]
    return sum(max(n if right else min(n, WORDS) for right, n in column) + PADDING for column in zip(*rows))


def joined(cell: str, pattern: re.Pattern[str]) -> str:
    """A cell in which what fits a pattern stays on one line."""
    parts = TAG.split(cell)  # every second one is a tag
    parts[::2] = [pattern.sub(JOINED, part) for part in parts[::2]]
    return "".join(parts)
