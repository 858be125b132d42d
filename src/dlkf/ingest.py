"""Foreign logs as a dataset: ``python -m dlkf.ingest reader=csv source=logs/ out=data/town``."""

from __future__ import annotations

from hydra.utils import get_class
from omegaconf import DictConfig, OmegaConf

from dlkf.command import command
from dlkf.data.intake import ingest_drives
from dlkf.data.validate import Limits


@command("ingest")
def main(cfg: DictConfig) -> None:
    """Read every drive under ``source``, check it and write the dataset ``out``."""
    settings = OmegaConf.to_container(cfg.reader, resolve=True)
    reader = get_class(settings.pop("_target_"))(**settings)
    count = ingest_drives(
        reader.read(cfg.source),
        cfg.out,
        split_gaps=cfg.split_gaps,
        shortest_s=cfg.shortest_s,
        overwrite=cfg.overwrite,
        limits=Limits(gap_s=cfg.gap_s, gap_samples=cfg.gap_samples),
        progress=lambda drive, done: print(f"{done:5d}  {drive}", flush=True),
    )
    print(f"{cfg.out}: {count} drive{'s' if count != 1 else ''}")


if __name__ == "__main__":
    main()
