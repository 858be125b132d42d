"""How long the epochs of ``navigate`` are."""

import numpy as np
import pytest

from dlkf.filters.build import build_filter
from dlkf.filters.saved import grid_of
from dlkf.filters.shipped import trained_filter
from dlkf.running.offline import Fixes, epoch_for
from tests.cars import IMU

FIVE_A_SECOND = Fixes(*(np.arange(0.0, 10.0, 0.2) for _ in range(4)))


@pytest.mark.parametrize(
    ("name", "epoch_s"),
    [("ins", 0.2), ("mbkf15", 0.2), ("mbkf15_rts", 0.2), ("mbkf21_nhc", 1.0), ("mbkf21_car_gated_rts", 1.0)],
)
def test_epochs_are_as_long_as_fixes_are_apart_but_constraints_keep_a_second(name, epoch_s):
    estimator = build_filter(name, IMU)
    assert epoch_for([FIVE_A_SECOND], 50.0, estimator) == epoch_s
    assert epoch_for([FIVE_A_SECOND], 12.0, estimator) == 1.0  # 2.4 samples make no epoch


def test_a_network_round_a_filter_with_constraints_keeps_its_second():
    plus = trained_filter("plus")
    assert grid_of([plus]) == {"rate_hz": 50.0, "epoch_s": 1.0}
    assert epoch_for([FIVE_A_SECOND], 50.0, plus) == 1.0
