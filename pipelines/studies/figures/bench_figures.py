"""Timings of a benchmark: repeats of every work, the table with bars, the scaling picture, the machine they are of."""

from __future__ import annotations

import json
import math
import os
import platform
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from rich.table import Table

from dlkf.base.files import write_into
from dlkf.base.provenance import describe_provenance
from dlkf.evaluation.figures import png

BAR = 24
OVER = "over "  # groups that begin so are drawn
BLUE = "#0072B2"


@dataclass
class Timing:
    """A work's times by its repeats; with ``units`` units a second are printed."""

    group: str
    work: str
    seconds: list[float]
    units: float = 0.0  # of work in a repeat, for a rate
    at: float | None = None  # size of the work, for a drawing

    @property
    def median(self) -> float:
        """Seconds, or units a second."""
        middle = statistics.median(self.seconds)
        return self.units / middle if self.units else middle

    @property
    def best(self) -> float:
        """Of the least time."""
        return self.units / min(self.seconds) if self.units else min(self.seconds)

    @property
    def p99(self) -> float | None:
        """99th percentile [s], where there are enough repeats for one."""
        return float(np.quantile(self.seconds, 0.99)) if len(self.seconds) >= 100 else None

    def text(self, x: float | None) -> str:
        """With its unit."""
        if x is None:
            return ""
        return f"{x:,.0f} /s" if self.units else f"{1e3 * x:.3f} ms" if x < 0.1 else f"{x:.3f} s"


@dataclass
class Bench:
    """Timings of a run; ``clock`` tells seconds, those that pass or those of the processor."""

    most_repeats: int = 9
    clock: Callable[[], float] = time.perf_counter
    figures: list[Timing] = field(default_factory=list)

    def time(
        self, group: str, work: str, call: Callable[[], object], repeats: int = 5, units: float = 0.0,
        at: float | None = None,
    ) -> Timing:  # fmt: skip
        """Times of a call after one warm-up."""
        call()
        times = []
        for _ in range(min(repeats, self.most_repeats)):
            start = self.clock()
            call()
            times.append(self.clock() - start)
        return self.add(Timing(group, work, times, units, at))

    def in_turns(self, group: str, calls: Mapping[str, Callable[[], object]], repeats: int, units: float = 0.0) -> None:
        """The same of calls that are to be compared, round by round: a machine's speed wanders."""
        times: dict[str, list[float]] = {work: [] for work in calls}
        for k in range(1 + min(repeats, self.most_repeats)):
            for work, call in calls.items():
                start = self.clock()
                call()
                if k:
                    times[work].append(self.clock() - start)
        for work, seconds in times.items():
            self.add(Timing(group, work, seconds, units))

    def add(self, timing: Timing) -> Timing:
        """One more."""
        self.figures.append(timing)
        return timing

    def table(self, title: str) -> Table:
        """Median, best, 99th percentile, and a bar against the largest of the group."""
        table = Table("work", "median", "best", "99 %", "", title=title)
        for group in dict.fromkeys(f.group for f in self.figures):
            rows = [f for f in self.figures if f.group == group]
            table.add_section()
            for f in rows:
                bar = "█" * max(1, round(BAR * f.median / max(r.median for r in rows)))
                table.add_row(f"{group}: {f.work}", f.text(f.median), f.text(f.best), f.text(f.p99), bar)
        return table

    def picture(self) -> Figure | None:
        """Cost over size, one panel for every group ``over …``; None where there is none with two sizes."""
        groups = {f.group: [] for f in self.figures if f.group.startswith(OVER) and f.at is not None}
        for f in self.figures:
            if f.group in groups:
                groups[f.group].append(f)
        groups = {g: rows for g, rows in groups.items() if len(rows) > 1}
        if not groups:
            return None
        columns = min(3, len(groups))
        height = -(-len(groups) // columns)
        figure = Figure(figsize=(3.8 * columns, 3.1 * height), layout="constrained")
        for axes, (group, rows) in zip(figure.subplots(height, columns, squeeze=False).flat, groups.items()):
            at = np.array([f.at for f in rows], float)
            middle = np.array([statistics.median(f.seconds) for f in rows])
            axes.loglog(at, middle, "o-", color=BLUE, label="median")
            axes.loglog(at, [min(f.seconds) for f in rows], "_", color=BLUE, ms=10, label="least")
            size = group.removeprefix(OVER)
            ideal, law = (at / at[-1], "in proportion") if size != "threads" else (at[0] / at, "shared evenly")
            axes.loglog(at, middle[0 if size == "threads" else -1] * ideal, ":", color="#777777", label=law)
            axes.set(title=f"largest: {rows[-1].work}", xlabel=size)
            axes.title.set_size(10)
            axes.set_xticks(at, [f"{x:.3g}" for x in at])
            low, high = (round(math.log10(x) + side) for x, side in ((min(middle), -0.5), (max(middle), 0.5)))
            ticks = [m * 10.0**k for k in range(low, high + 1) for m in (1, 2, 5)]
            axes.set_yticks(ticks, [f"{1e3 * s:g} ms" if s < 1 else f"{s:g} s" for s in ticks])
            axes.set_ylim(0.7 * min(*middle, *(middle[-1] * ideal)), 1.4 * max(middle))
            axes.minorticks_off()
            axes.grid(color="#EEEEEE")
            axes.legend(frameon=False, fontsize=8)
        for axes in list(figure.axes)[len(groups) :]:
            axes.set_axis_off()
        return figure

    def write(self, folder: Path, machine: dict) -> None:
        """``bench.json`` and ``bench.png``, whole or not at all."""
        rows = []
        for f in self.figures:
            expected = {"median": f.median, "best": f.best, "p99_s": f.p99, "repeats": len(f.seconds)}
            rows.append(asdict(f) | {"seconds": f.seconds[:20]} | expected)
        with write_into(folder) as beside:
            text = json.dumps({"machine": machine, **describe_provenance(), "figures": rows}, indent=1)
            (beside / "bench.json").write_text(text, encoding="utf-8")
            if (picture := self.picture()) is not None:
                (beside / "bench.png").write_bytes(png(picture))


def machine(threads: int) -> dict:
    """What the figures depend on."""
    info = Path("/proc/cpuinfo")
    models = [line for line in info.read_text().splitlines() if line.startswith("model name")] if info.is_file() else []
    return {
        "processor": models[0].partition(":")[2].strip() if models else platform.processor(),
        "cores": os.cpu_count(),
        "memory_GB": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9, 1),
        "load_1_min": round(os.getloadavg()[0], 1),
        "threads": threads,
        "torch": torch.__version__,
        "python": platform.python_version(),
        "system": platform.platform(),
    }
