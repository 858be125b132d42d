"""Isolated spikes of an IMU: which samples are, one at a time as in a whole log, and what leaving them out is worth."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dlkf.data.limits import Refused
from dlkf.data.schema import write_drive, write_drives_table
from dlkf.data.spikes import BEFORE, FLOOR, RATIO, SpikeScreen, find_spikes
from dlkf.data.store import load_dataset
from tests.cars import car

FIRST = BEFORE + 1  # sample that can be judged


def still(n: int = 300, size: tuple[float, float] = (0.2, 0.005), seed: int = 0) -> np.ndarray:
    """White noise of that size [m/s², rad/s]."""
    return np.random.default_rng(seed).normal(size=(n, 6)) * np.repeat(size, 3)


def found(x: np.ndarray) -> list[int]:
    return find_spikes(list(x.T)).tolist()


@pytest.mark.parametrize("axes", [[0], [4], [1, 2], [0, 1, 2, 3, 4, 5]])
@pytest.mark.parametrize("k", [FIRST, 150, 297])
def test_a_single_sample_far_off_is_one(k, axes):
    x = still()
    x[k, axes] += np.repeat((20.0, 1.0), 3)[axes]
    assert found(x) == [k]


@pytest.mark.parametrize("k", [3, FIRST - 1, 298, 299])
def test_at_the_ends_of_a_log_none_is_judged(k):
    x = still()
    x[k] += np.repeat((20.0, 1.0), 3)
    assert found(x) == []


@pytest.mark.parametrize(
    "change",
    [
        lambda x: x[150:, 0].__iadd__(20.0),  # a step
        lambda x: x[150:152, 0].__iadd__(20.0),  # two samples
        lambda x: x[150:160, 2].__iadd__(20.0 * 0.7 ** np.arange(10) * np.cos(2.5 * np.arange(10))),  # a knock rings
        lambda x: x[[150, 152], 0].__iadd__(20.0),  # a burst
        lambda x: x[148:153, 2].__iadd__([2.0, 8.0, 20.0, 8.0, 2.0]),  # a bump
        lambda x: (x[150, 2:3].__iadd__(20.0), x[149:152, 4].__iadd__([0.03, 0.06, -0.04])),  # which turns the car
        lambda x: x[150, 0:1].__iadd__(0.9 * FLOOR[0]),  # small
    ],
)
def test_what_a_car_may_do_is_none(change):
    x = still()
    change(x)
    assert found(x) == []


def test_where_the_car_shakes_a_jump_has_to_be_larger():
    """The third quartile of differences of white noise is 1.15 · √2 of its size."""
    least = RATIO * 1.15 * 2**0.5 * 2.0
    for jump, is_one in ((0.6 * least, False), (1.7 * least, True)):
        x = still(size=(2.0, 0.005))
        x[148:153, 0] = x[100, 0]  # steady beside it
        x[150, 0] += jump
        assert (found(x) == [150]) is is_one


@pytest.mark.parametrize("seed", range(3))
def test_one_at_a_time_it_is_the_same_and_each_was_undecided(seed):
    g, x = np.random.default_rng(seed), still(4000, (0.5, 0.02), seed)
    hit = g.random(len(x)) < 0.02
    x[hit] += g.normal(size=(int(hit.sum()), 6)) * np.repeat((20.0, 1.0), 3) * (g.random((int(hit.sum()), 6)) < 0.5)
    screen, said, undecided = SpikeScreen(), [], []
    for k, row in enumerate(x.tolist()):
        if screen.add(row):
            said.append(k - 2)
        undecided.append(screen.undecided)
    assert said == found(x) and len(said) > 20
    assert all(undecided[k] >= 1 and undecided[k + 1] == 2 for k in said)
    assert np.mean(np.array(undecided) > 0) < 0.1


def test_a_drive_is_that_without_them(tmp_path):
    """Spikes are left out before samples are composed; the drive says how many there were."""
    tables = {kind: frame.copy() for kind, frame in car(60).items()}
    at = np.arange(500, 5500, 333)
    bare = {**tables, "imu": tables["imu"].drop(at)}
    tables["imu"].loc[at, "accel_y"] += 25.0
    tables["imu"].loc[at[::2], "gyro_z"] -= 2.0
    drives = []
    for name, frames in (("spikes", tables), ("without", bare)):
        row = write_drive(tmp_path / name, {"drive": "town"}, *(frames[k] for k in ("imu", "gnss", "reference")))
        write_drives_table(tmp_path / name, [row])
        drives += load_dataset(tmp_path / name)
    assert torch.equal(drives[0].imu, drives[1].imu)
    assert drives[0].refused == Refused(spikes=len(at)) and str(drives[0].refused) == f"{len(at)} spikes of the IMU"
    assert not any(drives[1].refused)
