"""Fixes from satellites: errors against their covariance and dilution, obstruction, raw observations, settings."""

import math

import numpy as np
import pymap3d
import pytest
import yaml
from scipy.optimize import least_squares
from scipy.stats import chi2

from dlkf.base.config import config_dir
from dlkf.base.errors import InputError
from dlkf.simulation.dataset import DatasetConfig
from dlkf.simulation.gnss.almanac import read_almanac
from dlkf.simulation.gnss.least_squares import Observations, solve
from dlkf.simulation.gnss.receiver import (
    Receiver,
    clock,
    iono_mapping,
    multipath_growth,
    receiver_spec,
    tropo_mapping,
)
from dlkf.simulation.gnss.satellite_fixes import observe_satellites
from dlkf.simulation.gnss.satellites import LIGHT, signals
from dlkf.simulation.gnss.surroundings import Sky, hold_visibility, in_view
from dlkf.simulation.gnss.white import GnssConfig
from dlkf.simulation.motion.vehicle import Truth

PURE = Receiver("pure", quality=4, mask_deg=5.0, std_range=0.01, std_range_rate=0.01)
ALL = Receiver("all", multipath=0.5, orbit=0.6, iono=1.5, tropo=0.12)
RTK = Receiver("rtk", quality=4, std_range=0.003, ambiguity=0.3, refix_s=10.0, reacquire_s=1.0)
STD = ["std_pos_n", "std_pos_e", "std_pos_d", "std_vel_n", "std_vel_e", "std_vel_d"]


def straight(rows, speed=10.0, lat=0.9, dt=1.0):
    """Eastwards along a parallel at constant speed."""
    t = np.arange(rows) * dt
    radius = 6378137 / math.sqrt(1 - 0.00669437999014 * math.sin(lat) ** 2) * math.cos(lat)
    lon = 0.17 + speed * t / radius
    v_n = np.tile((0.0, speed, 0.0), (rows, 1))
    return Truth(t, np.full(rows, lat), lon, np.zeros(rows), v_n, np.tile((0.0, 0.0, math.pi / 2), (rows, 1)))


def received(receiver, truth, seed=0, sky=None, **gnss):
    rng = np.random.default_rng(seed)
    return observe_satellites(rng, truth, np.zeros((len(truth.t), 3)), GnssConfig(**gnss), receiver, sky)


def errors(fixes, truth):
    """Position and velocity error (N, 6) in NED."""
    where = np.degrees(truth.lat), np.degrees(truth.lon), truth.height
    east, north, up = pymap3d.geodetic2enu(fixes.lat_deg, fixes.lon_deg, fixes.height_m, *where)
    return np.column_stack((north, east, -up, fixes[["vel_n", "vel_e", "vel_d"]].to_numpy() - truth.v_n))


def street(rows, left=0.0, right=0.0, blocked=()):
    hidden = np.zeros(rows, bool)
    hidden[list(blocked)] = True
    return Sky(np.full(rows, left), np.full(rows, right), hidden)


def test_errors_have_the_stated_std_and_no_bias():
    """4000 epochs of white errors: relative std of a std 1.1 %, of a mean 1.6 % of a sigma; five of each."""
    truth = straight(4000)
    fixes = received(PURE, truth).fixes
    scaled = errors(fixes, truth) / fixes[STD].to_numpy()
    assert (fixes.quality == 4).all()
    assert scaled.std(0) == pytest.approx(np.ones(6), abs=0.055)
    assert np.abs(scaled.mean(0)).max() < 0.08
    assert fixes[STD[:3]].to_numpy().max() < 0.1  # centimetres, as in the paper


@pytest.mark.parametrize("receiver", [ALL, RTK], ids=["standalone", "rtk"])
def test_errors_shared_by_satellites_are_in_the_stated_std(receiver):
    """1000 epochs so far apart that no error lasts: mean square of a scaled error 1 ± 5 · √(2/1000)."""
    truth = straight(1000, speed=0.0, dt=20000.0)
    fixes = received(receiver, truth).fixes
    scaled = errors(fixes, truth) / fixes[STD].to_numpy()
    assert (fixes.quality > 0).mean() > 0.98
    assert np.nanmean(np.square(scaled), 0) == pytest.approx(np.ones(6), abs=0.22)


