"""The wide fleet: each drive another world, fixed values leave the rest alone."""

import json

import numpy as np
import pandas as pd
import pytest
import torch
from tests.drives import drive_in_memory

from dlkf.base.errors import InputError
from dlkf.command.simulated import compose_recipe
from dlkf.data.store import load_dataset
from dlkf.simulation.dataset import simulate

SHORT = ("dataset.hours=0.05", "dataset.drive_minutes=1", "seed=4")


def wide(*overrides: str, name: str = "wide"):
    return compose_recipe(f"simulated@dataset={name}", *SHORT, *overrides)


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fleet") / "wide"
    return simulate(wide(), folder, progress=False, workers=1)


def test_every_drive_is_a_world_of_its_own_and_says_which(fleet):
    drives = pd.read_parquet(fleet / "drives.parquet")
    drawn = [json.loads(text) for text in drives["drawn"]]
    dataset, imu = [one["dataset"] for one in drawn], [one["imu"] for one in drawn]
    keys = (("vehicle", "lat_deg", dataset), ("chassis", "wheelbase", dataset), ("gyro", "noise_density", imu))
    for part, key, of in keys:
        values = [one[part][key] for one in of]
        assert len(set(values)) == len(values) == 3
    described = json.loads((fleet / "simulation.json").read_text())
    assert described["seed"] == 4 and "log_uniform" in described["imu"]["accel"]["turn_on_bias"]
    assert len(load_dataset(fleet, drives=[drives["drive"][0]])) == 1  # passes the checks of the contract


def test_a_drive_depends_on_its_number_alone(fleet):
    """Made by itself it is that of the whole dataset, to the bit: nothing but Parquet, which keeps float64, lies
    between them."""
    one, other = load_dataset(fleet, rate_hz=50.0)[2], drive_in_memory(wide(), 2, 60)
    assert one.name == other.name and one.t0 == other.t0
    for name in ("imu", "gnss_r_e", "gnss_std", "gnss_valid", "ref_C_eb", "ref_imu_error", "lever_arm_b"):
        assert torch.equal(torch.nan_to_num(getattr(one, name)), torch.nan_to_num(getattr(other, name))), name


def test_a_fixed_value_leaves_the_rest_of_the_fleet_alone():
    """The calm fleet has the same roads and units; only what vibrates is gone."""
    shaken, calm = ([drive_in_memory(made_by, k, 60) for k in range(2)] for made_by in (wide(), wide(name="calm")))
    for one, other in zip(shaken, calm, strict=True):
        known = one.ref_valid & other.ref_valid
        apart = (one.ref_r_e - other.ref_r_e)[known].norm(dim=-1)
        assert known.all() and apart.max() < 0.05  # m, the amplitude of what vibrates
        assert torch.equal(one.gnss_std.isnan(), other.gnss_std.isnan())
    assert any((one.imu - other.imu).abs().max() > 0.01 for one, other in zip(shaken, calm, strict=True))


def test_the_middle_is_what_a_filter_is_told():
    made_by = wide()
    assert made_by.imu.name == "wide"
    assert made_by.imu.accel.noise_density == pytest.approx(np.sqrt(2e-4 * 0.03))
    assert made_by.dataset.receiver is None and made_by.dataset.imu_errors == "wide"


def test_draws_stay_possible():
    """No draw of many is refused by the settings' own limits."""
    made_by = wide()
    kinds = set()
    for k in range(150):
        config, spec = made_by.draw_drive(np.random.SeedSequence(9, spawn_key=(k,)))
        kinds.add((config.vehicle.manoeuvres.stop, getattr(config.receiver, "name", "white")))
        assert spec.accel.noise_density <= 0.03
    assert len(kinds) > 10


def test_a_point_may_drive_in_the_fleet():
    """What the preset says stands above what the variants of roads say of their roughness."""
    for k in range(5):
        config, _ = wide("chassis@dataset.chassis=point").draw_drive(np.random.SeedSequence(k))
        assert config.chassis.is_point


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["dataset.hours={uniform:[1,2]}"], "hours is a range"),
        (["dataset.imu_errors=one"], "imu_errors=wide"),
        (["dataset.chassis.sideslip.log_uniform=[2,1]"], r"dataset\.chassis\.sideslip"),
        (["dataset.chassis.sideslip.log_uniform=[1,9]"], "sideslip"),
    ],
)
def test_odd_ranges_are_one_clear_line(overrides, words):
    with pytest.raises(InputError, match=words) as caught:
        made_by = wide(*overrides)
        for k in range(20):
            made_by.draw_drive(np.random.SeedSequence(0, spawn_key=(k,)))
    assert "\n" not in str(caught.value)
