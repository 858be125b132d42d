"""Semi-real drives: what is injected, what stays, where the reference is not known, and how they are marked."""

import hashlib

import numpy as np
import pandas as pd
import pytest
from tests.drives import drives_in, recipe_of

from dlkf.base.errors import InputError
from dlkf.data.kinds import drive_kinds
from dlkf.data.schema import ACCEL, GYRO, IMU_ERROR, write_drive, write_drives_table
from dlkf.data.validate import validate_dataset
from dlkf.navigation.imu_errors import SensorErrors
from dlkf.simulate import choose_dataset
from dlkf.simulation.semi_real import simulate_semi_real

QUIET = {**dict.fromkeys(SensorErrors.__dataclass_fields__, 0.0), "correlation_time": 3600.0}
BIASED = {**QUIET, "turn_on_bias": 0.1, "scale_factor": 0.01, "misalignment": 0.01, "instability": 0.01}
RECEIVER = {"name": "pure", "quality": 4, "std_range": 0.01, "std_range_rate": 0.01}
LICENCE = "CC BY-NC-SA 3.0"


def config(seed=1, imu=BIASED, receiver=None, raw=False, source=None, **dataset):
    small = {"name": "toy", "hours": 0.03, "drive_minutes": 0.9, "reference_rate_hz": 50}
    return {
        "dataset": {**small, **dataset},
        "imu": {"name": "toy_imu", "accel": imu, "gyro": imu},
        "seed": seed,
        "receiver": receiver,
        "raw": raw,
        "source": str(source),
    }


def tables(folder, drive):
    return {k: pd.read_parquet(folder / k / f"drive={drive}" / "part-0.parquet") for k in ("imu", "gnss", "reference")}


@pytest.fixture(scope="module")
def real(tmp_path_factory):
    """Two drives told as real ones: no IMU errors stated; the reference of the first has a hole and invalid rows."""
    made = drives_in(config(imu=QUIET), tmp_path_factory.mktemp("made") / "toy")
    folder = tmp_path_factory.mktemp("real") / "real"
    rows = []
    for k, drive in enumerate(pd.read_parquet(made / "drives.parquet").drive):
        old = tables(made, drive)
        reference = old["reference"].drop(columns=list(IMU_ERROR))
        if k == 0:
            reference["valid"] &= ~reference.t.between(20.0, 24.99)
            reference = reference[~reference.t.between(34.5, 38.5)]
        meta = {"drive": f"r{k}", "group": "tour", "source": "a car", "licence": LICENCE, "imu": "FOG"}
        rows.append(write_drive(folder, meta, old["imu"], old["gnss"], reference))
    write_drives_table(folder, rows)
    return folder


def semi(real, out, **change):
    return simulate_semi_real(real, recipe_of(config(**change)), out, progress=False)


def test_measured_is_the_source_plus_the_stated_error(real, tmp_path):
    """With noise off; the reference is the source's, sample by sample, and its error that of the sample there."""
    out = semi(real, tmp_path / "semi", imu_errors="per_drive")
    assert len(validate_dataset(out)) == 2
    for drive in ("r0", "r1"):
        source, made = tables(real, drive), tables(out, drive)
        assert np.array_equal(source["imu"].t, made["imu"].t)
        columns = list(source["reference"].columns)
        assert made["reference"][columns].equals(source["reference"].reset_index(drop=True))
        apart = (made["imu"] - source["imu"])[[*ACCEL, *GYRO]].to_numpy()
        rows = np.searchsorted(made["imu"].t, made["reference"].t - 1e-9)
        assert np.abs(made["reference"][list(IMU_ERROR)].to_numpy() - apart[rows]).max() < 1e-12
        assert np.abs(apart).mean() > 0.01


def test_fixes_are_at_the_reference_and_only_where_it_is_known(real, tmp_path):
    """Whole seconds; position within five of its 2 cm; none in the hole or at invalid rows."""
    for name, receiver in (("white", None), ("satellites", RECEIVER)):
        out = semi(real, tmp_path / name, receiver=receiver, raw=receiver is not None)
        gnss, reference = (tables(out, "r0")[kind] for kind in ("gnss", "reference"))
        fix = gnss[gnss.quality > 0]
        assert np.array_equal(fix.t, np.round(fix.t))
        unknown = {*range(20, 25), *range(35, 39)}
        assert {int(t) for t in fix.t} == set(range(int(gnss.t.iloc[0]), int(gnss.t.iloc[-1]) + 1)) - unknown
        at = reference.set_index(np.round(reference.t, 6)).loc[fix.t.to_numpy()]
        north = np.radians(fix.lat_deg.to_numpy() - at.lat_deg.to_numpy()) * 6.37e6
        east = np.radians(fix.lon_deg.to_numpy() - at.lon_deg.to_numpy()) * 6.38e6 * np.cos(np.radians(at.lat_deg))
        assert np.abs(north / fix.std_pos_n.to_numpy()).max() < 5 and np.abs(east / fix.std_pos_e).max() < 5
        assert (out / "raw" / "drive=r0" / "part-0.parquet").exists() == (receiver is not None)


def test_late_fixes_are_of_the_reference_before(real, tmp_path):
    """0.2 and 0.1 s are whole samples of the reference at 50 Hz; noise is 1 mm."""
    quiet = dict.fromkeys(("std_horizontal", "std_vertical", "std_velocity"), 0.001)
    out = semi(real, tmp_path / "semi", gnss={**quiet, "position_lag_s": 0.2, "velocity_lag_s": 0.1})
    made = tables(out, "r1")
    reference = made["reference"].set_index(np.round(made["reference"].t * 50).astype(int))
    for lag, name, scale in ((10, "lat_deg", 1.1e5), (5, "vel_e", 1.0)):
        apart = made["gnss"][name].to_numpy() - reference[name].loc[np.round(made["gnss"].t * 50).astype(int) - lag]
        assert np.abs(apart).max() * scale < 0.005


