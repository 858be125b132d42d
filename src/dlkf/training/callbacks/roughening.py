"""IMUs and receivers of the training pieces made worse than any preset (:mod:`dlkf.data.augmentation`)."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import torch

from dlkf.data.augmentation import Rough, roughen
from dlkf.data.drive import Batch
from dlkf.settings import settings_from
from dlkf.training.callbacks.masking import BatchCallback


class Roughening(BatchCallback):
    """Draws for every piece anew; keys are those of :class:`dlkf.data.augmentation.Rough`."""

    def __init__(self, **rough: Any) -> None:
        self.rough = settings_from(Rough, rough, "callbacks.roughening")

    def transform(self, batch: Batch, epoch: int, generator: torch.Generator) -> Batch:
        """The same motion, felt by other sensors."""
        return roughen(batch, self.rough, generator)

    def state_dict(self) -> dict:
        """Settings, so that a checkpoint tells what it was trained with."""
        return asdict(self.rough)
