"""GNSS fixes: where the antenna is and how it moves, noise of the stated size."""

import math

import numpy as np
import pymap3d
import pytest

from dlkf.base.errors import InputError
from dlkf.simulation.gnss.satellite_fixes import delay_fixes, report_fixes
from dlkf.simulation.gnss.white import GnssConfig, episodes, observe
from dlkf.simulation.imu import inverse_mechanisation
from dlkf.simulation.motion.vehicle import Truth, VehicleConfig, drive_vehicle

RATE = 100
QUIET = dict.fromkeys(("std_horizontal", "std_vertical", "std_velocity"), 1e-12)


def still(seconds: int) -> Truth:
    """A standing car, once a second."""
    zero = np.zeros(seconds)
    return Truth(np.arange(seconds) * 1.0, zero + 0.9, zero + 0.2, zero, np.zeros((seconds, 3)), np.zeros((seconds, 3)))


@pytest.fixture(scope="module")
def truth():
    return drive_vehicle(np.random.default_rng(21), VehicleConfig(), np.arange(200 * RATE + 1) / RATE)


def test_antenna_velocity_is_the_derivative_of_its_position(truth):
    """Central differences of the antenna's ECEF positions, which know nothing of the lever-arm formula."""
    rate = inverse_mechanisation(truth)[:, 3:]
    middle = 0.5 * (rate[1:] + rate[:-1])
    inner = Truth(*(getattr(truth, name)[1:-1] for name in Truth.__dataclass_fields__))
    arm = (0.7, -0.4, -1.3)
    fixes = observe(np.random.default_rng(0), inner, middle, GnssConfig(lever_arm_b=arm, **QUIET))
    where = fixes.lat_deg, fixes.lon_deg
    r_e = np.stack(pymap3d.geodetic2ecef(*where, fixes.height_m), -1)
    v_e = np.stack(pymap3d.enu2uvw(fixes.vel_e, fixes.vel_n, -fixes.vel_d, *where), -1)
    moved = (r_e[2:] - r_e[:-2]) * RATE / 2
    # the difference quotient itself is off by jerk dt²/6 < 1e-3 and by the rounding 1e-9 m · 100 Hz
    assert np.abs(moved - v_e[1:-1]).max() < 1e-3
    body = np.stack(pymap3d.geodetic2ecef(inner.lat, inner.lon, inner.height, deg=False), -1)
    assert np.abs(np.linalg.norm(r_e - body, axis=1) - math.hypot(*arm)).max() < 1e-5


def test_noise_and_stated_std(truth):
    """20000 fixes: relative std of a std 0.5 %; s_p and s_v add in square (paper eqs 12, 13)."""
    config = GnssConfig(std_horizontal=0.3, std_vertical=0.4, std_velocity=0.05, s_p=0.4, s_v=0.12, quality=5)
    fixes = observe(np.random.default_rng(1), truth, np.zeros((len(truth.t), 3)), config)
    east, north, up = pymap3d.geodetic2enu(
        fixes.lat_deg, fixes.lon_deg, fixes.height_m, np.degrees(truth.lat), np.degrees(truth.lon), truth.height
    )
    velocity = fixes[["vel_n", "vel_e", "vel_d"]].to_numpy() - truth.v_n
    spread = [x.std() for x in (north, east, up, *velocity.T)]
    stated = [math.hypot(0.3, 0.4), math.hypot(0.3, 0.4), math.hypot(0.4, 0.4), 0.13, 0.13, 0.13]
    assert spread == pytest.approx(stated, rel=0.025)
    columns = [f"std_{kind}_{axis}" for kind in ("pos", "vel") for axis in "ned"]
    assert fixes[columns].iloc[7].tolist() == pytest.approx(stated)
    assert (fixes.quality == 5).all()


@pytest.mark.parametrize(
    "change",
    [{"std_velocity": 0.0}, {"s_p": -1.0}, {"quality": 3}, {"lever_arm_b": (1.0, 2.0)}, {"std_vertical": math.nan}],
)
def test_bad_receivers_are_one_clear_line(change):
    with pytest.raises(InputError, match=next(iter(change))):
        GnssConfig(**change)


