"""Foreign logs as a dataset: ``python -m dlkf.ingest reader=csv source=logs/ out=data/town``."""

from __future__ import annotations

from dlkf.base.classes import instantiate
from dlkf.command import command
from dlkf.command.settings import IngestSettings
from dlkf.data.intake import IngestOptions, IngestResult, ingest
from dlkf.data.validate import Limits


def _open(arguments: list[str]) -> list[str]:
    """Keys of a reader that its preset leaves out can be given too; the reader itself defines them."""
    return [f"++{a}" if a.startswith("reader.") else a for a in arguments]


@command("ingest", IngestSettings, _open)
def main(settings: IngestSettings) -> None:
    """Read every drive under ``source``, check it and write the dataset ``out``."""
    reader = instantiate(settings.reader, "reader", ("read",))
    how = IngestOptions(
        settings.split_gaps, settings.shortest_s, Limits(gap_s=settings.gap_s, gap_samples=settings.gap_samples)
    )
    count = ingest(
        reader,
        settings.source,
        settings.out,
        how,
        overwrite=settings.overwrite,
        parallel=settings.parallel,
        skip_unsure=settings.skip_unsure,
        progress=_tell,
    )
    print(f"{settings.out}: {count} drive{'s' if count != 1 else ''}")


def _tell(taken: IngestResult, done: int) -> None:
    for number, line in enumerate(taken.lines, done - len(taken.lines) + 1):
        print(f"{number:5d}  {line}", flush=True)
    for note in taken.notes:  # on these drives, or on all where there is no line
        print(f"       {note}", flush=True)


if __name__ == "__main__":
    main()
