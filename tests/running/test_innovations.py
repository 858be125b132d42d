"""Bounds of normalised innovations: closed forms, and filters on simulated drives that are right or too sure."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from dlkf.command.composing import compose_command
from dlkf.filters.build import build_filter
from dlkf.filters.shipped import trained_filter
from dlkf.filters.tuning import Tuning
from dlkf.navigation.imu_errors import imu_spec
from dlkf.running import innovations
from dlkf.running.innovations import CHANCE, SETTLE, STRETCH, Innovation, fit_sigma, rms, worst_stretch
from dlkf.running.offline import Navigated, navigate_dataset, sigma_warning
from tests.drives import drives_in
from tests.worlds import SIZE

N = 300 + SETTLE  # updates


def autoregressive(phi: float, seed: int, n: int = N) -> np.ndarray:
    """Six components of unit variance with ρ_j = φʲ."""
    rng = np.random.default_rng(seed)
    x = np.empty((n, 6))
    x[0] = rng.standard_normal(6)
    for k, noise in enumerate(np.sqrt(1 - phi**2) * rng.standard_normal((n - 1, 6))):
        x[k + 1] = phi * x[k] + noise
    return x


def test_white_innovations_of_the_right_size_lie_within_the_bounds() -> None:
    """1 of 5000 would be outside; of 300, none but by a great accident; ν is that of 6 components each (± 20 %)."""
    fits = [fit_sigma(np.random.default_rng(seed).standard_normal((N, 6))) for seed in range(300)]
    assert CHANCE < 1e-3 and all(f.low < f.ratio < f.high and not f.too_small for f in fits)
    assert np.median([f.degrees for f in fits]) == pytest.approx(6 * 300, rel=0.2)


@pytest.mark.parametrize("updates", [20, 60])
def test_the_bound_is_exceeded_as_seldom_as_it_says(monkeypatch: pytest.MonkeyPatch, updates: int) -> None:
    """1 % above the upper bound of α = 2 %: of 1500 at most 15 + 3 √15; and some are, so it is no bound of its own."""
    monkeypatch.setattr(innovations, "CHANCE", 0.02)
    rng = np.random.default_rng(updates)
    fits = [fit_sigma(rng.standard_normal((updates + SETTLE, 6))) for _ in range(1500)]
    assert 2 <= sum(f.ratio > f.high for f in fits) <= 26


@pytest.mark.parametrize("phi", [0.7, 0.95])
def test_correlated_ones_count_as_fewer(phi: float) -> None:
    """Squares of an AR(1) have ρ_j = φ²ʲ, so n_eff = n (1 − φ²)/(1 + φ²); still none gets a warning."""
    fits = [fit_sigma(autoregressive(phi, seed)) for seed in range(200)]
    expected = 6 * 300 * (1 - phi**2) / (1 + phi**2)
    assert np.median([f.degrees for f in fits]) == pytest.approx(expected, rel=0.4)
    assert not any(f.too_small for f in fits)


@pytest.mark.parametrize("phi", [0.0, 0.95])
def test_twice_the_size_is_always_too_sure(phi: float) -> None:
    assert all(fit_sigma(2.2 * autoregressive(phi, seed)).too_small for seed in range(100))


def test_components_that_go_together_count_once() -> None:
    """Six copies of one are one: Satterthwaite's degrees."""
    one = np.random.default_rng(3).standard_normal((N, 1))
    assert fit_sigma(np.repeat(one, 6, axis=1)).degrees == pytest.approx(300, rel=0.3)


def test_what_is_not_known_is_left_out() -> None:
    """The first updates, outages, positions alone, several drives; nothing known gives none."""
    x = np.random.default_rng(4).standard_normal((N, 6))
    early = x.copy()
    early[:SETTLE] *= 100
    assert fit_sigma(early)[:4] == fit_sigma(x)[:4]
    positions = x.copy()
    positions[:, 3:] = np.nan
    positions[200:260] = np.nan
    fit = fit_sigma(positions)
    assert fit.ratio == pytest.approx(np.sqrt(np.nanmean(positions[SETTLE:] ** 2))) and fit.degrees < 3 * 240 * 1.3
    assert fit_sigma(x, x[::-1]).degrees > 1.5 * fit_sigma(x).degrees
    assert fit_sigma(np.full((N, 6), np.nan)) is None and fit_sigma(x[: SETTLE + 1]) is None


def test_the_line_names_the_remedy() -> None:
    line = fit_sigma(3 * np.random.default_rng(5).standard_normal((N, 6))).warning("mbkf15")
    assert line.startswith("mbkf15 is overconfident: its innovations are 2.9 times their 1σ") and "dlkf tune" in line
    assert "\n" not in line


