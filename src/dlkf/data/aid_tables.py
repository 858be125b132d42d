"""Which tables of further sensors there are: a name, the column that counts, and how its samples are reduced."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from dlkf.base.errors import InputError, did_you_mean

MEAN, LAST = "mean", "last"


@dataclass(frozen=True)
class AidTable:
    """A table ``<dataset>/<name>/drive=<id>/`` with ``t``, a ``column`` of values, and ``std`` if it has one."""

    name: str
    column: str
    reduce: str = MEAN

    def __post_init__(self) -> None:
        if self.reduce not in (MEAN, LAST):
            raise ValueError(f"reduce is {self.reduce!r}, must be {MEAN!r} or {LAST!r}")


STANDARD = {
    "speed": AidTable("speed", "speed"),
    "heading": AidTable("heading", "heading", LAST),
    "baro": AidTable("baro", "height_m"),
}


def standard_tables(names: Sequence[str]) -> tuple[AidTable, ...]:
    """By name; InputError for an unknown one."""
    if unknown := [name for name in names if name not in STANDARD]:
        raise InputError(
            f"aids: unknown {unknown[0]!r}{did_you_mean(unknown[0], STANDARD) or ';'} known: {', '.join(STANDARD)}"
        )
    return tuple(STANDARD[name] for name in names)
