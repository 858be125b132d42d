"""Starting from data alone: at rest, in motion, in reverse, with a bad course; the bank of headings behind it."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import pytest
import torch

from dlkf.base.errors import InputError
from dlkf.base.settings import settings_from
from dlkf.data.alignment import ALIGN, AlignConfig, level_attitude, mean_force
from dlkf.data.store import load_dataset
from dlkf.navigation.attitude import rotation_from_rpy, vector_from_rotation
from dlkf.navigation.earth import ned_axes
from dlkf.navigation.geodetic import geodetic_from_ecef
from dlkf.running.start import align, align_each
from dlkf.running.start.bank import COUNT, OVERBOUND, Case, EarthFix, advance_bank, begin_bank, judge_bank, yaw_std
from dlkf.running.start.entry import WORST_HEADING_STD
from dlkf.running.start.standstill import stationary_epochs
from tests.cars import REAL
from tests.drives import drives_in

SEARCH = AlignConfig(search_s=20.0)
AROUND = AlignConfig(search_s=20.0, from_rest=True)
# a consumer's MEMS: 0.3 °/s and 0.1 m/s² at turn-on
ACCEL = {"noise_density": 1e-3, "turn_on_bias": 0.1, "instability": 1e-3, "correlation_time": 3600.0}
GYRO = {"noise_density": 7e-5, "turn_on_bias": 5e-3, "instability": 1e-4, "correlation_time": 3600.0}
MATRIX = {"scale_factor": 5e-3, "misalignment": 5e-3}


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    """Eight cars of 90 s that stand for some seconds before they set off, each with an IMU of its own."""
    dataset = {"name": "toy", "hours": 0.2, "drive_minutes": 1.5, "imu_errors": "per_drive"}
    dataset["gnss"] = {"lever_arm_b": [1.0, -0.3, -1.2]}
    imu = {"name": "mems", "accel": ACCEL | MATRIX, "gyro": GYRO | MATRIX}
    config = {"dataset": dataset, "imu": imu, "seed": 4, "workers": 1}
    folder = drives_in(config, tmp_path_factory.mktemp("start") / "toy")
    return load_dataset(folder, dtype=torch.float64)


@pytest.fixture(scope="module")
def starts(drives):
    """Of the drives as they are, by a configuration."""
    return cache(lambda config=ALIGN: align_each(drives, config))


def _errors(drives, starts):
    """truth ⊖ start in n over the stated 1σ (n, 9), and the heading's error [°]."""
    rows, headings = [], []
    for d, s in zip(drives, starts):
        C_en = ned_axes(*torch.tensor([s.lat, s.lon], dtype=torch.float64))
        attitude = vector_from_rotation(C_en.mT @ d.ref_C_eb[s.first] @ s.state.C_nb.mT)
        velocity = C_en.mT @ d.ref_v_e[s.first] - s.state.v_n
        rows.append(torch.cat((velocity, attitude)) / s.std[3:])
        headings.append(math.degrees(attitude[2]))
    return torch.stack(rows), torch.tensor(headings)


def _in_reverse(drive):
    """The same drive by a car that faces the other way: IMU and lever arm turned about."""
    about = rotation_from_rpy(torch.tensor([0.0, 0.0, math.pi], dtype=torch.float64))
    imu = torch.cat((drive.imu[..., :3] @ about, drive.imu[..., 3:] @ about), -1)
    return replace(drive, imu=imu, ref_C_eb=drive.ref_C_eb @ about, lever_arm_b=about.mT @ drive.lever_arm_b)


def test_a_drive_that_begins_at_rest_starts_with_its_first_fix(drives, starts):
    causal, around = starts(), starts(AROUND)
    waited = sum(s.first for s in causal)
    assert all(s.first == 0 for s in around) and waited > 5 * len(drives)
    normalised, heading = _errors(drives, around)
    assert heading.abs().max() < 2.5 and heading.square().mean().sqrt() < 1.2
    assert normalised.abs().max() < 3.5 and normalised.square().mean(0).max() < 2  # 8 draws
    for d, s in zip(drives, around):
        assert stationary_epochs(d)[0] and s.state.v_n.abs().max() == 0
        assert 1e-3 < s.std[8] < math.radians(3)


