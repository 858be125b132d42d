"""Covariance matching: an honest filter sees ones, one whose noise is too small sees more."""

from dataclasses import replace

import pytest
import torch

from dlkf.filters.integration import Fix, advance
from dlkf.filters.matching import LOG_FEATURES, Matching, variance_along
from dlkf.filters.plus import PlusFilter
from dlkf.filters.tuning import Tuning
from dlkf.navigation.calibration import ImuError

from .scene import IMU, RATE, scene
from .test_plus import plus

ATTITUDE_RATIOS = slice(3, 6)


def matched(batch, model) -> Matching:
    """What the filter has kept after the last epoch."""
    state = batch.start
    memory, error = model.begin(batch)
    error = ImuError.of(error)
    with torch.no_grad():
        for t in range(batch.size[1]):
            fix = Fix(batch.gnss[:, t], batch.gnss_std[:, t], batch.gnss_valid[:, t], None)
            memory, step = advance(
                model, memory, state, error, batch.imu[:, t], fix,
                dt=batch.dt, frame=batch.frame, lever_arm_b=None,
            )  # fmt: skip
            state, error = step.posterior, step.error
    return memory.matching


def honest() -> PlusFilter:
    """The plain filter with 15 states, told the IMU of the scene, with no factor on anything."""
    model = plus(base="mbkf15")
    model.kalman = replace(model.kalman, imu=IMU, tuning=Tuning())
    return model


@pytest.mark.parametrize("axis", [None, 0, 1])
def test_a_gyroscope_worse_than_thought_is_seen_most_on_its_own_axis(axis):
    """40 times its noise, over 60 fixes of 40 cars. Its cars turn by 20° a second, which mixes the level axes."""
    batch = scene(40, 60, seed=3)
    imu = batch.imu.clone()
    if axis is not None:
        g = torch.Generator().manual_seed(1)
        imu[..., 3 + axis] += 40 * 7e-5 * RATE**0.5 * torch.randn(imu.shape[:3], generator=g, dtype=imu.dtype)
    ratios = matched(replace(batch, imu=imu), honest()).ratios[:, 1, ATTITUDE_RATIOS].median(0).values
    if axis is None:
        assert float(ratios.min()) > 0.4 and float(ratios.max()) < 2.0
    else:
        assert float(ratios[axis]) > 5 and int(ratios.argmax()) == axis


def test_means_are_true_ones_first_and_fade_later():
    one = torch.ones(1, 6, dtype=torch.float64)
    known = Matching.begin(one, 1)
    used = torch.ones(1, 6, dtype=torch.bool)
    for k in range(4):
        known = known.update(one * k, used)
    assert torch.allclose(known.innovations, torch.tensor((0 + 1 + 4 + 9) / 4, dtype=torch.float64))
    for _ in range(30):
        known = known.update(0 * one, used)
    short, long = known.innovations[0, :, 0]
    assert float(long) == pytest.approx(14 / 34) and float(short) < 0.1 * float(long) * 3


def test_without_a_fix_nothing_is_learned():
    batch = scene(2, 12)
    blind = replace(batch, gnss_valid=torch.zeros_like(batch.gnss_valid))
    kept = matched(blind, honest())
    assert torch.equal(kept.logarithms(), Matching.begin(batch.imu, 2).logarithms())
    assert kept.logarithms().shape == (2, LOG_FEATURES)


def test_variance_along_axes_is_the_diagonal_of_the_turned_blocks():
    g = torch.Generator().manual_seed(2)
    P, C = (torch.randn(4, n, n, generator=g, dtype=torch.float64) for n in (9, 3))
    blocks = [(C.mT @ P[:, k : k + 3, k : k + 3] @ C).diagonal(dim1=1, dim2=2) for k in (0, 3, 6)]
    assert torch.allclose(variance_along(P, C), torch.cat(blocks, -1), rtol=0, atol=1e-12)
