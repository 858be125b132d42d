"""Foreign logs as a dataset: ``python -m dlkf.ingest reader=csv source=logs/ out=data/town``."""

from __future__ import annotations

import importlib
from typing import Any

from omegaconf import DictConfig, OmegaConf

from dlkf.command import command
from dlkf.data.intake import ingest_drives
from dlkf.data.readers.frames import DriveFrames
from dlkf.data.summary import drive_line
from dlkf.data.validate import Limits
from dlkf.errors import InputError


def _open(arguments: list[str]) -> list[str]:
    """Keys of a reader that its preset leaves out can be given too; the reader itself knows which there are."""
    return [f"++{a}" if a.startswith("reader.") else a for a in arguments]


@command("ingest", arguments=_open)
def main(cfg: DictConfig) -> None:
    """Read every drive under ``source``, check it and write the dataset ``out``."""
    reader = _reader(OmegaConf.to_container(cfg.reader, resolve=True))
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


def _reader(settings: Any) -> Any:
    """The reader that ``_target_`` names; InputError if it is not there or does not take these settings."""
    target = settings.pop("_target_", None)
    if not target:
        raise InputError("reader has no _target_; it names the reader's class, as in conf/reader/csv.yaml")
    module, _, name = str(target).rpartition(".")
    try:
        kind = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise InputError(f"reader._target_={target}: cannot be imported ({error}); put it on PYTHONPATH") from None
    try:
        return kind(**settings)
    except TypeError as error:
        raise InputError(f"reader: {str(error).rpartition('__init__() ')[2]}; --cfg job prints all keys") from None


def _tell(drive: DriveFrames, done: int) -> None:
    for note in drive.notes:
        print(f"       {note}", flush=True)
    print(f"{done:5d}  {drive.name}: {drive_line(drive)}", flush=True)


if __name__ == "__main__":
    main()