def test_a_start_hands_on_what_fixes_scatter(drives):
    """Positions of a metre that claim 2 cm: at the start's position too; those of 1 cm say nothing."""
    g = torch.Generator().manual_seed(0)
    std = [torch.cat((torch.full_like(d.gnss_std[:, :3], 0.02), d.gnss_std[:, 3:]), -1) for d in drives]
    noise = [torch.randn(d.gnss_r_e.shape, generator=g, dtype=torch.float64) for d in drives]
    for size in (1.0, 0.01):
        wrong = [replace(d, gnss_std=s, gnss_r_e=d.ref_r_e + size * n) for d, s, n in zip(drives, std, noise)]
        wrong = [replace(w, gnss_r_e=w.gnss_r_e + (d.ref_C_eb @ d.lever_arm_b)) for w, d in zip(wrong, drives)]
        for config in (SEARCH, AROUND):
            found = align_each(wrong, config)
            scatter = torch.stack([s.noise for s in found])
            p_std = torch.stack([s.std[0] for s in found])
            if size == 1.0:
                assert 5 < scatter[:, 0].median() < 15 and p_std.median() > 0.3
            else:
                assert scatter[:, 0].max() < 1.5
            assert (scatter[:, 1] >= 1 - 1e-12).all()


def test_a_drive_that_begins_in_motion_starts_with_its_first_fix_too(drives):
    parts = [d.part(int(torch.nonzero(d.gnss_v_e.norm(dim=-1) > 5)[0]), d.epochs) for d in drives]
    around = align_each(parts, AROUND)
    assert [s.first for s in around] == [0] * len(parts) and [s.first for s in align_each(parts)] == [2] * len(parts)
    normalised, heading = _errors(parts, around)
    assert heading.square().mean().sqrt() < 2 and normalised.abs().max() < 3.5


@pytest.mark.parametrize("config", [SEARCH, AROUND])
def test_reverse_is_recognised_where_the_course_is_mistaken(drives, config):
    turned = [_in_reverse(d) for d in drives]
    mistaken = _errors(turned, align_each(turned))[1]
    assert (mistaken.abs() > 170).all()
    normalised, heading = _errors(turned, align_each(turned, config))
    assert heading.abs().max() < 3 and normalised[:, 5].abs().max() < 3.5


def test_the_search_leaves_a_good_course_alone(drives, starts):
    causal, searched = _errors(drives, starts())[1], _errors(drives, starts(SEARCH))[1]
    assert searched.square().mean().sqrt() < causal.square().mean().sqrt() + 0.2


@pytest.mark.parametrize("turn_deg", [-60, 90, -135, 180])
def test_a_heading_wrong_by_any_angle_is_corrected(drives, turn_deg):
    cases = []
    for d in drives:
        s = align(d)
        C, force_b = s.state.C_nb, mean_force(d, s.first)
        yaw = torch.tensor([0.0, 0.0, math.radians(turn_deg)], dtype=torch.float64)
        wrong = level_attitude(rotation_from_rpy(yaw) @ C, force_b, C @ force_b)
        std = torch.cat((s.std[:8], s.std.new_tensor([math.radians(15)])))  # coarse: the ring takes part
        start = replace(s, first=0, state=s.state._replace(C_nb=wrong), std=std)
        cases.append(Case(d.part(s.first, d.epochs), start, force_b))
    bank, first = begin_bank(cases), [align(d).first for d in drives]
    for t in range(20):
        imu = torch.stack([c.drive.imu[t] for c in cases]).double()
        bank = advance_bank(
            bank, imu, EarthFix.of([c.drive for c in cases], [t + 1] * len(cases)), 1 / cases[0].drive.rate_hz
        )
    for k, (d, verdict) in enumerate(zip(drives, judge_bank(bank))):
        C_en = bank.frame.C_en[k * COUNT]
        C = bank.state.C_nb[k * COUNT + verdict.best]
        off = float(vector_from_rotation(C_en.mT @ d.ref_C_eb[first[k] + 20] @ C.mT)[2])
        assert abs(off) < math.radians(5) and abs(off) < 3 * verdict.std and verdict.decided