def observations(sigma, rows=3000):
    """Equal white noise on all satellites seen from one place, and the place."""
    place = np.array(pymap3d.geodetic2ecef(35.0, -110.0, 1200.0))
    r_e = np.tile(place, (rows, 1))
    seen = signals(read_almanac(), np.arange(rows) * 29.0, r_e, np.zeros_like(r_e))
    used = seen.elevation > math.radians(10)
    noise = sigma * np.random.default_rng(5).standard_normal((2, *used.shape))
    variance = np.full(used.shape, sigma**2)
    return r_e, Observations(
        seen.satellite, seen.distance + noise[0], seen.distance_rate + noise[1], used, variance, variance,
        np.zeros((0, *used.shape)),
    )  # fmt: skip


def test_chi_square_of_position_and_velocity():
    """eᵀP⁻¹e of 3000 epochs against χ² of 3 degrees: mean ± 5 √(6/3000), 95 % and 99.9 % limits kept."""
    r_e, observed = observations(2.0)
    solution = solve(observed)
    for error, covariance in ((solution.r_e - r_e, solution.covariance), (solution.v_e, solution.rate_covariance)):
        squared = np.einsum("ti,tij,tj->t", error, np.linalg.inv(covariance[:, :3, :3]), error)
        assert squared.mean() == pytest.approx(3, abs=5 * math.sqrt(6 / 3000))
        for level in (0.95, 0.999):
            outside = (squared > chi2.ppf(level, 3)).mean()
            assert outside == pytest.approx(1 - level, abs=5 * math.sqrt(level * (1 - level) / 3000))


def test_dilution_times_noise_is_the_error():
    """Equal noise: RMS of the error over σ · DOP is one for space and time, horizontal and vertical."""
    r_e, observed = observations(2.0)
    solution = solve(observed)
    lat, lon = 35.0, -110.0
    east, north, up = pymap3d.uvw2enu(*(solution.r_e - r_e).T, lat, lon)
    dop = solution.dop
    for dilution, parts in (
        (dop.gdop, (east, north, up, solution.clock)),
        (dop.pdop, (east, north, up)),
        (dop.hdop, (east, north)),
        (dop.vdop, (up,)),
    ):
        ratio = np.mean(sum(x * x for x in parts) / (2.0 * dilution) ** 2)
        assert ratio == pytest.approx(1, abs=5 * math.sqrt(2 / 3000))


