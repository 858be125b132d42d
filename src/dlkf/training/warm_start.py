"""Values that a learned filter may start from: the training segments' mean IMU error and feature sizes.

Neither uses the truth. The mean error is what the tuned 15-state filter estimates with GNSS, as ``mbkf15_prior`` is
given to it; without it the cheapest descent moves the mean of everything inside the network, and what is learned is a
constant (paper.md 4.11).
"""

from __future__ import annotations

from collections.abc import Sequence

from dlkf.data.datamodule import DriveDataModule
from dlkf.filters.learned import LearnedFilter
from dlkf.filters.learned_kalman import LearnedKalmanFilter

SEGMENTS = 60


def warm_start(model: LearnedFilter, data: DriveDataModule, mean_imu_error: Sequence[float] | None) -> None:
    """Start the IMU error at ``mean_imu_error`` (m/s² x 3, rad/s x 3) and learn the sizes of the features.

    Nothing happens to a model whose ``known_from`` is not ``training``. Round a Kalman filter the network's own error
    starts at zero: the filter has the mean, if it is one with ``_prior``.
    """
    if model.config.known_from != "training":
        return
    if mean_imu_error is not None and not isinstance(model, LearnedKalmanFilter):
        model.imu_error.start_at(mean_imu_error)
    batches, seen = [], 0
    for step in range(len(data.train_segments(0))):
        batches.append(data.train_batch(0, step))
        seen += batches[-1].size[0]
        if seen >= SEGMENTS:
            break
    was = model.training
    model.eval().learn_sizes(batches)
    model.train(was)
