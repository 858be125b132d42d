"""Fixes of the last seconds in order of time, and the verdict of the plausibility screen on each."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable
from copy import copy
from dataclasses import dataclass

import numpy as np

from dlkf.data.limits import FixScreen, known_speed
from dlkf.data.schema import POSITION, STD, VELOCITY

HELD = 200  # fixes; ``DLKF_EARLY`` of the C core


@dataclass
class ScreenedFix:
    """A fix as a table of one row, the boundary at which it counts, and why it is refused; empty if it is not."""

    t: float  # s
    boundary: int
    table: dict[str, np.ndarray]
    reason: str = ""
    used: bool = False

    @property
    def place(self) -> tuple[float, float, float]:
        """Latitude, longitude [°] and height [m]."""
        lat, lon, height = (float(self.table[name][0]) for name in POSITION)
        return lat, lon, height


class FixHistory:
    """The screen over fixes that may come out of order: what is refused is what a log in order of time would refuse.

    A fix that is older than the last one sets the screen back to before the fixes held, which all pass it again.
    """

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Drop all fixes."""
        self._fixes: list[ScreenedFix] = []
        self._before, self._after = FixScreen(), FixScreen()  # of the oldest and of the latest fix held

    def add(
        self, t: float, boundary: int, table: dict[str, np.ndarray], oldest: int = 0
    ) -> tuple[ScreenedFix | None, set[int]]:
        """Screen a fix; itself, None where one of its time is held, and the boundaries whose fixes have changed.

        No fix of a boundary before ``oldest`` comes any more: those are dropped.
        """
        while self._fixes and (len(self._fixes) == HELD or self._fixes[0].boundary < oldest):
            _refusal(self._before, self._fixes.pop(0))
        place = bisect_left(self._fixes, t, key=lambda fix: fix.t)
        if place < len(self._fixes) and self._fixes[place].t == t:
            return None, set()
        fix = ScreenedFix(t, boundary, table)
        self._fixes.insert(place, fix)
        if fix is self._fixes[-1]:
            return fix, self._screen([fix])
        self._after = copy(self._before)
        return fix, self._screen(self._fixes)

    def at(self, boundary: int) -> ScreenedFix | None:
        """The latest fix of a boundary that is not refused and does not repeat the position before."""
        found: ScreenedFix | None = None
        for fix in self._fixes:
            if fix.boundary == boundary and fix.used and (found is None or fix.place != found.place):
                found = fix
        return found

    def _screen(self, fixes: Iterable[ScreenedFix]) -> set[int]:
        changed = set()
        for fix in fixes:
            used, fix.reason = fix.used, _refusal(self._after, fix)
            fix.used = not fix.reason
            if fix.used != used:
                changed.add(fix.boundary)
        return changed


def _refusal(screen: FixScreen, fix: ScreenedFix) -> str:
    """Why no car can have reached a fix, or nothing."""
    speed = float(known_speed(np.array([fix.table[name][0] for name in VELOCITY])))
    return screen.find_refusal(fix.t, fix.place, speed, np.array([fix.table[name][0] for name in STD]))
