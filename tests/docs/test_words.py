"""Pages, presets, messages and docstrings are in the terms of the field."""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

from tests.docs.pages import PAGES, ROOT

BANNED = {
    r"told( apart)?|tells? apart": "given, set, reported; (not) significantly different",
    r"by heart": "memorised, overfitted",
    r"as (it|they) comes?": "unmodified, with default settings",
    r"nearer|farther": "smaller, larger; closer, further",
    r"heard|hears": "estimated from vibration",
    r"quiet(er|est|ly)?": "idle; with less vibration",
    r"believed|believes": "used, relied on",
    r"sought|foretold": "estimated, searched; predicted",
    r"in turns": "interleaved",
    r"lets? be|lets (it|them) be": "leaves unchanged",
    r"gives? in|turn of the loop": "recovers; filter step",
    r"stands? still|standing still": "is stationary",
    r"remembers|forgets itself": "keeps, has memorised; decays",
}
WORDS = re.compile(r"\b(?:" + "|".join(BANNED) + r")\b", re.I)
SOURCES = [f for folder in ("src", "pipelines") for f in sorted((ROOT / folder).rglob("*.py"))]
PRESETS = sorted((ROOT / "conf").rglob("*.yaml"))


def texts_of(file: Path) -> Iterator[tuple[int, str]]:
    """Lines of a page or a preset; of Python the strings, docstrings and comments, with the line each begins in."""
    source = file.read_text()
    if file.suffix != ".py":
        yield from enumerate(source.splitlines(), 1)
    elif WORDS.search(source):  # else no string or comment has one, and parsing takes seconds
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                yield from enumerate(node.value.splitlines(), node.lineno)
        for token in tokenize.generate_tokens(io.StringIO(source).readline):
            if token.type == tokenize.COMMENT:
                yield token.start[0], token.string


def test_no_text_has_a_banned_word() -> None:
    found = [
        f"{file.relative_to(ROOT)}:{number}: {word[0]!r} in {line.strip()[:90]!r}"
        for file in (*PAGES, *PRESETS, *SOURCES)
        for number, line in texts_of(file)
        for word in WORDS.finditer(line)
    ]
    assert not found, "\n".join(found) + f"\nwrite instead: {BANNED}"