def test_the_stated_spread_grows_by_the_gyroscope_s_error_on_the_way_back(drives):
    """With P diagonal, var = P_ψψ + (c t)² P_gyro + S t, in closed form, c of the down axis of a level car."""
    d = drives[0]
    s = align(d)
    bank = begin_bank([Case(d.part(s.first, d.epochs), replace(s, first=0), mean_force(d, s.first))])
    now, then = yaw_std(bank, 0.0)[0], yaw_std(bank, 10.0)[0]
    added = OVERBOUND**2 * ((10 * 3e-2) ** 2 + 10 * 5e-4**2)
    assert now < then and abs(float(then**2 - now**2) - added) < 1e-3 * added


def test_bad_velocities_give_a_heading_that_is_as_good_as_it_says(drives):
    """1 m/s of noise on a course at 2 to 4 m/s: tens of degrees, and the bank finds it from what comes after."""
    g = torch.Generator().manual_seed(0)
    bad = []
    for d in drives:
        noise = torch.randn(d.gnss_v_e.shape, generator=g, dtype=torch.float64)
        std = torch.cat((d.gnss_std[:, :3], d.gnss_std[:, 3:] + 1.0), -1)
        bad.append(replace(d, gnss_v_e=d.gnss_v_e + noise, gnss_std=std))
    course, searched = (_errors(bad, align_each(bad, c)) for c in (AlignConfig(), SEARCH))
    assert searched[1].square().mean() < 0.25 * course[1].square().mean()
    assert searched[0][:, 5].abs().max() < 3.5


def _straight(drive, epochs: int, speed: float):
    """Straight on at a constant speed, seen by positions of 0.3 m alone: nothing shows which way round the car is."""
    s = align(drive)
    C_en = ned_axes(*torch.tensor([s.lat, s.lon], dtype=torch.float64))
    v_e = C_en @ torch.tensor([speed, 0.0, 0.0], dtype=torch.float64)
    level = torch.tensor([0.0, 0.0, -9.81, 0.0, 0.0, 0.0], dtype=torch.float64)
    t = torch.arange(epochs + 1, dtype=torch.float64)[:, None]
    return replace(
        drive.part(0, epochs), imu=level.expand(epochs, 50, 6).clone(), gnss_r_e=drive.gnss_r_e[s.first] + t * v_e,
        gnss_valid=(torch.arange(6) < 3).expand(epochs + 1, 6).clone(), gnss_lag=torch.zeros(epochs + 1).double(),
        gnss_std=torch.full((epochs + 1, 6), 0.3).double(), lever_arm_b=torch.zeros(3, dtype=torch.float64),
    )  # fmt: skip


def test_doubt_is_carried_through_an_outage_and_said(drives):
    """Fixes for 4 s, none for 36 s, then fixes while the car accelerates: along its axis x, or against it."""
    for gear in (1.0, -1.0):
        d = _straight(drives[0], 60, 3.0)
        v = torch.full((61,), 3.0, dtype=torch.float64)
        v[41:51] = 3.0 + 0.8 * torch.arange(1, 11)
        v[51:] = 11.0
        C_en = ned_axes(*geodetic_from_ecef(d.gnss_r_e[0])[:2])
        way = torch.nn.functional.pad((0.5 * (v[1:] + v[:-1])).cumsum(0), (1, 0))
        r_e = d.gnss_r_e[0] + way[:, None] * C_en[:, 0]
        imu = d.imu.clone()
        imu[40:50, :, 0] += gear * 0.8
        valid = d.gnss_valid.clone()
        valid[6:42] = False
        doubtful = replace(d, gnss_r_e=r_e, gnss_valid=valid, imu=imu)
        with pytest.raises(InputError, match="heading is ambiguous"):
            align(doubtful.part(0, 30), SEARCH)
        assert align(doubtful.part(0, 30), AROUND).doubt > 0.01
        causal, around = align(doubtful, SEARCH), align(doubtful, AROUND)
        assert causal.first > 40 and around.first < 6
        for start in (causal, around):
            yaw = abs(float(vector_from_rotation(start.state.C_nb)[2]))
            assert abs(yaw - (0 if gear > 0 else math.pi)) < math.radians(10) and start.doubt < 0.01


