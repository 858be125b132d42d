"""One page over several evaluations: ``dlkf compare a b``, or ``python -m dlkf.compare 'runs=[a,b]'``."""

from __future__ import annotations

from pathlib import Path

from rich.markup import escape

from dlkf.base.console import make_console
from dlkf.base.files import require_empty
from dlkf.command import command
from dlkf.command.arguments import expand_home
from dlkf.command.settings import CompareSettings
from dlkf.evaluation.table import ResultTable, as_rich
from dlkf.report.compare import answers, end_table, named_warnings, read_reports, write_comparison


def split_runs(arguments: list[str]) -> list[str]:
    """Bare words are the folders; the points of a sweep have an equals sign in their names (``0-imu=consumer``)."""
    folders = [a for a in arguments if not a.startswith("-") and ("=" not in a or Path(a, "metrics.json").is_file())]
    rest = [a for a in arguments if a not in folders]
    quoted = ",".join("'" + expand_home(folder).replace("'", "\\'") + "'" for folder in folders)
    return [*rest, f"runs=[{quoted}]"] if folders else rest


@command("compare", CompareSettings, split_runs)
def main(settings: CompareSettings) -> None:
    """Read, write, print."""
    runs, out = settings.runs, settings.out
    require_empty(out, overwrite=settings.overwrite)
    reports = read_reports([str(run) for run in (runs if isinstance(runs, (list, tuple)) else [runs])])
    write_comparison(out, reports)
    console = make_console()
    console.print(as_rich(ResultTable("At the end of the outages", "", *end_table(reports))))
    for line in answers(reports):
        console.print(f"[bold]{escape(line)}[/bold]", highlight=False)
    for line in named_warnings(reports):
        console.print(escape(line), style="yellow", highlight=False, soft_wrap=True)
    print(f"Report: {out}/compare.html")


if __name__ == "__main__":
    main()
