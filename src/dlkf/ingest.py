"""Foreign logs as a dataset: ``python -m dlkf.ingest reader=csv source=logs/ out=data/town``."""

from __future__ import annotations

from dlkf.classes import made
from dlkf.command import command
from dlkf.command.settings import IngestSettings
from dlkf.data.intake import Intake, Taken, ingest
from dlkf.data.validate import Limits


def _open(arguments: list[str]) -> list[str]:
    """Keys of a reader that its preset leaves out can be given too; the reader itself knows which there are."""
    return [f"++{a}" if a.startswith("reader.") else a for a in arguments]


@command("ingest", IngestSettings, _open)
def main(told: IngestSettings) -> None:
    """Read every drive under ``source``, check it and write the dataset ``out``."""
    reader = made(told.reader, "reader")
    how = Intake(told.split_gaps, told.shortest_s, Limits(gap_s=told.gap_s, gap_samples=told.gap_samples))
    count = ingest(reader, told.source, told.out, how, overwrite=told.overwrite, parallel=told.parallel, progress=_tell)
    print(f"{told.out}: {count} drive{'s' if count != 1 else ''}")


def _tell(taken: Taken, done: int) -> None:
    for note in taken.notes:
        print(f"       {note}", flush=True)
    for number, line in enumerate(taken.lines, done - len(taken.lines) + 1):
        print(f"{number:5d}  {line}", flush=True)


if __name__ == "__main__":
    main()
