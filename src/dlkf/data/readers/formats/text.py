"""Text tables: separators, headers, rows of units, comments, encodings, and logs that end in the middle of a line."""

from __future__ import annotations

import codecs
import gzip
import io
import re
import warnings
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd

from dlkf.base.errors import InputError, first_line
from dlkf.data.readers import vocabulary
from dlkf.data.readers.frames import LogTable

DEFAULTS = dict(separator=",", decimal=".", header=True, comment=None, skip_rows=0, encoding=None, lines=None)
LARGEST_BYTES = 2 << 30  # unpacked: a day of an IMU at 100 Hz is a third
LARGEST_RATIO, SMALL_BYTES = 100, 64 << 20  # of unpacked to packed size: text of sensors packs tenfold
ENCODINGS = ("cp1252", "gb18030", "cp932", "big5")  # of files that are not UTF-8; where none fits, Latin-1 reads any
SEPARATORS = (";", "\t", "|", ",")
PEEK = 1 << 16  # bytes by which one of them is chosen


def read(path: Path, *, kind: str, table: str | None, text: Mapping[str, Any]) -> LogTable:
    """A text table; the frame's index is the number of each row's line in the file."""
    options = {**DEFAULTS, **{k: v for k, v in text.items() if v is not None}}
    if options["separator"] == r"\t":  # as a shell passes it
        options["separator"] = "\t"
    if len(options["separator"]) > 1:
        _pattern(options["separator"], "separator")
    content = decode_text(path, options["encoding"])
    lines = content.splitlines()
    comment, pattern = options["comment"], options["lines"]
    chosen = _pattern(pattern, "lines") if pattern else None
    keep = [
        k
        for k in range(int(options["skip_rows"]), len(lines))
        if lines[k].strip() and not (comment and lines[k].lstrip().startswith(comment))
    ]
    head = keep[:1] if options["header"] else []
    rows = keep[len(head) :]
    if chosen is not None:
        every, rows = rows, [k for k in rows if chosen.search(lines[k])]
        if not rows:
            raise InputError(f"{path}: no line matches {pattern}; {_describe_beginnings(lines, every, pattern, kind)}")
    notes = []
    if head and len(rows) > 1 and _is_units(lines[rows[0]], lines[rows[1]], options):
        rows = rows[1:]
    if len(rows) > 1 and (detail := _find_cut(lines, rows, content.endswith(("\n", "\r")), options)):
        notes.append(f"{path.name}: line {rows[-1] + 1}, the last, {detail}: left out, the log seems cut off there")
        rows = rows[:-1]
    if not keep:
        raise InputError(f"{path}: is empty; leave the drive out or give its data")
    _check_separator(path, [lines[k] for k in keep[:2]], options["separator"], kind)
    frame = _parse(path, [lines[k] for k in (*head, *rows)], [k + 1 for k in (*head, *rows)], options)
    if not len(frame):
        raise InputError(f"{path}: has no rows; leave the drive out or give its data")
    frame.index = pd.Index([k + 1 for k in rows][: len(frame)])
    return LogTable(frame, path, "line", tuple(notes))


def decode_text(path: Path, encoding: str | None) -> str:
    """A text file, gzip or not; without an ``encoding`` UTF-8, UTF-16 by its mark, or the one of Windows (Western,
    Chinese, Japanese) with most letters of the words that name columns."""
    try:
        if path.is_file() and path.stat().st_size > LARGEST_BYTES:
            raise InputError(f"{path}: is {path.stat().st_size / 2**30:.1f} GiB of text; split it, or write Parquet")
        raw = _unpack(path) if path.suffix == ".gz" else path.read_bytes()
    except (OSError, EOFError, zlib.error) as error:
        raise InputError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})") from None
    if encoding is not None:
        try:
            return raw.decode(encoding)
        except (LookupError, UnicodeDecodeError) as error:
            raise InputError(f"{path}: reader.encoding={encoding}: {error}; leave it out or correct it") from None
    if raw.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return raw.decode("utf-16", errors="replace")
    if b"\0" in raw[:4096]:
        raise InputError(f"{path}: is no text file; set its format (reader.imu.format, reader.gnss.format)")
    for name in _likely_encodings(raw[:PEEK]):
        with suppress(UnicodeDecodeError):
            return raw.decode(name)
    return raw.decode("latin-1")


def make_frame(
    rows: list[tuple[int, list[str]]], count: int, path: Path, otherwise: str
) -> tuple[pd.DataFrame, tuple[str, ...]]:
    """Numbered rows of ``count`` cells as texts, without the last where that has fewer, and a note on it.

    InputError where no row is left, and with ``otherwise`` for one that has another number of cells.
    """
    notes = ()
    if rows and len(rows[-1][1]) < count:
        notes = (f"{path.name}: line {rows[-1][0]}, the last, is cut off: left out",)
        rows = rows[:-1]
    if not rows:
        raise InputError(f"{path}: has no rows; leave the drive out or give its data")
    numbers, cells = zip(*rows)
    if bad := [number for number, row in rows if len(row) != count]:
        raise InputError(f"{path}: line {bad[0]}: has {otherwise}")
    return pd.DataFrame(list(cells), index=pd.Index(numbers)), notes


