"""Normalised errors: the algebra, and that filters with matching errors lie in their bands, others do not."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from dlkf.base.config import config_dir
from dlkf.data.masks import withhold_fixes
from dlkf.data.segments import StartLaw
from dlkf.diagnosis.consistency import (
    NormalisedSquares,
    chi2_band,
    draw_consistency,
    measure_consistency,
    normalised_square,
)
from dlkf.diagnosis.matched_drives import MatchedDrives, make_matched_batch, make_matched_drives
from dlkf.evaluation.outages import OutagePlan
from dlkf.filters.build import build_filter
from dlkf.navigation.imu_errors import imu_spec

CONSUMER = imu_spec(yaml.safe_load((config_dir() / "imu" / "consumer.yaml").read_text()))
# 2° of yaw: a filter linearises, and 10° is no small angle
DRIVES = MatchedDrives(drives=24, minutes=2.0, rate_hz=20, start=StartLaw(1.0, 0.1, 0.5, 2.0))


def test_it_is_the_quadratic_form_whatever_the_scales():
    g = torch.Generator().manual_seed(0)
    L = torch.randn(5, 4, 4, generator=g, dtype=torch.float64)
    scale = torch.tensor([1e3, 1.0, 1e-6, 1e-9], dtype=torch.float64)
    P = (L @ L.mT + torch.eye(4)) * scale[:, None] * scale
    e = torch.randn(5, 4, generator=g, dtype=torch.float64) * scale
    direct = [float(x @ np.linalg.solve(p, x)) for x, p in zip(e.numpy(), P.numpy())]
    torch.testing.assert_close(normalised_square(e, P), torch.tensor(direct, dtype=torch.float64), rtol=1e-6, atol=0)


def test_the_band_holds_the_mean_of_chi_square_draws():
    draws = np.random.default_rng(0).chisquare(15, (4000, 50)).mean(1) / 15
    low, high = chi2_band(15, 50)
    assert ((draws >= low) & (draws <= high)).mean() == pytest.approx(0.95, abs=0.01)


@pytest.mark.parametrize("name", ["mbkf15", "mbkf21", "mbkf33"])
def test_a_filter_with_matching_errors_knows_how_wrong_it_is(name):
    """The mean over 24 drives and the last 40 s, of which 20 s without GNSS; errors are correlated in time, so the
    band is that of a single time."""
    spec = make_matched_drives(CONSUMER, build_filter(name, CONSUMER).states)
    batch, matrices = make_matched_batch(DRIVES, spec)
    batch = withhold_fixes(batch, OutagePlan(80.0, 20.0).masks(batch)[0])
    result = measure_consistency(build_filter(name, spec), batch, matrices)
    assert np.isnan(result.nis[:, 80:100]).all()  # nothing to compare in the outage
    for what, values, degrees in result.parts():
        low, high = chi2_band(degrees, DRIVES.drives)
        assert low <= np.nanmean(values[:, 80:]) / degrees <= high, what


def test_a_filter_that_is_told_too_little_noise_is_found_out():
    spec = make_matched_drives(CONSUMER, build_filter("mbkf15", CONSUMER).states)
    batch, matrices = make_matched_batch(replace(DRIVES, drives=8, minutes=1.0), spec)
    sure = replace(
        spec,
        accel=replace(spec.accel, noise_density=0.3 * spec.accel.noise_density, turn_on_bias=0.005),
        gyro=replace(spec.gyro, noise_density=0.3 * spec.gyro.noise_density),
    )
    result = measure_consistency(build_filter("mbkf15", sure), batch, matrices)
    for what, values, degrees in result.parts()[:2]:
        assert np.nanmean(values[:, 20:]) / degrees > chi2_band(degrees, 8)[1], what


def test_errors_beyond_the_states_are_switched_off():
    spec = make_matched_drives(CONSUMER, build_filter("mbkf21", CONSUMER).states)
    assert spec.accel.scale_factor == CONSUMER.accel.scale_factor and spec.accel.misalignment == 0
    assert make_matched_drives(CONSUMER, build_filter("mbkf33", CONSUMER).states).gyro == CONSUMER.gyro


def test_the_command_writes_table_picture_and_numbers(call):
    size = ("drives=2", "minutes=0.5", "rate_hz=10", "outage.first_s=15", "outage.duration_s=10", "settle_s=2")
    done = call("consistency", "model=[mbkf15,mbkf21_car]", "out=found", *size)
    assert done.code == 0, done.err
    assert {p.name for p in Path("found").iterdir()} == {"table.md", "consistency.png", "consistency.json"}
    series = json.loads(Path("found/consistency.json").read_text())
    assert set(series) == {"mbkf15", "mbkf21_car"} and series["mbkf15"]["innovation"][20] is None
    done = call("consistency", "chassis=wide", "model=mbkf15", "out=any", *size)  # cars drawn from ranges
    assert done.code == 0, done.err
    done = call("consistency", "model=plus", "out=learned", *size)
    assert done.code == 0 and "plus" in json.loads(Path("learned/consistency.json").read_text()), done.err
    done = call("consistency", "model=ins", "out=nowhere", *size)
    assert done.code == 2 and "model ins has no covariance" in done.err and not Path("nowhere").exists()
    done = call("consistency", "model=mbkf15", "out=nowhere", "drives=1")
    assert done.code == 2 and "drives is 1" in done.err


def test_outages_are_drawn_apart():
    """The first epoch, three and the last one: each from the end of the epoch before."""
    ones = np.ones((2, 12))
    hidden = np.isin(np.arange(12), (0, 4, 5, 6, 11))
    for ax in draw_consistency({"mbkf15": NormalisedSquares(15, 2.0, ones, ones, ones)}, hidden).axes:
        shaded = sorted((p.get_x(), p.get_x() + p.get_width()) for p in ax.patches if p.get_width() < 24)
        assert [span for span in shaded if span[1] > 1] == [(0.0, 2.0), (8.0, 14.0), (22.0, 24.0)]
