"""Averages are exact, fixes keep their time, the reference is interpolated only where it may be."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dlkf.base.errors import InputError
from dlkf.data import resampling
from dlkf.data.resampling import SampleGrid, assign_fixes, epoch_grid, fix_phase, interpolate_reference, resample_imu
from dlkf.data.schema import ACCEL, ATTITUDE, GYRO, IMU_ERROR, POSITION, STD, VELOCITY
from dlkf.data.store import drive_from_tables
from dlkf.data.tables import DriveRow
from dlkf.data.validate import CheckedTables
from dlkf.navigation import compiled
from dlkf.navigation.attitude import rotation_from_rpy
from dlkf.navigation.earth import ecef_from_geodetic, ned_axes


@pytest.fixture(autouse=True, params=["arrays", "loops"])
def form(request):
    """Every test with both forms of the resampling."""
    if request.param == "arrays":
        with compiled.without_loops():
            yield
    else:
        compiled.load_loops()
        if not compiled.loops_are_loaded():
            pytest.skip("loops cannot be compiled here")
        yield


def _imu(t: np.ndarray, values: np.ndarray) -> dict:
    return {"t": t, **dict(zip((*ACCEL, *GYRO), values.T))}


def _means(t: np.ndarray, first: float) -> np.ndarray:
    """Exact means of six polynomials and sines over (t_{k−1}, t_k]."""
    at = np.concatenate(([first], t))
    integrals = [at, at**2 / 2, np.sin(at), -np.cos(3 * at) / 3, at**3 / 3, np.exp(-at)]
    return np.stack([np.diff(x) / np.diff(at) for x in integrals], -1)


def test_a_whole_ratio_is_the_average_of_the_samples():
    """Of the rates about one axis, and of the forces where nothing turns: no coning and no sculling."""
    t = 5.0 + np.arange(1, 2001) / 100
    x = np.random.default_rng(0).standard_normal((2000, 6))
    x[:, 3:5] = 0
    x[:, :2] = 0
    grid = epoch_grid(t, np.array([6.0, 7.0]), 50, 1.0, "a")
    assert (grid.t0, grid.epochs, grid.samples) == (5.0, 20, 50)
    out = resample_imu(_imu(t, x), grid)
    # rounding of the stamps, 1e-15 · 25 s, over the sample of 0.02 s
    np.testing.assert_allclose(out.reshape(-1, 6), x.reshape(-1, 2, 6).mean(1), atol=1e-11)


@pytest.mark.parametrize("rate", [104.3, 100.0, 73.1, 400.0])
@pytest.mark.parametrize("jitter", [0.0, 0.2])
def test_odd_and_jittering_rates_keep_the_integral(rate, jitter):
    """At any grid time the integral is off by no more than one sample's curvature, h² f'/8."""
    rng = np.random.default_rng(1)
    t = np.arange(1, round(30 * rate)) / rate
    t = t + jitter / rate * rng.uniform(-1, 1, len(t))
    x = _means(t, t[0] - float(np.median(np.diff(t))))
    grid = epoch_grid(t, np.array([3.25, 4.25]), 50, 1.0, "a")
    assert grid.t0 == pytest.approx(0.25)
    out = np.stack([resample_imu(_imu(t, x * only), grid)[..., k].ravel() for k, only in enumerate(np.eye(6))], -1)
    at = grid.sample_times
    exact = _means(at[1:], at[0])
    worst = (1 + 2 * jitter) ** 2 / rate**2 / 8 * np.array([1e-9, 1, 1, 3, 2 * 30, 1])
    drift = np.abs(np.cumsum(out - exact, 0) * 0.02)
    assert (drift <= 2.1 * worst + 1e-9).all()


def test_constant_input_stays_constant_through_gaps():
    t = np.delete(np.arange(1, 1001) / 100, slice(300, 310))
    out = resample_imu(_imu(t, np.ones((len(t), 6))), epoch_grid(t, np.array([1.0]), 50, 1.0, "a"))
    np.testing.assert_allclose(out, 1.0, atol=1e-12)


@pytest.mark.parametrize("missing", [1, 4, 20])
def test_a_gap_is_filled_from_both_sides(missing):
    """Over what is missing of a ramp the mean of the neighbours is right to the ramp over one sample."""
    t = np.arange(1, 1001) / 100
    x = np.repeat((t - 0.005)[:, None], 6, 1)
    kept = np.delete(np.arange(1000), slice(300, 300 + missing))
    grid = epoch_grid(t[kept], np.array([1.0]), 50, 1.0, "a")
    whole, part = (resample_imu(_imu(t[k], x[k]), grid) for k in (np.arange(1000), kept))
    assert np.abs((whole - part).sum((0, 1)) * 0.02).max() < missing * 0.01 * 0.01


@pytest.mark.parametrize("block", [7, 64])
def test_blocks_of_samples_do_not_matter(block, monkeypatch):
    """Through jitter and gaps, at the first and the last sample: what a block needs of its neighbours it gets."""
    rng = np.random.default_rng(2)
    t = 3.0 + np.cumsum(rng.uniform(0.006, 0.014, 3000))
    t, x = np.delete(t, slice(1000, 1040)), rng.standard_normal((2960, 6))
    grid = epoch_grid(t, np.array([5.0]), 50, 1.0, "a")
    whole = resample_imu(_imu(t, x), grid)
    monkeypatch.setattr(resampling, "BLOCK", block)
    # rounding of integrals of order 0.02
    np.testing.assert_allclose(resample_imu(_imu(t, x), grid), whole, atol=1e-12)


def test_the_phase_is_that_of_the_fixes():
    assert fix_phase(np.arange(10) + 0.999, 1.0) % 1 == pytest.approx(0.999)
    assert fix_phase(np.arange(10) + np.where(np.arange(10) % 2, 1e-4, -1e-4), 1.0) == pytest.approx(0, abs=2e-4)
    mostly = np.arange(20) + 0.4
    mostly[3] -= 0.1
    assert fix_phase(mostly, 1.0) % 1 == pytest.approx(0.4)
    assert fix_phase(0.07 + np.arange(50) / 5, 1.0) * 5 % 1 == pytest.approx(0.35)  # any of the five
    jitter = np.arange(200) + 0.5 + 0.05 * np.random.default_rng(0).uniform(-1, 1, 200)
    assert 0.53 < fix_phase(jitter, 1.0) % 1 < 0.55  # a late one: few fixes wait a whole epoch
    assert fix_phase(np.zeros(0), 1.0) == 0.0


def _gnss(t: np.ndarray) -> dict:
    n = len(t)
    table = {"t": t, "quality": np.full(n, 4)}
    table |= {"lat_deg": 50 + 1e-5 * t, "lon_deg": 9 + 0 * t, "height_m": 100 + t}
    table |= dict.fromkeys(VELOCITY, np.ones(n)) | dict.fromkeys(STD, np.full(n, 0.1))
    return table


def test_a_fix_goes_to_the_first_boundary_at_or_after_it_and_keeps_its_lag():
    t = np.array([0.0, 1.0005, 1.9, 2.7, 2.8, 4.3])
    fixes = assign_fixes(_gnss(t), SampleGrid(0.0, 1.0, 5, 50))
    assert fixes.valid[:, 0].tolist() == [True, True, True, True, False, True]
    np.testing.assert_allclose(fixes.lag, [0, 0, 0.1, 0.2, 0, 0.7], atol=1e-12)
    lat, lon = torch.tensor(np.radians(50 + 1e-5 * 2.8)), torch.tensor(np.radians(9.0))
    r_e = ecef_from_geodetic(lat, lon, torch.tensor(102.8, dtype=torch.float64)).numpy()
    np.testing.assert_allclose(fixes.r_e[3], r_e, atol=1e-8)  # the latest in the epoch


def test_a_position_that_repeats_is_that_of_the_first_time():
    """Of a receiver that repeats its last position: the fix has the time of the one that it repeats."""
    t = np.array([0.0, 0.6, 0.8, 1.0, 1.2, 1.6, 2.0])
    gnss = _gnss(t)
    for column in ("lat_deg", "lon_deg", "height_m"):
        gnss[column][2:] = gnss[column][2]
    fixes = assign_fixes(gnss, SampleGrid(0.0, 1.0, 3, 50))
    np.testing.assert_allclose(fixes.lag[:3], [0.0, 0.2, 0.8], atol=1e-12)


def test_unknown_stds_and_velocities():
    gnss = _gnss(np.arange(6.0))
    gnss["quality"] = np.array([4, 5, 2, 1, 0, 6])
    for name in STD:
        gnss[name] = np.full(6, np.nan)
    gnss["vel_d"] = np.full(6, np.nan)
    fixes = assign_fixes(gnss, SampleGrid(0.0, 1.0, 5, 50))
    assert fixes.valid.tolist() == [[True] * 5 + [False]] * 4 + [[False] * 6] * 2
    np.testing.assert_allclose(fixes.std[:4, 0], [0.02, 0.3, 1.0, 2.5])
    np.testing.assert_allclose(fixes.std[:4, 2], np.array([0.02, 0.3, 1.0, 2.5]) * 1.5)
    np.testing.assert_allclose(fixes.std[:4, 3], [0.05, 0.1, 0.1, 0.2])
    assert np.isfinite(fixes.v_e[:4]).all()


def test_a_std_of_0_is_unknown():
    """Drivers that do not know it leave it at zero; one that is small is taken, down to a millimetre."""
    gnss = _gnss(np.arange(4.0))
    gnss["quality"] = np.full(4, 1)
    for name in STD:
        gnss[name] = np.array([0.0, np.nan, 1e-9, 0.7])
    std = assign_fixes(gnss, SampleGrid(0.0, 1.0, 3, 50)).std
    np.testing.assert_array_equal(std[0], [2.5, 2.5, 3.75, 0.2, 0.2, 0.2])
    np.testing.assert_array_equal(std[1:], [[*std[0]], [1e-3] * 6, [0.7] * 6])


def test_a_row_without_a_position_has_no_say_in_the_phase():
    t, gnss = np.arange(0, 20, 0.02), _gnss(np.arange(2.0, 18.0) + 0.4)
    imu = _imu(t, np.tile([0, 0, -9.81, 0, 0, 0], (len(t), 1)))
    tables = CheckedTables(DriveRow("a", "a", (0.0, 0.0, 0.0)), imu, gnss, None)
    t0 = drive_from_tables(tables, "", 50.0, 1.0, torch.float64).t0
    gnss["lat_deg"][5:] = np.nan
    gnss["t"][5:] += 0.3
    assert drive_from_tables(tables, "", 50.0, 1.0, torch.float64).t0 == pytest.approx(t0)


def _reference(t: np.ndarray) -> dict:
    n = len(t)
    table = {"t": t, "valid": np.ones(n, bool)}
    table |= dict(zip(POSITION, (50 + 0 * t, 9 + 0 * t, 100 + t**3)))
    table |= dict(zip(VELOCITY, (0 * t, 0 * t, -3 * t**2)))
    table |= dict(zip(ATTITUDE, (0 * t, 0 * t, 0.4 * t)))
    return table | {name: k * t for k, name in enumerate(IMU_ERROR)}


def test_the_reference_between_samples():
    """A cubic height is exact under Hermite interpolation, a constant turn along the geodesic."""
    truth = interpolate_reference(_reference(np.arange(0, 6, 0.4) + 0.1), SampleGrid(1.0, 1.0, 3, 50))
    assert truth.valid.all()
    at = np.arange(1.0, 5.0)
    lat, lon = (torch.full((4,), np.radians(x), dtype=torch.float64) for x in (50.0, 9.0))
    r_e = ecef_from_geodetic(lat, lon, torch.from_numpy(100 + at**3)).numpy()
    np.testing.assert_allclose(truth.r_e, r_e, atol=1e-8)
    C_eb = ned_axes(lat, lon) @ rotation_from_rpy(torch.from_numpy(np.stack((0 * at, 0 * at, 0.4 * at), -1)))
    np.testing.assert_allclose(truth.C_eb, C_eb.numpy(), atol=1e-12)
    np.testing.assert_allclose(truth.imu_error, np.arange(6) * at[:, None], atol=1e-12)


def test_the_reference_is_not_invented():
    table = _reference(np.array([0.0, 0.5, 1.0, 1.5, 3.5, 4.0, 4.5, 5.0, 5.5]))
    table["valid"][5] = False  # t = 4.0
    table["roll"][7] = np.nan  # t = 5.0
    truth = interpolate_reference(table, SampleGrid(0.0, 1.0, 6, 50))
    # 2 and 3 lie in a gap of 2 s, 4 is not valid, 5 has no roll, 6 is past the end
    assert truth.valid.tolist() == [True, True, False, False, False, True, False]
    assert np.isnan(truth.C_eb).any((1, 2)).tolist() == [False, False, True, True, True, True, True]
    beside = interpolate_reference(table, SampleGrid(0.5, 1.0, 4, 50))  # an exact hit next to an unusable sample stands
    assert beside.valid.tolist() == [True, True, False, True, True]
    assert np.isfinite(beside.C_eb[3]).all()
    assert not interpolate_reference(None, SampleGrid(0.0, 1.0, 5, 50)).valid.any()


def test_impossible_grids_are_refused():
    t = np.arange(1, 50) / 100
    with pytest.raises(InputError, match=r"drive a: only 0\.49 s"):
        epoch_grid(t, np.zeros(1), 50, 1.0, "a")
    with pytest.raises(InputError, match="whole number of samples"):
        epoch_grid(t, np.zeros(1), 50, 0.25, "a")


def test_both_forms_give_the_same_to_the_bit():
    """At any ratio, with jitter, missing samples, a grid that begins before the samples or ends after them."""
    rng = np.random.default_rng(5)
    compiled.load_loops()
    for rate, jitter, kept in ((100.0, 0.0, 1.0), (47.3, 0.3, 1.0), (125.0, 0.0, 0.9), (400.0, 0.3, 0.8)):
        t = 1000.1 + np.arange(2000) / rate
        t = np.sort(t + jitter / rate * rng.uniform(-1, 1, 2000))[rng.uniform(size=2000) <= kept]
        imu = _imu(t, rng.standard_normal((len(t), 6)))
        exact = epoch_grid(t, t[:1], 50, 1.0, "a")
        for grid in (exact, SampleGrid(exact.t0 - 0.021, 1.0, exact.epochs + 1, 50)):
            loops = resample_imu(imu, grid)
            with compiled.without_loops():
                np.testing.assert_array_equal(resample_imu(imu, grid), loops)