def test_the_line_has_the_number_of_the_tables() -> None:
    x = 3 * np.random.default_rng(5).standard_normal((N, 6))
    x[:SETTLE] *= 4
    assert f"innovations are {rms(x):.2g} times their 1σ" in fit_sigma(x).warning("mbkf15")


def test_the_worst_stretch_is_found() -> None:
    """Of updates with a fix, after those that settle; none of a drive with fewer."""
    x = np.random.default_rng(6).standard_normal((N, 6))
    assert worst_stretch(x)[0] < 1.5
    x[:SETTLE] *= 100
    x[100 : 100 + STRETCH + 5] *= 4
    x[110:115] = np.nan
    off, first, last = worst_stretch(x)
    assert off == pytest.approx(4, rel=0.1) and (first, last) == (100, 99 + STRETCH + 5)
    assert worst_stretch(x[: SETTLE + STRETCH - 1]) == (0.0, 0, 0)


def test_a_drive_with_a_bad_stretch_gets_a_line_with_its_times() -> None:
    x = np.random.default_rng(7).standard_normal((N, 6)) / 2
    table = pd.DataFrame({"t": 40.0 + np.arange(N)})
    good = Navigated("good", 40.0, table, Innovation(x.copy(), np.ones_like(x)))
    x[200 : 200 + STRETCH] *= 8
    bad = Navigated("bad", 40.0, table, Innovation(x, np.ones_like(x)))
    assert sigma_warning([good], "mbkf15", "do this") is None
    line = sigma_warning([good, bad], "mbkf15", "do this")
    assert line is not None and "mbkf15 is overconfident in drive bad from t = 240 to 259 s" in line
    assert line.endswith("do this") and "\n" not in line


@pytest.mark.whole
@pytest.mark.parametrize(
    ("name", "factor", "warned"),
    [
        ("plus", 1.0, False),
        ("mbkf21_car tuned", 1.0, False),
        ("mbkf15", 0.1, True),
        ("mbkf21_nhc", 0.1, True),
        ("mbkf21_car", 0.1, True),
    ],
)
def test_filters_on_simulated_drives(simulated, name: str, factor: float, warned: bool) -> None:
    """Of consumer sensors: one with a tenth of their noise gets the line on every drive, a tuned one on none."""
    values = compose_command("navigate", "imu=consumer", "tuning=any_car", "dataset=x")
    sensors = {
        s: {k: x if k == "correlation_time" else factor * x for k, x in values["imu"][s].items()}
        for s in ("accel", "gyro")
    }
    kind, *tuned = name.split()
    tuning = Tuning(**values["tuning"]) if tuned else None
    spec = imu_spec(values["imu"] | sensors)
    model = trained_filter("plus") if kind == "plus" else build_filter(kind, spec, tuning=tuning)
    drives = list(navigate_dataset(simulated, model, rate_hz=50.0, epoch_s=1.0))
    lines = [sigma_warning([drive], kind, "tune it") for drive in drives]
    assert len(lines) == 2 and all((line is not None) == warned for line in lines), lines


NOT_STATES = {f"imu.{s}.{k}": 0.0 for s in ("accel", "gyro") for k in ("scale_factor", "misalignment")}


@pytest.mark.parametrize(
    ("name", "errors", "fits"),
    [("mbkf15", "all", False), ("mbkf33", "all", True), ("mbkf15", "those of its states", True)],
)
def test_its_own_preset_is_right_where_all_errors_are_states(tmp_path, name: str, errors: str, fits: bool) -> None:
    """Scale factors and misalignments of the IMU are none of 15 states: warned of rightly; without them 1σ fits."""
    left_out = [] if errors == "all" else [f"{key}={value}" for key, value in NOT_STATES.items()]
    of = ["simulated@dataset=one_imu", "dataset.name=town", *SIZE, "dataset.drive_minutes=3", "dataset.hours=0.1"]
    folder = drives_in(compose_command("simulate", *of, *left_out), tmp_path / "town")
    values = compose_command("navigate", "dataset=x", *left_out)
    model = build_filter(name, imu_spec(values["imu"]), tuning=Tuning(**values["tuning"]))
    drives = list(navigate_dataset(folder, model, rate_hz=50.0, epoch_s=1.0))
    fit = fit_sigma(*(drive.innovation.ratio for drive in drives))
    assert fit.too_small != fits and (fit.low < fit.ratio < fit.high) == fits, fit


def test_a_warning_has_the_number_of_the_tables_unless_uncertain_first_updates_hide_the_fault() -> None:
    x = 2.0 * np.random.default_rng(0).standard_normal((SETTLE + 60, 6))
    assert fit_sigma(x).reported_ratio == pytest.approx(rms(x))
    few = x[: SETTLE + 6]
    few[:SETTLE] = 0.0
    assert rms(few) < fit_sigma(few).high and fit_sigma(few).reported_ratio == fit_sigma(few).ratio > 1.5