def test_the_antenna_is_where_the_lever_arm_says(real, tmp_path):
    here = tables(semi(real, tmp_path / "here"), "r1")["gnss"]
    there = tables(semi(real, tmp_path / "there", gnss={"lever_arm_b": [1.0, 0.0, -1.5]}), "r1")["gnss"]
    assert np.allclose(there.height_m - here.height_m, 1.5, atol=0.15)  # the road's slope tilts it
    moved = np.hypot(
        np.radians(there.lat_deg - here.lat_deg) * 6.37e6,
        np.radians(there.lon_deg - here.lon_deg) * 6.38e6 * np.cos(np.radians(here.lat_deg)),
    )
    assert np.allclose(moved, 1.0, atol=0.15)


def test_a_fix_claims_no_more_than_the_reference_holds(real, tmp_path):
    """Positions that jump by 0.1 m north, 0.3 m down: known to 5 · 10 % from 50 epochs. A smooth one adds 1 mm."""
    rng = np.random.default_rng(9)

    def jumping(reference):
        shift = rng.standard_normal((len(reference), 2)) * (0.1, 0.3)
        return reference.assign(
            lat_deg=reference.lat_deg + np.degrees(shift[:, 0] / 6.37e6), height_m=reference.height_m + shift[:, 1]
        )

    smooth = tables(semi(real, tmp_path / "smooth"), "r1")["gnss"]
    out = semi(changed(real, tmp_path / "source", jumping), tmp_path / "rough")
    rough = tables(out, "r1")["gnss"]
    assert smooth.std_pos_n.to_numpy() == pytest.approx(0.02, abs=1e-3)
    assert rough.std_pos_n.to_numpy() == pytest.approx(0.1, rel=0.5)
    assert rough.std_pos_d.to_numpy() == pytest.approx(0.3, rel=0.5)
    assert rough.std_pos_e.to_numpy() == pytest.approx(0.02, abs=1e-3)
    assert pd.read_parquet(out / "drives.parquet").reference_roughness_m[0] == pytest.approx(0.18, rel=0.5)


def test_they_are_marked_and_carry_source_and_licence(real, tmp_path):
    out = semi(real, tmp_path / "semi")
    rows = pd.read_parquet(out / "drives.parquet")
    assert drive_kinds(out) == {"r0": "semi-real", "r1": "semi-real"}
    assert (rows.licence == LICENCE).all() and (rows.group == "tour").all()
    assert rows.source.str.contains("a car").all() and rows.imu.str.contains("toy_imu errors injected into: FOG").all()
    assert rows.imu_error.str.contains("injected part only").all()
    assert rows.gnss.str.contains("of the reference").all()


def test_one_unit_a_new_one_per_drive_and_the_same_bits_for_a_seed(real, tmp_path):
    def first_errors(name, **change):
        out = semi(real, tmp_path / name, **change)
        return [tables(out, drive)["reference"].accel_error_z.iloc[0] for drive in ("r0", "r1")]

    def digest(name):
        files = sorted((tmp_path / name).rglob("*.parquet"))
        return [hashlib.sha256(path.read_bytes()).hexdigest() for path in files]

    flat = {**QUIET, "turn_on_bias": 0.1}
    assert len(set(np.round(first_errors("one", imu=flat), 12))) == 1
    assert len(set(np.round(first_errors("new", imu=flat, imu_errors="per_drive"), 12))) == 2
    first_errors("again", imu=flat, imu_errors="per_drive")
    first_errors("other", imu=flat, imu_errors="per_drive", seed=2)
    assert digest("new") == digest("again") != digest("other")


def changed(real, folder, change):
    """A copy of the second real drive alone, its reference changed."""
    old = tables(real, "r1")
    reference = change(old["reference"])
    write_drives_table(folder, [write_drive(folder, {"drive": "r1"}, old["imu"], old["gnss"], reference)])
    return folder


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda reference: None, "no reference"),
        (lambda reference: reference.assign(**dict.fromkeys(IMU_ERROR, 0.1)), "source= takes real drives"),
        (lambda reference: reference.assign(valid=False), "valid at no GNSS epoch"),
        (lambda reference: reference.assign(roll=np.nan), "lever_arm_b"),
        (lambda reference: reference.assign(t=reference.t + 1000), "in common"),
    ],
)
def test_sources_that_will_not_do_are_one_clear_line(real, tmp_path, change, said):
    source = changed(real, tmp_path / "source", change)
    with pytest.raises(InputError) as caught:
        semi(source, tmp_path / "semi", gnss={"lever_arm_b": [1.0, 0.0, 0.0]})
    assert said in str(caught.value) and "r1" in str(caught.value) and "\n" not in str(caught.value)
    assert [path.name for path in tmp_path.iterdir()] == ["source"]


def test_without_attitude_the_antenna_is_at_the_imu(real, tmp_path):
    source = changed(real, tmp_path / "source", lambda reference: reference.assign(roll=np.nan, pitch=np.nan))
    fixes = tables(semi(source, tmp_path / "semi", receiver=RECEIVER), "r1")["gnss"]
    assert (fixes.quality == 4).all()


def test_a_source_means_semi_real_unless_a_dataset_is_named():
    assert choose_dataset(["source=x", "seed=2"]) == ["source=x", "seed=2", "dataset=semi_real"]
    assert choose_dataset(["source=x", "dataset=mine"]) == ["source=x", "dataset=mine"]
    assert choose_dataset(["dataset.hours=2"]) == ["dataset.hours=2"]
