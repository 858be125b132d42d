"""The search for a heading as C: one heading of :mod:`dlkf.running.start.bank` is a filter of its own.

``heading.c`` depends on the grid alone, and not on the filter that begins when the search is over. In a search that
runs, the headings share the constants of its filter; :data:`CARRIED` is what each of them has for itself.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from dlkf.filters.integration import Fix
from dlkf.onboard.carried import Field, Layout
from dlkf.onboard.functions import Begin, Function, Grid, advance_filter, make_layout
from dlkf.running.start.bank import bank_filter, fix_std, weigh_step

CARRIED = ("memory.P", "memory.fix.gate.", "state.", "error.")


class Weigh(Function):
    """(1, K), (1, M, 6), (1, 19) → (1, K), (1, 1): an update interval on, and what it adds to ln p of the heading."""

    def example(self) -> tuple[Tensor, ...]:
        """As in the class."""
        ones = torch.ones(1, self.grid.samples, 6, dtype=torch.float64)
        return self.example_memory(), ones, ones.new_ones(1, 19)

    def forward(self, memory: Tensor, imu: Tensor, fix: Tensor) -> tuple[Tensor, Tensor]:
        """As :func:`dlkf.running.start.bank.advance_bank` of one heading."""
        epoch_s, used = self.grid.epoch_s, fix[:, 12:18] > 0.5
        given = Fix(fix[:, :6], fix_std(fix[:, 6:12], epoch_s), used, fix[:, 18])
        after, step = advance_filter(self.estimator, self.layout.unpack(memory), imu, given, self.grid)
        return self.layout.pack(after), weigh_step(step, used, epoch_s).unsqueeze(-1)


class Headings(NamedTuple):
    """``heading.c``, and its numbers: of a memory, those that each heading has for itself, where some of them lie."""

    code: str
    work: int
    size: int
    own: tuple[tuple[int, int], ...]  # offset, numbers
    places: dict[str, int]

    @staticmethod
    def of(layout: Layout, code: str, work: int) -> Headings:
        """Of what was written."""
        places = {f.name: f.offset for f in layout.fields}
        return Headings(code, work, layout.size, _find_changing_ranges(layout.fields), places)

    @staticmethod
    def none() -> Headings:
        """Where the loop alone is written."""
        return Headings("", 0, 0, (), {})

    def sizes(self) -> dict[str, object]:
        """What ``step.h`` says of them."""
        if not self.size:
            names = ("HEADING", "OWN", "OWN_COUNT", "OWN_P", "OWN_C", "OWN_BIAS")
            return dict.fromkeys((*names, *(f"HEADING_{x}" for x in ("P", "ORIGIN", "AXES"))), 0)
        within = {}
        for first, count in self.own:
            within |= {first + k: len(within) + k for k in range(count)}
        at = self.places
        return {
            "HEADING": self.size, "OWN": ", ".join(f"{{{first}, {count}}}" for first, count in self.own),
            "OWN_COUNT": len(within), "OWN_P": within[at["state.p_n"]], "OWN_C": within[at["state.C_nb"]],
            "OWN_BIAS": within[at["error.bias"]],
            "HEADING_P": at["state.p_n"],
            "HEADING_ORIGIN": at["frame.origin_e"], "HEADING_AXES": at["frame.C_en"],
        }  # fmt: skip


def heading_functions(grid: Grid) -> tuple[Layout, dict[str, Function]]:
    """The layout of a heading's memory, and its functions, while exporting; double precision whatever the filter's."""
    grid = Grid(grid.samples, grid.dt)
    estimator = bank_filter()
    layout = make_layout(estimator, grid)
    kinds = {"start": Begin, "turn": Weigh}
    return layout, {name: kind(estimator, grid, layout).eval() for name, kind in kinds.items()}


def _find_changing_ranges(fields: list[Field]) -> tuple[tuple[int, int], ...]:
    """What changes from epoch to epoch, as ranges."""
    ranges: list[tuple[int, int]] = []
    for f in fields:
        if not f.name.startswith(CARRIED):
            continue
        if ranges and sum(ranges[-1]) == f.offset:
            ranges[-1] = (ranges[-1][0], ranges[-1][1] + f.size)
        else:
            ranges.append((f.offset, f.size))
    return tuple(ranges)
