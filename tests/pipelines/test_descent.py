"""Factors found by gradient: the same filter as one that is told them, and no worse than where they began."""

import pytest
import torch
from pipelines.studies.tuning.descent import FACTORS, ScaledFilter, tune_by_gradient

from dlkf.data.masks import withhold_fixes
from dlkf.evaluation.outages import OutagePlan
from dlkf.filters.build import build_filter
from dlkf.filters.integration import integrate
from dlkf.filters.tuning import Tuning
from dlkf.tuning.search import evaluate_objective
from tests.filters.scene import IMU, scene


@pytest.fixture(scope="module")
def batch():
    whole = scene(4, 40, seed=3)
    return withhold_fixes(whole, OutagePlan(20.0, 15.0).masks(whole)[0])


def test_a_factor_by_advice_is_a_factor_by_tuning(batch):
    advised = ScaledFilter(build_filter("mbkf33_car", IMU, tuning=Tuning()))
    with torch.no_grad():
        advised.logarithms.copy_(torch.linspace(-0.5, 1.0, len(FACTORS)))
        there = integrate(batch, advised).posterior.p_n
    expected = integrate(batch, build_filter("mbkf33_car", IMU, tuning=advised.tuning())).posterior.p_n
    plain = integrate(batch, build_filter("mbkf33_car", IMU, tuning=Tuning())).posterior.p_n
    assert (there - expected).abs().max() < 1e-9  # m: rounding
    assert (there - plain).abs().max() > 1


def test_it_descends(batch):
    kalman = build_filter("mbkf33_car", IMU, tuning=Tuning(accel_noise=30.0, lateral_std=2.0))
    found = tune_by_gradient(kalman, batch, 34, steps=3)
    before, after = (
        evaluate_objective(build_filter("mbkf33_car", IMU, tuning=tuning), [batch]) for tuning in (kalman.tuning, found)
    )
    assert after < 0.97 * before