def test_a_receiver_of_metres_without_velocities_gives_a_heading_that_is_honest(drives):
    """1 Hz, errors of 2 m correlated over a minute: a course of three fixes is tens of degrees off, and not sure."""
    coarse = [_puck(d, k) for k, d in enumerate(drives)]
    causal, around = align_each(coarse, SEARCH), align_each(coarse, AROUND)
    for starts in (causal, around):
        normalised, heading = _errors(coarse, starts)
        assert heading.abs().max() < 8 and heading.square().mean().sqrt() < 4
        assert normalised[:, 5].abs().max() < 3


def _puck(drive, seed: int):
    g = torch.Generator().manual_seed(seed)
    rows, keep = drive.epochs + 1, math.exp(-drive.epoch_s / 60)
    steps = 2.0 * torch.randn(rows, 3, generator=g, dtype=torch.float64)
    error = [steps[0]]
    for step in steps[1:]:
        error.append(keep * error[-1] + math.sqrt(1 - keep**2) * step)
    noise = torch.stack(error) + 0.2 * torch.randn(rows, 3, generator=g, dtype=torch.float64)
    std = torch.full_like(drive.gnss_std, 2.5)
    valid = drive.gnss_valid & (torch.arange(6) < 3)
    return replace(drive, gnss_r_e=drive.gnss_r_e + noise, gnss_std=std, gnss_valid=valid)


@pytest.mark.commands
def test_a_glimpse_between_two_outages_does_not_start_the_wrong_way_round():
    """15 s of 5 Hz positions at 3 m/s and more, on real roads with an IMU of 1 °/s: 174° off, and 55° RMS, before."""
    if not (REAL / "wid").is_dir():
        pytest.skip("real drives are not here")
    glimpses = []
    for d in load_dataset(REAL / "wid", dtype=torch.float64, epoch_s=0.2):
        speed = d.ref_v_e.norm(dim=-1)
        for row in range(0, d.epochs - 75, 200):
            if bool((speed[row : row + 76] > 3).all()) and bool(d.gnss_valid[row : row + 76, 0].all()):
                k = torch.arange(d.epochs + 1)
                seen = (k >= row) & (k <= row + 75)
                glimpses.append(replace(d, gnss_valid=d.gnss_valid & seen[:, None]))
    assert len(glimpses) > 3
    for config in (SEARCH, AROUND):
        for d, s in zip(glimpses, align_each(glimpses, config)):
            C_en = ned_axes(*torch.tensor([s.lat, s.lon], dtype=torch.float64))
            v_n = C_en.mT @ d.ref_v_e[s.first]
            yaw = math.atan2(s.state.C_nb[1, 0], s.state.C_nb[0, 0])
            off = math.remainder(yaw - math.atan2(v_n[1], v_n[0]), 2 * math.pi)
            assert abs(off) < math.radians(8), (d.name, s.first)


