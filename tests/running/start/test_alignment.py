"""The attitude that IMU and GNSS alone give, against truth."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from dlkf.base.errors import InputError
from dlkf.data.alignment import ALIGN, SEARCH, AlignConfig, align_boundaries
from dlkf.data.store import load_dataset
from dlkf.navigation.attitude import rotation_from_rpy, vector_from_rotation
from dlkf.navigation.earth import ned_axes
from dlkf.navigation.geodetic import geodetic_from_ecef
from dlkf.running.start import align, align_drives, entry
from tests.cars import REAL


@pytest.fixture(scope="module")
def drive(town):
    return load_dataset(town, dtype=torch.float64)[0]


def _errors(drive, aligned):
    """truth ⊖ aligned in local NED: attitude [deg], position [m], velocity [m/s] where both are known."""
    lat, lon, _ = geodetic_from_ecef(drive.ref_r_e)
    C = ned_axes(lat, lon)
    ok = aligned.ok & drive.ref_valid
    attitude = torch.rad2deg(vector_from_rotation(C.mT @ drive.ref_C_eb @ aligned.C_eb.mT @ C))[ok]
    turn = [
        (C.mT @ x.unsqueeze(-1)).squeeze(-1)[ok] for x in (drive.ref_r_e - aligned.r_e, drive.ref_v_e - aligned.v_e)
    ]
    return attitude, *turn, aligned.std[ok]


def _with_arm(drive, arm: torch.Tensor):
    """The fixes of an antenna on a lever arm: r + C l, v + C (ω × l), ω relative to the Earth."""
    rate = torch.cat((drive.imu[:1, 0, 3:], drive.imu[:, -1, 3:]))
    earth = torch.tensor([0.0, 0.0, 7.292115e-5], dtype=torch.float64).expand(len(rate), 3)
    rate = rate - (drive.ref_C_eb.mT @ earth.unsqueeze(-1)).squeeze(-1)
    swing = torch.linalg.cross(rate, arm.expand_as(rate))
    return replace(
        drive,
        gnss_r_e=drive.gnss_r_e + drive.ref_C_eb @ arm,
        gnss_v_e=drive.gnss_v_e + (drive.ref_C_eb @ swing.unsqueeze(-1)).squeeze(-1),
        lever_arm_b=arm,
    )


@pytest.mark.parametrize("arm", [(0.0, 0.0, 0.0), (2.0, -0.5, -1.5)])
def test_perfect_data_give_the_attitude(drive, arm):
    """Left are the rate's change over the last 0.2 s and a lever arm's pull over 2 s."""
    moved = _with_arm(drive, torch.tensor(arm, dtype=torch.float64))
    attitude, r, v, _ = _errors(moved, align_boundaries(moved))
    assert len(attitude) == 59  # all but the first two
    assert attitude.abs().max() < (0.01 if arm[0] == 0 else 0.25)
    assert r.norm(dim=-1).max() < 0.01 and v.norm(dim=-1).max() < 0.05


def test_any_mounting_is_levelled(drive):
    """Body axes turned against the car's: roll and pitch come out, yaw is the car's course by definition."""
    tilt = rotation_from_rpy(torch.tensor([0.3, -0.2, 0.0], dtype=torch.float64))
    imu = torch.cat((drive.imu[..., :3] @ tilt, drive.imu[..., 3:] @ tilt), -1)
    mounted = replace(drive, imu=imu, ref_C_eb=drive.ref_C_eb @ tilt)
    attitude = _errors(mounted, align_boundaries(mounted))[0]
    assert attitude.abs().max() < 0.02


def test_late_fixes_are_carried_to_the_boundary(drive):
    """Each fix is 0.3 s old: 3 m and up to 0.2 m/s and 5° that its age explains."""
    lag = 0.3
    r = drive.gnss_r_e.clone()
    v = drive.gnss_v_e.clone()
    then = [drive.gnss_v_e.roll(1, 0), drive.gnss_r_e.roll(1, 0)]
    v[1:] = (drive.gnss_v_e + lag * (then[0] - drive.gnss_v_e))[1:]
    r[1:] = (drive.gnss_r_e - lag * (drive.gnss_v_e + v) / 2)[1:]
    late = replace(drive, gnss_r_e=r, gnss_v_e=v, gnss_lag=torch.full_like(drive.gnss_lag, lag))
    attitude, dr, dv, std = _errors(late, align_boundaries(late))
    # the velocities' window lies 0.3 s before the IMU's: a jerk of 0.8 m/s³ tilts by 0.24/9.8 rad, as stated
    assert attitude[:, :2].abs().max() < 2.0 and attitude[:, 2].abs().max() < 2.0
    assert (torch.deg2rad(attitude).abs() < 3 * std[:, 6:]).all()
    assert dr.norm(dim=-1).max() < 0.3 and dv.norm(dim=-1).max() < 0.5


def test_without_velocities_positions_do(drive):
    blind = replace(drive, gnss_valid=drive.gnss_valid & (torch.arange(6) < 3))
    attitude, _, v, std = _errors(blind, align_boundaries(blind))
    assert len(attitude) == 56  # three fixes, confirmed a second later, and two seconds to level over
    assert attitude.abs().max() < 2.0 and v.norm(dim=-1).max() < 0.5
    assert (v.abs() < 3 * std[:, 3:6]).all()


@pytest.mark.parametrize(
    "said",
    ["one fix in three has a velocity", "every other fix has one", "unknown ones are 99 m/s 1σ", "a stop has them"],
)
def test_few_velocities_are_as_none(drive, said):
    """No two in a row have one, or none while the car moves: without the positions there was no start at all."""
    rows, known, std = torch.arange(drive.epochs + 1), torch.arange(6) < 3, drive.gnss_std
    if said == "unknown ones are 99 m/s 1σ":
        known, std = known | True, torch.where(known, std, 99.0)
    else:
        given = {"one": rows % 3 == 1, "every": rows % 2 == 1, "a": rows < 1}[said.split()[0]]
        known = known | given[:, None]
    few = replace(drive, gnss_valid=drive.gnss_valid & known, gnss_std=std)
    attitude, _, v, std = _errors(few, align_boundaries(few))
    assert len(attitude) >= 55  # 56 without any
    assert attitude.abs().max() < 2.0 and v.norm(dim=-1).max() < 0.5
    assert (v.abs() < 3 * std[:, 3:6]).all()


def test_velocities_that_are_lost_for_a_while_are_those_of_the_receiver_before_and_after(drive):
    """Ten seconds of positions alone: there they count, elsewhere nothing changes to the bit."""
    rows = torch.arange(drive.epochs + 1)
    lost = (rows >= 25) & (rows < 35)
    some = replace(drive, gnss_valid=drive.gnss_valid & ~(lost[:, None] & (torch.arange(6) > 2)))
    whole, found = align_boundaries(drive), align_boundaries(some)
    assert found.ok[30:35].all()
    away = (rows < 25) | (rows > 44)
    assert torch.equal(found.ok[away], whole.ok[away])
    assert torch.equal(found.C_eb[away & whole.ok], whole.C_eb[away & whole.ok])


def test_positions_alone_that_wait_for_their_boundary_do_too(drive):
    """Stamps of a host, a receiver on another clock: no fix is on a boundary, each up to 0.9 s before."""
    lag = 0.1 + 0.8 * torch.rand(len(drive.gnss_lag), generator=torch.Generator().manual_seed(8), dtype=torch.float64)
    r, v, s = drive.ref_r_e, drive.epoch_s * drive.ref_v_e, (1 - lag / drive.epoch_s)[1:, None]
    late = r[:-1] + (r[1:] - r[:-1]) * (s * s * (3 - 2 * s)) + s * (1 - s) * ((1 - s) * v[:-1] - s * v[1:])
    late = torch.cat((r[:1] - lag[0] * v[:1], late))
    blind = replace(drive, gnss_valid=drive.gnss_valid & (torch.arange(6) < 3), gnss_r_e=late, gnss_lag=lag)
    attitude, dr, dv, std = _errors(blind, align_boundaries(blind))
    assert len(attitude) >= 55
    # the position is carried on with the velocity of the boundary: ½ · 2.7 m/s² · (0.9 s)² in a turn
    assert attitude.abs().max() < 2.5 and dv.norm(dim=-1).max() < 0.6 and dr.norm(dim=-1).max() < 1.1
    assert (dv.abs() < 3 * std[:, 3:6]).all()


def test_coarse_positions_give_a_course_as_good_as_it_says(drive):
    """Half a metre of white noise at 10 m/s: three successive positions gave 7° (0.5 m · √26 / 2 s / 10 m/s)."""
    g = torch.Generator().manual_seed(0)
    headings, ratios = [], []
    for _ in range(10):
        noise = 0.5 * torch.randn(drive.gnss_r_e.shape, generator=g, dtype=torch.float64)
        std = torch.full_like(drive.gnss_std, 0.5)
        position = drive.gnss_valid & (torch.arange(6) < 3)
        coarse = replace(drive, gnss_valid=position, gnss_std=std, gnss_r_e=drive.gnss_r_e + noise)
        attitude, _, _, std = _errors(coarse, align_boundaries(coarse))
        headings.append(attitude[3:, 2])  # of five fixes
        ratios.append(torch.deg2rad(attitude[3:, 2]) / std[3:, 8])
    assert torch.cat(headings).square().mean().sqrt() < 4
    assert 0.5 < torch.cat(ratios).square().mean().sqrt() < 1.2


def test_positions_that_scatter_more_than_they_claim_give_a_course_that_knows_it(drive):
    """The same half metre, claimed to be 5 cm: the residuals of the fit show it."""
    g = torch.Generator().manual_seed(1)
    ratios = []
    for _ in range(10):
        noise = 0.5 * torch.randn(drive.gnss_r_e.shape, generator=g, dtype=torch.float64)
        position = drive.gnss_valid & (torch.arange(6) < 3)
        std = torch.full_like(drive.gnss_std, 0.05)
        wrong = replace(drive, gnss_valid=position, gnss_std=std, gnss_r_e=drive.gnss_r_e + noise)
        attitude, _, _, std = _errors(wrong, align_boundaries(wrong))
        ratios.append(torch.deg2rad(attitude[3:, 2]) / std[3:, 8])
    assert 0.5 < torch.cat(ratios).square().mean().sqrt() < 1.0


def test_a_position_that_jumps_is_no_motion(drive):
    """A car at rest whose positions of 5 cm are off by 20 m once: no velocity that a second confirms."""
    position = drive.gnss_valid & (torch.arange(6) < 3)
    r_e = drive.gnss_r_e[:1].repeat(len(drive.gnss_r_e), 1)
    r_e[30] += 20.0
    imu = torch.zeros_like(drive.imu)
    imu[..., 2] = -9.8
    std = torch.full_like(drive.gnss_std, 0.05)
    still = replace(drive, imu=imu, gnss_valid=position, gnss_r_e=r_e, gnss_std=std)
    assert not align_boundaries(still).ok.any()


@pytest.mark.parametrize("size", [3.0, 30.0])
def test_positions_that_jump_again_and_again_are_no_motion(drive, size):
    """A car at rest whose positions of 5 cm are off once in ten: no velocity lasts a second."""
    g, moves = torch.Generator().manual_seed(4), 0
    imu = torch.zeros_like(drive.imu)
    imu[..., 2] = -9.8
    position, std = drive.gnss_valid & (torch.arange(6) < 3), torch.full_like(drive.gnss_std, 0.05)
    for _ in range(40):
        hit = torch.rand(len(drive.gnss_r_e), 1, generator=g) < 0.1
        noise = torch.randn(drive.gnss_r_e.shape, generator=g, dtype=torch.float64) * torch.where(hit, size, 0.01)
        r_e = drive.gnss_r_e[:1] + noise
        still = replace(drive, imu=imu, gnss_valid=position, gnss_r_e=r_e, gnss_std=std)
        moves += int(align_boundaries(still).ok.sum())
    assert moves <= 4  # of 2280


def test_velocities_that_jump_are_no_motion_and_no_course(drive):
    """One in ten of 5 cm/s off by 5 m/s (1σ per axis): none at rest is a motion, and in motion their course is none."""
    g, moves, headings = torch.Generator().manual_seed(5), 0, []
    imu = torch.zeros_like(drive.imu)
    imu[..., 2] = -9.8
    std = torch.full_like(drive.gnss_std, 0.05)
    for _ in range(20):
        hit = torch.rand(len(drive.gnss_v_e), 1, generator=g) < 0.1
        wrong = hit * 5.0 * torch.randn(drive.gnss_v_e.shape, generator=g, dtype=torch.float64)
        still = replace(drive, imu=imu, gnss_v_e=wrong, gnss_r_e=drive.gnss_r_e[:1].expand_as(wrong), gnss_std=std)
        moves += int(align_boundaries(still).ok.sum())
        jumpy = replace(drive, gnss_v_e=drive.gnss_v_e + wrong, gnss_std=std)
        headings.append(_errors(jumpy, align_boundaries(jumpy))[0][:, 2])
    heading = torch.cat(headings)
    assert moves <= 1  # of 1180
    assert len(heading) > 600 and heading.abs().max() < 30 and (heading.abs() > 5).double().mean() < 0.03


def test_velocities_that_scatter_more_than_they_claim_give_a_course_that_knows_it(drive):
    """Half a metre a second, claimed to be 5 cm/s: second differences show it; one outlier in ten does not look so."""
    g, ratios, jumps = torch.Generator().manual_seed(6), [], []
    std = torch.full_like(drive.gnss_std, 0.05)
    for _ in range(10):
        noise = 0.5 * torch.randn(drive.gnss_v_e.shape, generator=g, dtype=torch.float64)
        wrong = replace(drive, gnss_std=std, gnss_v_e=drive.gnss_v_e + noise)
        aligned = align_boundaries(wrong)
        attitude, _, _, sigma = _errors(wrong, aligned)
        ratios.append(torch.deg2rad(attitude[8:, 2]) / sigma[8:, 8])
        hit = torch.rand(len(noise), 1, generator=g) < 0.1
        jumps.append(align_boundaries(replace(drive, gnss_std=std, gnss_v_e=drive.gnss_v_e + 10 * hit * noise)))
    assert 0.5 < torch.cat(ratios).square().mean().sqrt() < 1.3
    clean = align_boundaries(replace(drive, gnss_std=std))
    assert clean.scatter.median() == 1 and torch.cat([a.scatter[a.ok, 1] for a in jumps]).median() < 1.5


@pytest.mark.parametrize("velocity_std, least", [(0.05, 0.8), (0.5, 0.4)])
def test_positions_that_scatter_beside_velocities_are_found(drive, velocity_std, least):
    """A metre, claimed to be 2 cm, by the way between them; velocities that scatter, or late fixes, do not look so."""
    g, noisy, clean = torch.Generator().manual_seed(7), [], []
    std = torch.full_like(drive.gnss_std, 0.02)
    std[:, 3:] = 0.05
    lag = 0.3 * torch.rand(len(drive.gnss_lag), generator=g, dtype=torch.float64)
    for _ in range(10):
        p, v = torch.randn(2, *drive.gnss_r_e.shape, generator=g, dtype=torch.float64)
        late = drive.gnss_r_e - lag[:, None] * drive.gnss_v_e
        fixes = replace(drive, gnss_std=std, gnss_v_e=drive.gnss_v_e + velocity_std * v, gnss_lag=lag, gnss_r_e=late)
        scatter = align_boundaries(replace(fixes, gnss_r_e=late + p)), align_boundaries(fixes)
        for found, aligned in zip((noisy, clean), scatter):
            found.append(aligned.scatter[aligned.ok, 0][8:])
        ok = scatter[0].ok & (torch.arange(len(lag)) > 8)
        assert scatter[0].std[ok, :3].median() > 0.8 * least
    assert least < torch.cat(noisy).median() * 0.102 < 1.2 and torch.cat(clean).median() < 1.3


def test_a_circle_is_a_motion(drive):
    """Half a radian a second at 8 m/s: the fit turns with the gyroscopes."""
    t, rate, speed = torch.arange(len(drive.gnss_r_e), dtype=torch.float64), 0.5, 8.0
    way_n = speed / rate * torch.stack(((rate * t).sin(), 1 - (rate * t).cos(), 0 * t), -1)
    C_en = ned_axes(*geodetic_from_ecef(drive.gnss_r_e[0])[:2])
    imu = torch.zeros_like(drive.imu)
    imu[..., 1], imu[..., 2], imu[..., 5] = rate * speed, -9.8, rate
    position, std = drive.gnss_valid & (torch.arange(6) < 3), torch.full_like(drive.gnss_std, 0.05)
    circle = replace(drive, imu=imu, gnss_valid=position, gnss_r_e=drive.gnss_r_e[0] + way_n @ C_en.T, gnss_std=std)
    aligned = align_boundaries(circle)
    assert aligned.ok[8:].all()
    course = torch.atan2(*(aligned.v_e @ C_en).T[[1, 0]])
    assert torch.rad2deg((course - rate * t + torch.pi) % (2 * torch.pi) - torch.pi)[8:].abs().max() < 1


def test_positions_that_jump_are_no_starts_and_spoil_none(drive):
    """One position in ten off by 3 m and claimed to be 5 cm: most are left out, and the course of the others holds."""
    g = torch.Generator().manual_seed(3)
    headings, ratios, taken = [], [], 0
    C_en = ned_axes(*geodetic_from_ecef(drive.gnss_r_e)[:2])
    for _ in range(10):
        hit = torch.rand(len(drive.gnss_r_e), generator=g) < 0.1
        noise = 0.05 * torch.randn(drive.gnss_r_e.shape, generator=g, dtype=torch.float64)
        course = 2 * torch.pi * torch.rand(len(hit), generator=g)
        jump = C_en @ (hit * 3.0 * torch.stack((course.cos(), course.sin(), 0 * course))).T.double().unsqueeze(-1)
        position, std = drive.gnss_valid & (torch.arange(6) < 3), torch.full_like(drive.gnss_std, 0.05)
        wrong = replace(drive, gnss_valid=position, gnss_std=std, gnss_r_e=drive.gnss_r_e + noise + jump[..., 0])
        aligned = align_boundaries(wrong)
        taken += int((aligned.ok & hit)[8:].sum())
        assert (aligned.std[aligned.ok & hit, 0] > 1.5).all()  # those that are taken know it
        attitude, *_, std = _errors(wrong, aligned)
        headings.append(attitude[:, 2])
        ratios.append(torch.deg2rad(attitude[:, 2]) / std[:, 8])
    assert taken < 12  # of about fifty
    assert torch.cat(headings).square().mean().sqrt() < 3
    assert torch.cat(ratios).square().mean().sqrt() < 1.0 and torch.cat(ratios).abs().max() < 3


def test_a_start_at_a_position_that_is_off_knows_it(drive):
    """The second fix of a jump that the fit follows: its 1σ is how far it is off the fit to the others."""
    position, std = drive.gnss_valid & (torch.arange(6) < 3), torch.full_like(drive.gnss_std, 0.05)
    r_e = drive.gnss_r_e.clone()
    r_e[30] += 0.4
    off = replace(drive, gnss_valid=position, gnss_std=std, gnss_r_e=r_e)
    aligned, clean = align_boundaries(off), align_boundaries(replace(off, gnss_r_e=drive.gnss_r_e))
    assert aligned.ok[30] and aligned.std[30, 0] > 0.4 > 1.5 * clean.std[30, 0]
    assert clean.scatter.max() < 1.5


def test_the_start_is_the_first_moment_it_can_be(drive):
    still = drive.gnss_v_e.clone()
    still[:20] = 0.0
    start = align(replace(drive, gnss_v_e=still))
    assert start.first == 23  # no car changes its velocity so; the next two agree, and then two seconds of levelling
    still[:20] = drive.gnss_v_e[:20] * torch.arange(20)[:, None].clamp_min(12).sub(12) / 8
    start = align(replace(drive, gnss_v_e=still))
    assert start.first == 14  # faster than 2 m/s
    assert align(drive, earliest=33).first == 33
    state = align(drive).state
    assert state.p_n.abs().max() == 0 and state.C_nb.dtype == torch.float64
    batch = align_drives([drive, drive])
    assert batch.size[:2] == (2, 60 - align(drive).first) and batch.start.v_n.shape == (2, 3)
    error = batch.truth.v_n[:, 0] - batch.start.v_n
    assert error.norm(dim=-1).max() < 5  # a second later


@pytest.mark.parametrize("known", ["all", "positions", "velocities late", "fixes late"])
@pytest.mark.parametrize("config", [ALIGN, SEARCH])
def test_a_start_reads_no_more_of_a_drive_than_it_needs(drive, known, config, monkeypatch):
    """The same as if all of the drive were aligned, and far less of it is; to the bit but for fitted velocities."""
    valid = drive.gnss_valid.clone()
    late = 40 if known.endswith("late") else 0 if known == "all" else len(valid)
    valid[:late, 0 if known.startswith("fixes") else 3 :] = False
    moved, epochs = replace(drive, gnss_valid=valid), []

    def counted(part, config):
        epochs.append(part.epochs)
        return align_boundaries(part, config)

    monkeypatch.setattr(entry, "align_boundaries", counted)
    starts = []
    for first in (1000, 5):
        monkeypatch.setattr(entry, "FIRST_EPOCHS", first)
        starts.append(align(moved, replace(config, search_s=config.search_s / 4)))
    assert epochs[0] == drive.epochs and (epochs[-1] < drive.epochs) == (known != "fixes late")
    a, b = ([*start.state, start.std, torch.tensor([start.first, start.lat, start.height])] for start in starts)
    near = 1e-12 if known in ("positions", "velocities late") else 0.0  # batched products of other sizes
    assert all(torch.allclose(x, y, rtol=near, atol=near) for x, y in zip(a, b, strict=True))


def test_what_cannot_be_aligned_is_told(drive):
    with pytest.raises(InputError, match="drive car-0: never moves faster than 2 m/s"):
        align(replace(drive, gnss_v_e=0 * drive.gnss_v_e))
    with pytest.raises(InputError, match="drive car-0: never moves faster than 50 m/s"):
        align(drive, AlignConfig(min_speed=50))
    with pytest.raises(InputError, match="velocities with a 1σ of 60 m/s do not show the course"):
        align(replace(drive, gnss_std=torch.where(torch.arange(6) < 3, 600.0, 60.0).expand_as(drive.gnss_std).double()))
    with pytest.raises(InputError, match="drive car-0: no GNSS fix"):
        align(replace(drive, gnss_valid=torch.zeros_like(drive.gnss_valid)))
    seldom = drive.gnss_valid & (torch.arange(len(drive.gnss_valid)) % 6 == 0).unsqueeze(-1)
    with pytest.raises(InputError, match="fixes are 6 s apart, a start needs velocities at most 5 s or"):
        align(replace(drive, gnss_valid=seldom))


@pytest.mark.parametrize("kept, velocities", [(x, v) for x in ("110", "10", "1000") for v in (True, False)][:-1])
def test_a_slow_receiver_or_one_that_loses_fixes_starts_a_filter(drive, kept, velocities):
    """By the last velocity there is, as good as with all fixes."""
    known = drive.gnss_valid.clone()
    known[:, 3:] &= velocities
    whole = align_boundaries(replace(drive, gnss_valid=known))
    lost = torch.tensor([x == "0" for x in kept]).repeat(len(known))[: len(known)]
    known[lost] = False
    some = replace(drive, gnss_valid=known)
    aligned = align_boundaries(some)
    assert not aligned.ok[lost].any()
    assert aligned.ok.sum() > 0.8 * (whole.ok & ~lost).sum() - 3
    attitude, _, dv, std = _errors(some, aligned)
    assert attitude.abs().max() < (1.0 if velocities else 3.0) and dv.norm(dim=-1).max() < (0.05 if velocities else 1.0)
    assert (attitude[:, 2].abs() < 3 * torch.rad2deg(std[:, 8])).all()
    assert align(some, SEARCH).first < 25


def test_fixes_that_are_seconds_apart_start_a_filter_whose_update_interval_is_as_long(town):
    drive = load_dataset(town, dtype=torch.float64, epoch_s=5.0)[0]
    for velocities in (True, False):
        known = drive.gnss_valid.clone()
        known[:, 3:] &= velocities
        start = align(replace(drive, gnss_valid=known), SEARCH)
        C_eb = ned_axes(torch.tensor(start.lat), torch.tensor(start.lon)).double() @ start.state.C_nb
        turned = vector_from_rotation(drive.ref_C_eb[start.first].mT @ C_eb)
        assert (abs(turned[2]) < 3 * start.std[8]) and math.degrees(float(turned.norm())) < (3.0 if velocities else 6.0)


def test_real_drives():
    """Against the OxTS attitude: course is heading to a degree, levelling good to half a degree."""
    if not (REAL / "kitti").is_dir():
        pytest.skip("real drives are not here")
    parts = [_errors(d, align_boundaries(d)) for d in load_dataset(REAL / "kitti")]
    attitude, r, v, std = (torch.cat(x) for x in zip(*parts))
    rms = attitude.pow(2).mean(0).sqrt()
    assert len(attitude) > 2000 and (rms[:2] < 0.4).all() and rms[2] < 1.5
    normalised = torch.cat((r, v, torch.deg2rad(attitude)), -1) / std
    assert (normalised.pow(2).mean(0).sqrt() < 1.6).all()  # the stated 1σ is not too bold
    assert torch.nonzero(align_boundaries(load_dataset(REAL / "rtkx")[0]).ok).numel() > 150