def _likely_encodings(head: bytes) -> Iterator[str]:
    """UTF-8, then the encodings of Windows, first that in which most letters beyond ASCII are those of columns'
    names."""
    yield "utf-8-sig"

    def known(name: str) -> float:
        letters = [x for x in head.decode(name, errors="replace") if not x.isascii()]
        return sum(x in vocabulary.LETTERS for x in letters) / max(len(letters), 1)

    yield from sorted(ENCODINGS, key=known, reverse=True)


def _unpack(path: Path) -> bytes:
    """A gzip file's content; InputError for one that unpacks to more than a log can be."""
    most = min(LARGEST_BYTES, max(SMALL_BYTES, LARGEST_RATIO * path.stat().st_size))
    with gzip.open(path, "rb") as file:
        raw = file.read(most + 1)
    if len(raw) > most:
        raise InputError(
            f"{path}: unpacks to more than {most / 2**30:.2g} GiB, which no log of its size does; split it"
        )
    return raw


def _check_separator(path: Path, lines: list[str], separator: str, kind: str) -> None:
    """InputError where the first line has one cell by this separator, and several by another."""
    counts = {other: len(_cells(lines[0], other)) for other in SEPARATORS}
    other = max(SEPARATORS, key=lambda one: counts[one])
    if len(_cells(lines[0], separator)) > 1 or counts[other] == 1:
        return
    settings = [("separator", other)]
    if other != "," and re.search(r"\d,\d", lines[-1]):
        settings.append(("decimal", ","))
    whole, alone = (
        " ".join(f"{where}.{key}={value!r}" for key, value in settings) for where in ("reader", f"+reader.{kind}.text")
    )
    raise InputError(f"{path}: a line is one cell: {lines[0][:60]!r}; set {whole} ({alone} for this file alone)")


def _parse(path: Path, lines: list[str], numbers: list[int], options: Mapping[str, Any]) -> pd.DataFrame:
    separator = options["separator"]
    in_c = len(separator) == 1 or separator == r"\s+"  # pandas' parser in C takes no other
    read_csv = partial(pd.read_csv, low_memory=False) if in_c else pd.read_csv
    try:
        with warnings.catch_warnings():  # of a separator at the end of every line; missing columns are reported
            warnings.simplefilter("ignore", pd.errors.ParserWarning)
            frame = read_csv(
                io.BytesIO("\n".join(lines).encode()),  # a StringIO has four bytes a letter
                encoding="utf-8",
                sep=separator,
                decimal=options["decimal"],
                header=0 if options["header"] else None,
                comment=options["comment"],
                skipinitialspace=True,
                index_col=False,
            )
    except (pd.errors.ParserError, pd.errors.EmptyDataError, ValueError, re.error) as error:
        detail = first_line(error).strip()
        if found := re.search(r"Expected (\d+) fields in line (\d+), saw (\d+)", detail):
            wanted, line, seen = map(int, found.groups())
            number = numbers[min(line, len(numbers)) - 1]
            raise InputError(
                f"{path}: line {number} has {seen} cells, those before have {wanted}; correct the line"
            ) from None
        raise InputError(f"{path}: cannot be read as a table: {detail}") from None
    frame.columns = [str(c).strip() for c in frame.columns]
    return frame


def _describe_beginnings(lines: list[str], rows: list[int], pattern: str, kind: str) -> str:
    """What lines begin with, words before the first number, the most frequent first, and what takes them."""
    words = (re.match(r"[^\d.+-]*", lines[k][:60]) for k in rows)
    counts = Counter((found[0] if found else "").strip(" ,;\t") for found in words)
    said = [f"{word or 'numbers'} ({count})" for word, count in counts.most_common(5)]
    if not said:
        return "it has no lines"
    alike = next((word for word in counts if word and word.split(",")[0] in pattern), next(iter(counts)))
    return f"its lines begin with {', '.join(said)}; reader.{kind}.lines='^{alike}' takes others"


def _cells(line: str, separator: str) -> list[str]:
    if separator in (r"\s+", " "):
        return line.split()
    return line.split(separator) if len(separator) == 1 else re.split(separator, line)


def _is_number(cell: str, decimal: str) -> bool:
    try:
        float(cell.strip().strip('"').replace(decimal, "."))
    except ValueError:
        return False
    return True


def _is_units(first: str, second: str, options: Mapping[str, Any]) -> bool:
    """No number in the first row under the header, and at least two in the second."""
    row, under = (_cells(line, options["separator"]) for line in (first, second))
    return not any(_is_number(c, options["decimal"]) for c in row) and (
        sum(_is_number(c, options["decimal"]) for c in under) >= 2
    )


def _find_cut(lines: list[str], rows: list[int], ended: bool, options: Mapping[str, Any]) -> str | None:
    """What is wrong with the last line, if it is not whole."""
    before, last = (_cells(lines[k], options["separator"]) for k in rows[-2:])
    if rows[-1] != len(lines) - 1:
        return None
    if len(last) < len(before):
        return f"has {len(last)} cells instead of {len(before)}"
    if not ended and len(last) == len(before):
        for a, b in zip(before, last):
            if _is_number(a, options["decimal"]) and not _is_number(b, options["decimal"]):
                return f"ends in {b.strip()!r} where a number was"
    return None


def _pattern(pattern: str, name: str) -> re.Pattern[str]:
    try:
        return re.compile(pattern)
    except re.error as error:
        raise InputError(f"reader.{name}={pattern!r} is no regular expression: {error}") from None
