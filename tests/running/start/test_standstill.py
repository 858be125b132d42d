"""Standstills are found from IMU and GNSS, and attitude is carried back over them and over first motion."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from dlkf.data.masks import find_runs
from dlkf.data.store import load_dataset
from dlkf.navigation.attitude import vector_from_rotation
from dlkf.navigation.earth import EARTH_RATE
from dlkf.running.start.standstill import (
    RATE_STD,
    carry_attitude_back,
    carry_std,
    rest_around,
    stationary_epochs,
    stationary_gyros,
)
from tests.cars import REAL


@pytest.fixture(scope="module")
def drive(town):
    return load_dataset(town, dtype=torch.float64)[0]


def _parked(drive, seconds: int, noise: float = 0.0):
    """The drive after so long a standstill where it begins; gyroscopes with noise."""
    g = torch.Generator().manual_seed(1)
    C_be = drive.ref_C_eb[0].mT
    up = drive.gnss_r_e[0] / drive.gnss_r_e[0].norm()
    still = torch.cat((9.81 * C_be @ up, EARTH_RATE * C_be[:, 2])).expand(seconds, drive.imu.shape[1], 6).clone()
    still[..., 3:] += noise * torch.randn(still[..., 3:].shape, generator=g, dtype=torch.float64)
    rows = torch.cat((torch.zeros(seconds, dtype=torch.int64), torch.arange(drive.epochs + 1)))
    names = [n for n in vars(drive) if n.startswith(("gnss_", "ref_")) or n == "quality"]
    held = {n: getattr(drive, n)[rows] for n in names}
    held["gnss_v_e"][:seconds] = 0
    return replace(drive, imu=torch.cat((still, drive.imu)), **held)


def test_a_standstill_is_quiet_and_stays_where_it_is(drive):
    parked = _parked(drive, 10)
    # the tenth second ends with a fix in motion, so it is not sure to be one of rest
    assert find_runs(stationary_epochs(parked)) == [(0, 9)] and not stationary_epochs(drive).any()
    shaken = replace(parked, imu=parked.imu.clone())
    shaken.imu[4, ::2, 0] += 2.0
    assert find_runs(stationary_epochs(shaken)) == [(0, 4), (5, 9)]
    assert [rest_around(stationary_epochs(shaken), k) for k in (4, 5, 7)] == [slice(0, 4), slice(5, 9), slice(5, 9)]
    unseen = replace(parked, gnss_valid=torch.zeros_like(parked.gnss_valid))
    assert not stationary_epochs(unseen).any()
    smooth_road = replace(parked, gnss_v_e=parked.gnss_v_e + torch.tensor([1.0, 0, 0]))  # quiet, but it moves
    assert not stationary_epochs(smooth_road).any()
    one_second = parked.part(8, 20)
    assert not stationary_epochs(one_second).any()


def test_positions_tell_a_standstill_where_there_are_no_velocities(drive):
    blind = _parked(drive, 10)
    blind = replace(blind, gnss_valid=blind.gnss_valid & (torch.arange(6) < 3))
    assert find_runs(stationary_epochs(blind)) == [(0, 10)]
    coarse = replace(blind, gnss_std=blind.gnss_std + 1.0)  # a metre: a crawl could hide in it
    assert not stationary_epochs(coarse).any()


def test_attitude_is_carried_back_through_motion_and_rest(drive):
    """With a gyroscope error of 1 °/s that the standstill shows; without one it turns what is carried."""
    error = torch.tensor([0.01, -0.01, 0.017], dtype=torch.float64)
    noise = 1e-3
    parked = _parked(drive, 10, noise)
    parked.imu[..., 3:] += error
    rest = stationary_epochs(parked)
    gyros = stationary_gyros(parked, rest, parked.ref_C_eb[25])
    sigma = noise / math.sqrt(9 * 50)
    # the Earth's rate depends on the heading, which turned meanwhile
    assert (gyros.error - error).abs().max() < 4 * sigma + 2 * EARTH_RATE
    C = carry_attitude_back(parked, parked.ref_C_eb[25], 25, 3, gyros, rest)
    off = vector_from_rotation(C.mT @ parked.ref_C_eb[3]).norm()
    moved = 16  # s in motion, the one before it included
    assert off < 4 * math.sqrt(3) * (sigma * moved + noise * math.sqrt(moved / 50)) + EARTH_RATE * moved
    unknown = stationary_gyros(parked, torch.zeros_like(rest), parked.ref_C_eb[25])
    assert unknown.std == RATE_STD and unknown.error.abs().max() == 0
    far = carry_attitude_back(parked, parked.ref_C_eb[25], 25, 3, unknown, rest)
    assert vector_from_rotation(far.mT @ parked.ref_C_eb[3]).norm() > 0.2  # 0.022 rad/s · 16 s, less as it turns
    added = carry_std(parked, torch.arange(24, 2, -1), gyros, rest)
    assert added[0] == 0 and (added[1 : moved + 1] >= gyros.std * torch.arange(1, moved + 1)).all()
    assert (added[moved:] == added[moved]).all()  # rest adds nothing


def test_the_stated_spread_holds_for_the_error_of_what_is_carried(drive):
    """Gyroscope errors drawn with the 1σ stated of unseen ones: carried heading errors are as large as stated."""
    g = torch.Generator().manual_seed(0)
    none = torch.zeros(drive.epochs, dtype=torch.bool)
    off = []
    for _ in range(40):
        error = RATE_STD * torch.randn(3, generator=g, dtype=torch.float64)
        turned = replace(drive, imu=drive.imu + torch.cat((0 * error, error)))
        gyros = stationary_gyros(turned, none, drive.ref_C_eb[20])
        C = carry_attitude_back(turned, drive.ref_C_eb[20], 20, 10, gyros, none)
        off.append(vector_from_rotation(C.mT @ drive.ref_C_eb[10])[2])
    stated = carry_std(drive, torch.arange(19, 9, -1), gyros, none)[-1]
    assert 0.6 < torch.stack(off).std() / stated < 1.4  # χ² of 40 draws: ±0.22 at 2σ; scale factors are extra


def test_real_standstills():
    """Against the reference's speed: what is taken for rest is, and most of it is found."""
    if not (REAL / "kitti").is_dir():
        pytest.skip("real drives are not here")
    found = true = wrong = 0
    for d in load_dataset(REAL / "kitti", dtype=torch.float64):
        speed = d.ref_v_e.norm(dim=-1)
        standing = (speed[1:] < 0.05) & (speed[:-1] < 0.05)
        rest = stationary_epochs(d)
        found, true = found + int((rest & standing).sum()), true + int(standing.sum())
        wrong += int((rest & (speed[1:].maximum(speed[:-1]) > 0.5)).sum())
    assert true > 100 and found > 0.9 * true and wrong == 0