def test_an_epoch_of_raw_observations_gives_the_fix():
    """Another solver on nothing but the raw table: same position, clock and covariance."""
    truth = straight(3)
    fixes, raw = received(Receiver("white", std_range=1.0, mask_deg=5.0), truth)
    epoch = raw[raw.t == 1.0]
    satellite, std = epoch[["sat_x_m", "sat_y_m", "sat_z_m"]].to_numpy(), epoch.std_pseudorange_m.to_numpy()
    measured = epoch.pseudorange_m.to_numpy() + LIGHT * epoch.sat_clock_s.to_numpy()
    start = np.array((*pymap3d.geodetic2ecef(51.0, 9.0, 0.0), 0.0)) / 1e6

    def residual(x):
        return (np.linalg.norm(satellite - x[:3] * 1e6, axis=1) + x[3] * 1e6 - measured) / std

    found = least_squares(residual, start, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    row = fixes.iloc[1]
    r_e = np.array(pymap3d.geodetic2ecef(row.lat_deg, row.lon_deg, row.height_m))
    assert np.abs(found.x[:3] * 1e6 - r_e).max() < 1e-3
    covariance = np.linalg.inv(found.jac.T @ found.jac)[:3, :3] * 1e12
    east, north, up = np.stack(pymap3d.uvw2enu(*np.eye(3), row.lat_deg, row.lon_deg))
    for axis, name in ((north, "std_pos_n"), (east, "std_pos_e"), (up, "std_pos_d")):
        assert row[name] == pytest.approx(math.sqrt(axis @ covariance @ axis), rel=1e-4)
    unit = satellite - r_e
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    v_e = np.array(pymap3d.enu2uvw(row.vel_e, row.vel_n, -row.vel_d, row.lat_deg, row.lon_deg))
    rate = (unit * (epoch[["sat_vx", "sat_vy", "sat_vz"]].to_numpy() - v_e)).sum(1)
    left = epoch.pseudorange_rate + LIGHT * epoch.sat_clock_rate - rate
    assert left.std() < 0.5  # the receiver clock's drift, and noise of 0.05 m/s towards the zenith
    assert epoch.doppler_hz.to_numpy() == pytest.approx(-epoch.pseudorange_rate.to_numpy() / 0.190293673, rel=1e-6)


def test_added_noise_lies_on_top():
    """Paper eqs 12, 13: 3000 epochs, relative std of a std 1.3 %."""
    truth = straight(3000)
    fixes = received(PURE, truth, s_p=3.0, s_v=0.4).fixes
    spread = errors(fixes, truth).std(0)
    assert spread == pytest.approx((3, 3, 3, 0.4, 0.4, 0.4), rel=0.065)
    assert fixes[STD].mean().to_numpy() == pytest.approx(spread, rel=0.065)


def test_a_wall_hides_what_is_below_its_edge():
    elevation, azimuth = (np.radians(x)[None] for x in ([44.0, 46, 46, 20, 10, 5], [90.0, 90, 270, 270, 0, 180]))
    sky = Sky(np.radians([15.0]), np.radians([45.0]), np.array([False]))
    assert in_view(sky, np.zeros(1), elevation, azimuth).tolist() == [[False, True, True, True, True, True]]
    turned = in_view(sky, np.full(1, math.pi), elevation, azimuth)  # the high wall is in the west now
    assert turned.tolist() == [[True, True, True, False, True, True]]
    oblique = np.degrees(np.arctan(np.sin(np.radians(30))))  # 26.6°: the 45° wall 30° off the road
    for above in (-0.1, 0.1):
        seen = in_view(sky, np.zeros(1), np.radians([[oblique + above]]), np.radians([[30.0]]))
        assert seen.item() == (above > 0)


def test_held_waits_after_every_break():
    condition = np.array([1, 1, 1, 0, 1, 1, 1, 0, 0, 1, 1], bool)
    assert hold_visibility(condition, 0).tolist() == condition.tolist()
    assert hold_visibility(condition, 2).tolist() == [
        True,
        True,
        True,
        False,
        False,
        False,
        True,
        False,
        False,
        False,
        False,
    ]
    assert np.array_equal(
        hold_visibility(np.stack((condition, ~condition), -1), 1)[:, 1], hold_visibility(~condition, 1)
    )


def test_tunnels_are_outages_and_a_street_costs_geometry():
    truth = straight(300)
    free = received(RTK, truth).fixes
    narrow = received(RTK, truth, sky=street(300, 0.9, 0.9)).fixes
    assert narrow.satellites.mean() < free.satellites.mean() - 2
    assert narrow.pdop.median() > 1.3 * free.pdop.median()
    tunnel = received(RTK, truth, sky=street(300, blocked=range(100, 140))).fixes
    inside = tunnel.iloc[100:141]  # a second to reacquire
    assert (inside.quality == 0).all() and inside.lat_deg.isna().all() and (inside.satellites == 0).all()
    assert (tunnel.quality.iloc[141:151] == 5).all() and (tunnel.quality.iloc[152:] == 4).all()
    assert tunnel.std_pos_n.iloc[145] > 20 * tunnel.std_pos_n.iloc[160]
    assert tunnel.iloc[:100].equals(free.iloc[:100])


def test_fewer_than_four_satellites_are_no_fix():
    """Walls so high that but the satellites along the road are left: wherever there is a fix there are four."""
    fixes = received(PURE, straight(1500), sky=street(1500, 1.3, 1.3)).fixes
    assert ((fixes.quality > 0) == (fixes.satellites >= 4) & (fixes.pdop <= PURE.max_pdop)).all()
    assert (fixes.satellites < 4).any() and fixes.lat_deg[fixes.quality == 0].isna().all()
    known = fixes[fixes.quality > 0]
    assert not known.isna().any().any() or known.empty


def test_a_seed_gives_the_same_bits():
    truth = straight(50)
    one, two, other = (received(ALL, truth, seed) for seed in (7, 7, 8))
    assert one.fixes.equals(two.fixes) and one.raw.equals(two.raw)
    assert not one.fixes.equals(other.fixes)


def test_clock_walks_as_its_spectra_say():
    """Variance of the second difference of the offset: 2 S_φ dt + 2/3 S_f dt³ (two-state clock)."""
    offset, drift = clock(np.random.default_rng(4), ALL, 20000, 0.5)
    expected = 2 * ALL.clock_phase * 0.5 + 2 / 3 * ALL.clock_frequency * 0.5**3
    assert np.diff(offset, 2).var() == pytest.approx(expected, rel=0.06)
    assert np.diff(drift).var() == pytest.approx(ALL.clock_frequency * 0.5, rel=0.06)


def test_white_is_no_receiver():
    assert receiver_spec({"name": "white"}) is None and receiver_spec(None) is None


@pytest.mark.parametrize(
    ("name", "limits"), [("undisturbed", (0.005, 0.05)), ("rtk", (0.004, 0.05)), ("standalone", (0.5, 6.0))]
)
def test_presets_are_as_good_as_they_say(name, limits):
    """Under an open sky: centimetres for the paper's undisturbed satellites and for RTK, metres for a lone receiver."""
    preset = receiver_spec(yaml.safe_load((config_dir() / "receiver" / f"{name}.yaml").read_text()))
    fixes = received(preset, straight(200)).fixes
    assert fixes[STD[:3]].min().min() > limits[0] and fixes[STD[:3]].max().max() < limits[1]
    assert (fixes.quality == preset.quality).all()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"quality": 3}, "quality"),
        ({"mask_deg": 70.0}, "mask_deg"),
        ({"std_range": 0.0}, "std_range"),
        ({"orbit": -1.0}, "orbit"),
        ({"iono": float("nan")}, "iono"),
        ({"tropo": "dry"}, "tropo"),
        ({"masc_deg": 5.0}, "masc_deg"),
        ({"name": "white"}, "white"),
        ({"almanac": 3}, "almanac"),
    ],
)
def test_bad_receivers_are_one_clear_line(change, said):
    with pytest.raises(InputError) as caught:
        receiver_spec({"name": "mine", "std_range": 1.0, **change})
    assert said in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"raw": True}, "receiver=<preset>"),
        ({"raw": 1, "receiver": ALL}, "raw=1"),
        ({"receiver": ALL, "gnss": GnssConfig(rate_hz=20.0), "drive_minutes": 120.0}, "144000 epochs"),
    ],
)
def test_datasets_that_cannot_be_are_one_clear_line(change, said):
    with pytest.raises(InputError) as caught:
        DatasetConfig("toy", **change)
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_errors_grow_towards_the_horizon_as_the_geometry_says():
    """One at the zenith; 1/sin E of a flat layer at 45°, less of a shell 350 km up; noise by its own law."""
    zenith, half = np.array([math.pi / 2]), np.array([math.pi / 4])
    assert [float(f(zenith)[0]) for f in (multipath_growth, tropo_mapping, iono_mapping)] == pytest.approx(
        [1, 1, 1], abs=1e-3
    )
    assert float(tropo_mapping(half)[0]) == pytest.approx(math.sqrt(2), rel=2e-3)
    shell = 1 / math.cos(math.asin(6378.1363 / 6728.1363 * math.cos(math.pi / 4)))
    assert float(iono_mapping(half)[0]) == pytest.approx(shell)
    assert float(multipath_growth(half)[0]) == pytest.approx(math.sqrt(1.5))
