"""Does a filter estimate the IMU error, or has it memorised one? (checklist 4.7)"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from dlkf.data.drive import Batch
from dlkf.evaluation.metrics import Array, slope
from dlkf.evaluation.results import last_known
from dlkf.evaluation.run import score
from dlkf.evaluation.scores import Scores
from dlkf.filters.integration import Estimator


def injected(batch: Batch, bias: Tensor) -> Batch:
    """The batch with a constant added to its raw IMU (B, 6) and to its true IMU error."""
    return replace(
        batch,
        imu=batch.imu + bias.to(batch.imu)[:, None, None],
        true_imu_error=batch.true_imu_error + bias.to(batch.true_imu_error)[:, None],
    )


def injected_slope(
    base: Scores,
    filters: Mapping[str, Estimator],
    batches: Sequence[Batch],
    *,
    accel: float,
    gyro: float,
    outages: Sequence[Tensor] | None = None,
    seed: int = 0,
) -> dict[str, Array]:
    """Slope (6,) per filter of the change of its last estimate against a bias injected into every piece.

    The bias is drawn per piece from N(0, accel²) [m/s²] and N(0, gyro²) [rad/s]; ``base`` are the scores of
    the same filters, batches and outages without it. Works on real drives, whose IMU error nobody knows.
    """
    generator = torch.Generator().manual_seed(seed)
    sigma = torch.tensor([accel] * 3 + [gyro] * 3, dtype=torch.float64)
    biases = [sigma * torch.randn(b.size[0], 6, generator=generator, dtype=torch.float64) for b in batches]
    shifted = [injected(b, bias) for b, bias in zip(batches, biases, strict=True)]
    scores = score(filters, shifted, outages=outages)
    cause = np.concatenate([b.numpy() for b in biases])
    return {
        name: slope(
            last_known(run.imu_error) - last_known(base.filters[name].imu_error), cause, intercept=False
        )
        for name, run in scores.filters.items()
    }
