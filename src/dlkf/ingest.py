"""Foreign logs as a dataset: ``python -m dlkf.ingest reader=csv source=logs/ out=data/town``."""

from __future__ import annotations

from typing import cast

from omegaconf import DictConfig, OmegaConf

from dlkf.classes import made
from dlkf.command import command
from dlkf.data.intake import ingest_drives
from dlkf.data.readers.frames import DriveFrames
from dlkf.data.summary import drive_line
from dlkf.data.validate import Limits


def _open(arguments: list[str]) -> list[str]:
    """Keys of a reader that its preset leaves out can be given too; the reader itself knows which there are."""
    return [f"++{a}" if a.startswith("reader.") else a for a in arguments]


@command("ingest", arguments=_open)
def main(cfg: DictConfig) -> None:
    """Read every drive under ``source``, check it and write the dataset ``out``."""
    reader = made(cast(dict, OmegaConf.to_container(cfg.reader, resolve=True)), "reader")
    count = ingest_drives(
        reader.read(cfg.source),
        cfg.out,
        split_gaps=cfg.split_gaps,
        shortest_s=cfg.shortest_s,
        overwrite=cfg.overwrite,
        limits=Limits(gap_s=cfg.gap_s, gap_samples=cfg.gap_samples),
        progress=_tell,
    )
    print(f"{cfg.out}: {count} drive{'s' if count != 1 else ''}")


def _tell(drive: DriveFrames, done: int) -> None:
    for note in drive.notes:
        print(f"       {note}", flush=True)
    print(f"{done:5d}  {drive.name}: {drive_line(drive)}", flush=True)


if __name__ == "__main__":
    main()