@pytest.mark.parametrize("config", [SEARCH, AROUND])
def test_gyroscopes_that_are_degrees_a_second_off_are_found(drives, starts, config):
    """3 °/s on each axis: the start shows them with its 1σ, from rest and from motion alone, and the heading holds."""
    error = torch.deg2rad(torch.tensor([3.0, -3.0, 3.0], dtype=torch.float64))
    wrong = [replace(d, imu=d.imu + torch.cat((0 * error, error))) for d in drives]
    moving = [d.part(s.first, d.epochs) for d, s in zip(wrong, starts())]
    for some in (wrong, moving):
        found = align_each(some, config)
        _, heading = _errors(some, found)
        assert heading.abs().max() < 4
        for d, s in zip(some, found):
            bias, std = s.gyro.split(3)
            off = bias - d.ref_imu_error[s.first, 3:] - error
            assert (off.abs() < 4 * std).all()
            assert (some is moving and not config.from_rest) or std[2] < math.radians(0.3)


def test_what_keeps_a_drive_from_starting_is_told_in_place(drives):
    good, blind = drives[0], replace(drives[1], gnss_valid=torch.zeros_like(drives[1].gnss_valid))
    parked = replace(drives[2], gnss_v_e=0 * drives[2].gnss_v_e)
    starts = align_each([good, blind, parked], AROUND)
    assert starts[0].first == 0 and all(isinstance(s, InputError) for s in starts[1:])
    assert "no GNSS fix" in str(starts[1]) and "never moves faster than 2 m/s" in str(starts[2])
    alone = align(good, AROUND)
    assert (alone.state.C_nb - starts[0].state.C_nb).abs().max() < 1e-9
    later = align(good, AROUND, earliest=30)
    assert later.first == 30


def test_heading_is_not_carried_further_than_it_is_worth(drives):
    """A course that comes late to a car in motion, and no standstill to tell the gyroscopes' error."""
    d = next(d for d in drives if (d.gnss_v_e[20:81].norm(dim=-1) > 1.5).all()).part(20, 90)
    slow = replace(d, gnss_v_e=torch.where(torch.arange(71)[:, None] > 55, 1.0, 0.15) * d.gnss_v_e)
    config = AlignConfig(from_rest=True, min_speed=4.0)
    moving, start = align(slow, replace(config, from_rest=False)), align(slow, config)
    assert 0 < start.first < moving.first
    assert moving.std[8] < start.std[8] <= WORST_HEADING_STD
    assert align(slow, config, earliest=start.first + 3).first == start.first + 3


@pytest.mark.parametrize("fault, said", [
    ({"serch_s": 3}, "align: unknown key serch_s"),
    ({"min_speed": 0}, "align.min_speed is 0"),
    ({"search_s": -1}, "align.search_s is -1"),
    ({"search_s": math.nan}, "align.search_s is nan"),
    ({"from_rest": 1}, "align.from_rest is 1"),
])  # fmt: skip
def test_settings_are_checked(fault, said):
    with pytest.raises(InputError, match=said):
        settings_from(AlignConfig, fault, "align")
    assert settings_from(AlignConfig, {"search_s": 0}, "align").search_s == 0


def test_real_drives():
    """kitti against its reference: every drive from its first fix, forwards and backwards; rtkx 37 s earlier."""
    if not (REAL / "kitti").is_dir():
        pytest.skip("real drives are not here")
    kitti = load_dataset(REAL / "kitti", dtype=torch.float64)
    # one that creeps decides (8°)
    for real, limit in ((kitti, 2.0), ([_in_reverse(d) for d in kitti[::3]], 2.8)):
        starts = align_each(real, AROUND)
        known = [bool(d.ref_C_eb[s.first].isfinite().all()) for d, s in zip(real, starts)]
        assert sum(s.first for s in starts) <= 1  # one has no fix at its first boundary
        normalised, heading = (x[known] for x in _errors(real, starts))
        assert len(heading) >= 14 and heading.abs().max() < 9 and heading.square().mean().sqrt() < limit
        assert (normalised.square().mean(0).sqrt() < 1.5).all()
    rtkx = load_dataset(REAL / "rtkx", dtype=torch.float64)[0]
    assert align(rtkx).first == 37 and align(rtkx, AROUND).first == 0
