"""GNSS fixes: where the antenna is and how it moves, noise of the stated size."""

import math

import numpy as np
import pymap3d
import pytest

from dlkf.errors import InputError
from dlkf.simulation.gnss.white import GnssConfig, observe
from dlkf.simulation.imu import inverse_mechanisation
from dlkf.simulation.motion.vehicle import Truth, VehicleConfig, drive_vehicle

RATE = 100
QUIET = dict.fromkeys(("std_horizontal", "std_vertical", "std_velocity"), 1e-12)


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
        fixes.lat_deg,
        fixes.lon_deg,
        fixes.height_m,
        np.degrees(truth.lat),
        np.degrees(truth.lon),
        truth.height,
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
    [
        {"std_velocity": 0.0},
        {"s_p": -1.0},
        {"quality": 3},
        {"lever_arm_b": (1.0, 2.0)},
        {"std_vertical": math.nan},
    ],
)
def test_bad_receivers_are_one_clear_line(change):
    with pytest.raises(InputError, match=next(iter(change))):
        GnssConfig(**change)
