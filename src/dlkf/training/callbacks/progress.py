"""One progress bar over the whole training, with the time to go."""

from __future__ import annotations

import time
from datetime import timedelta

import lightning as L
from lightning.pytorch.callbacks import Callback
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

EVERY = 10


class TrainingProgress(Callback):
    """Bar, epoch, losses and time to go; without a terminal a line every :data:`EVERY` epochs."""

    def __init__(self) -> None:
        self.console = Console(stderr=True)
        self.bar: Progress | None = None

    def on_train_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """Open the bar where training starts or resumes."""
        self.began, self.first = time.monotonic(), trainer.current_epoch
        self.silent = not trainer.is_global_zero
        if self.silent or not self.console.is_terminal:
            return
        self.bar = Progress(
            TextColumn("epoch"), MofNCompleteColumn(), BarColumn(), TextColumn("{task.description}"),
            TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn(elapsed_when_finished=False),
            console=self.console, speed_estimate_period=600.0,
        )  # fmt: skip
        self.task = self.bar.add_task("", total=trainer.max_epochs, completed=trainer.current_epoch)
        self.bar.start()

    def on_train_epoch_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """Advance."""
        done, seen = trainer.current_epoch + 1, trainer.callback_metrics
        text = f"loss {float(seen['train/loss']):.3f}"
        if "val/outage_end_m" in seen:
            text += f"  val outage {float(seen['val/outage_end_m']):.2f} m"
        if self.bar is not None:
            self.bar.update(self.task, completed=done, description=text)
        elif not self.silent and (done % EVERY == 0 or done == trainer.max_epochs):
            pace = (time.monotonic() - self.began) / (done - self.first)
            left = timedelta(seconds=round(pace * ((trainer.max_epochs or done) - done)))
            self.console.print(f"epoch {done}/{trainer.max_epochs}  {text}  {left} left", highlight=False)

    def on_train_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """Close the bar."""
        if self.bar is not None:
            self.bar.stop()

    def on_exception(self, trainer: L.Trainer, module: L.LightningModule, exception: BaseException) -> None:
        """Close the bar when training breaks off."""
        self.on_train_end(trainer, module)
