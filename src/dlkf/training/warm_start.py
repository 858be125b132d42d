"""What a learned filter may know before its first step: the training pieces' mean IMU error and feature sizes.

Neither uses the truth. The mean error is what the tuned 15-state filter estimates with GNSS, as ``mbkf15_prior`` is
told it; without it the cheapest descent moves the mean of everything inside the network, and what is learned is a
constant (paper.md 4.11).
"""

from __future__ import annotations

from collections.abc import Sequence

from dlkf.data.datamodule import DriveDataModule
from dlkf.filters.learned import LearnedFilter

PIECES = 60


def warm_start(model: LearnedFilter, data: DriveDataModule, mean_imu_error: Sequence[float] | None) -> None:
    """Start the IMU error at ``mean_imu_error`` (m/s² x 3, rad/s x 3) and learn the sizes of the features.

    Nothing happens to a model whose ``known_from`` is not ``training``.
    """
    if model.config.known_from != "training":
        return
    if mean_imu_error is not None:
        model.imu_error.start_at(mean_imu_error)
    batches, seen = [], 0
    for step in range(len(data.train_pieces(0))):
        batches.append(data.train_batch(0, step))
        seen += batches[-1].size[0]
        if seen >= PIECES:
            break
    was = model.training
    model.eval().learn_sizes(batches)
    model.train(was)
