"""The losses of every epoch as a table in the run folder, which a training that goes on continues."""

from __future__ import annotations

import csv
from pathlib import Path

import lightning as L
import pandas as pd
from lightning.pytorch.callbacks import Callback

LOSSES = "losses.csv"
COLUMNS = ("train/loss", "val/loss", "val/outage_end_m")


class LossHistory(Callback):
    """Appends a row to ``losses.csv`` at the end of every epoch; validation is empty where there was none."""

    def __init__(self, folder: str) -> None:
        self.file, self.validated = Path(folder) / LOSSES, False

    def on_train_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """A heading where training begins."""
        if trainer.is_global_zero and trainer.current_epoch == 0:
            self.file.parent.mkdir(parents=True, exist_ok=True)
            self._write("w", ["epoch", *COLUMNS])

    def on_validation_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """The values of this epoch are new."""
        self.validated = True

    def on_train_epoch_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """A row."""
        seen = trainer.callback_metrics
        known = [c for c in COLUMNS if c in seen and (self.validated or not c.startswith("val/"))]
        self.validated = False
        if trainer.is_global_zero:
            cells = [f"{float(seen[c]):.6g}" if c in known else "" for c in COLUMNS]
            self._write("a", [str(trainer.current_epoch + 1), *cells])

    def _write(self, mode: str, row: list[str]) -> None:
        with self.file.open(mode, newline="", encoding="utf-8") as file:
            csv.writer(file, lineterminator="\n").writerow(row)


def read_losses(folder: Path) -> dict[str, list[float]]:
    """Columns of ``losses.csv``, NaN where a cell is empty; of an epoch that was repeated after a kill the last row.
    Empty of a folder without it."""
    if not (folder / LOSSES).is_file():
        return {}
    table = pd.read_csv(folder / LOSSES, dtype=float).drop_duplicates("epoch", keep="last").sort_values("epoch")
    return {str(name): column.tolist() for name, column in table.items()}
