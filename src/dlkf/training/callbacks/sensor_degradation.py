"""IMUs and receivers of the training segments made worse than any preset (:mod:`dlkf.data.augmentation`)."""

from __future__ import annotations

from typing import Any

import torch

from dlkf.base.settings import settings_from
from dlkf.data.augmentation import SensorDegradation, degrade_sensors
from dlkf.data.drive import Batch
from dlkf.training.callbacks.masking import BatchCallback


class SensorDegradationCallback(BatchCallback):
    """Draws for every segment; keys are those of :class:`dlkf.data.augmentation.SensorDegradation`."""

    def __init__(self, **rough: Any) -> None:
        self.rough = settings_from(SensorDegradation, rough, "callbacks.sensor_degradation")

    def transform(self, batch: Batch, epoch: int, generator: torch.Generator) -> Batch:
        """The batch with degraded IMU samples and fixes."""
        return degrade_sensors(batch, self.rough, generator)