def test_open_ambiguities_and_multipath_last_and_are_claimed():
    """A Gauss-Markov error of the stated size, that lasts; quality 5 where ambiguities are open."""
    truth = still(40_000)
    config = GnssConfig(std_horizontal=0.01, wander=0.5, wander_s=30.0, float_share=0.3, float_s=20.0, float_std=0.8)
    fixes = observe(np.random.default_rng(3), truth, np.zeros((40_000, 3)), config)
    north = (np.radians(fixes.lat_deg.to_numpy()) - truth.lat) * 6.37e6
    is_float = (fixes.quality == 5).to_numpy()
    assert is_float.mean() == pytest.approx(0.3, abs=0.03)  # 600 episodes
    assert north[~is_float].std() == pytest.approx(0.5, rel=0.1)
    assert north[is_float].std() == pytest.approx(math.hypot(0.5, 0.8), rel=0.1)
    assert fixes.std_pos_n[is_float].to_numpy() == pytest.approx(math.hypot(0.5, 0.8), rel=0.01)
    up = fixes.height_m.to_numpy() - truth.height  # half as much again as level
    assert [up[open_].std() for open_ in (~is_float, is_float)] == pytest.approx(
        [0.75, 1.5 * math.hypot(0.5, 0.8)], rel=0.1
    )
    assert fixes.std_pos_d[is_float].to_numpy() == pytest.approx(1.5 * math.hypot(0.5, 0.8), rel=0.01)
    x = north[~is_float]
    assert np.corrcoef(x[1:], x[:-1])[0, 1] > 0.9
    assert set(np.round(fixes.std_vel_n, 9)) == {0.02}


def test_reports_are_biased_and_drop_out():
    fixes = observe(np.random.default_rng(3), still(20_000), np.zeros((20_000, 3)), GnssConfig())
    config = GnssConfig(std_factor=0.5, dropout_share=0.1, dropout_s=4.0)
    seen = report_fixes(np.random.default_rng(1), fixes, config)
    assert len(seen) / len(fixes) == pytest.approx(0.9, abs=0.015)  # 500 gaps
    gaps = np.diff(seen.t.to_numpy())
    assert gaps[gaps > 1.5].mean() - 1 == pytest.approx(4.5, abs=0.7)  # of those that hold a fix at all
    assert np.all(seen.std_pos_n == 0.01) and np.all(seen.lat_deg == fixes.lat_deg[fixes.t.isin(seen.t)].to_numpy())
    assert report_fixes(np.random.default_rng(1), fixes, GnssConfig()) is fixes


@pytest.mark.parametrize(("place", "moving"), [(0.2, 0.2), (0.1, 0.3), (0.0, 0.25)])
def test_late_fixes_are_those_of_their_lag_before(place, moving):
    """Position and velocity of the antenna, with its lever arm, of the moments that lie that far back."""
    rate, arm = 100, (1.5, -0.5, -2.0)
    truth = drive_vehicle(np.random.default_rng(4), VehicleConfig(), np.arange(60 * rate + 1) / rate)
    rate_b = np.random.default_rng(5).uniform(-0.3, 0.3, (len(truth.t), 3))
    rows = np.arange(0, len(truth.t), rate)
    config = GnssConfig(lever_arm_b=arm, position_lag_s=place, velocity_lag_s=moving, **QUIET)
    seen, swing = delay_fixes(truth, rate_b, rows, config, rate)
    fixes = observe(np.random.default_rng(0), seen, swing, config)
    on_time = observe(np.random.default_rng(0), truth, rate_b, GnssConfig(lever_arm_b=arm, **QUIET))
    assert np.array_equal(fixes.t, truth.t[rows])
    for lag, names in ((place, ("lat_deg", "lon_deg", "height_m")), (moving, ("vel_n", "vel_e", "vel_d"))):
        before = np.maximum(rows - round(lag * rate), 0)
        for name in names:
            scale = 1.1e5 if name.endswith("_deg") else 1.0
            apart = (fixes[name].to_numpy() - on_time[name].to_numpy()[before]) * scale
            assert np.abs(apart).max() < 1e-5  # metres or m/s: QUIET's noise, and the second order of a metre's shift


def test_episodes_know_no_beginning():
    """A share of the time, wherever the clock begins; of 200 seeds the first moment lies in one as often as any."""
    t = np.arange(2000.0)
    for begin in (0.0, 5e4):
        seeds = [episodes(np.random.default_rng(seed), begin + t, 0.3, 20.0) for seed in range(200)]
        assert np.mean(seeds) == pytest.approx(0.3, abs=0.02)
        assert np.mean([x[0] for x in seeds]) == pytest.approx(0.3, abs=0.1)
