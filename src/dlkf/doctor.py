"""Checks of a recording before a filter runs: ``dlkf doctor dataset=data/town``.

Prints a line per finding and drive; exit code 0 where nothing is bad, 1 where something is, 2 where it cannot be read.
"""

from __future__ import annotations

import sys

from rich.text import Text

from dlkf.base.console import make_console
from dlkf.command import command
from dlkf.command.settings import DoctorSettings
from dlkf.data.store import drive_rows
from dlkf.diagnosis.checkup import GOOD, STYLES, checkup


@command("doctor", DoctorSettings)
def main(settings: DoctorSettings) -> None:
    """Read, look, print; the exit code is not 0 where something is bad."""
    console = make_console(140)
    bad = noted = 0
    for row in drive_rows(settings.dataset, settings.drives):
        console.print(Text(row.name, style="bold"))
        for finding in checkup(settings.dataset, row):
            console.print(Text(f"  {finding.grade:5}", style=STYLES[finding.grade]) + Text(f" {finding.text}"))
            bad, noted = bad + (finding.grade == "BAD"), noted + (finding.grade not in (GOOD, "BAD"))
    notes = f"{noted} note{'s' if noted != 1 else ''}"
    console.print(f"{bad} failed, {notes}" if bad or noted else "all good")
    if bad:
        sys.exit(1)


if __name__ == "__main__":
    main()
