"""One page over several evaluations: ``dlkf compare a b``, or ``python -m dlkf.compare 'runs=[a,b]'``."""

from __future__ import annotations

from omegaconf import DictConfig

from dlkf.command import command
from dlkf.files import vacant
from dlkf.report.compare import read_reports, write_comparison


def runs_of(arguments: list[str]) -> list[str]:
    """Bare words are the folders."""
    folders = [a for a in arguments if "=" not in a and not a.startswith("-")]
    rest = [a for a in arguments if a not in folders]
    quoted = ",".join("'" + folder.replace("'", "\\'") + "'" for folder in folders)
    return [*rest, f"runs=[{quoted}]"] if folders else rest


@command("compare", runs_of)
def main(cfg: DictConfig) -> None:
    """Read, write, print."""
    vacant(cfg.out, overwrite=cfg.overwrite)
    reports = read_reports([cfg.runs] if isinstance(cfg.runs, str) else list(cfg.runs))
    write_comparison(cfg.out, reports)
    print(f"Report: {cfg.out}/compare.html")


if __name__ == "__main__":
    main()
