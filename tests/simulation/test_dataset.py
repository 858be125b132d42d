"""Datasets: the same for a seed, whole or not at all, one IMU or a new one in every drive."""

import hashlib
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from tests.drives import drives_in

from dlkf.base.errors import InputError
from dlkf.navigation.imu_errors import SensorErrors
from dlkf.simulation.dataset import DatasetConfig, dataset_config

SENSOR = dict.fromkeys(SensorErrors.__dataclass_fields__, 0.0)
BIASED = {**SENSOR, "turn_on_bias": 0.1, "noise_density": 1e-3, "correlation_time": 3600.0}
QUIET = {**SENSOR, "correlation_time": 3600.0}


def config(seed=1, workers=1, imu=BIASED, **dataset):
    small = {"name": "toy", "hours": 0.05, "drive_minutes": 1.0}
    return {
        "dataset": {**small, **dataset},
        "imu": {"name": "toy_imu", "accel": imu, "gyro": imu},
        "seed": seed,
        "workers": workers,
    }


def digest(folder: Path) -> dict[str, str]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def table(folder: Path, kind: str, index: int = 0) -> pd.DataFrame:
    return pd.read_parquet(sorted((folder / kind).iterdir())[index] / "part-0.parquet")


def test_same_seed_same_bytes_whatever_the_workers(tmp_path):
    one = digest(drives_in(config(workers=1), tmp_path / "one"))
    two = digest(drives_in(config(workers=3), tmp_path / "two"))
    other = digest(drives_in(config(seed=2), tmp_path / "other"))
    assert one == two
    assert not set(one.values()) & set(other.values())


def test_tables_and_their_clocks(tmp_path):
    out = drives_in(config(gnss={"rate_hz": 2}, imu_rate_hz=50), tmp_path / "toy")
    drives = pd.read_parquet(out / "drives.parquet")
    assert len(drives) == 3 and (drives.duration_s == 60).all() and drives.group.is_unique
    imu, gnss, reference = (table(out, kind) for kind in ("imu", "gnss", "reference"))
    assert np.allclose(imu.t, np.arange(1, 3001) / 50, rtol=0, atol=1e-12)
    assert np.allclose(gnss.t, np.arange(0, 121) / 2, rtol=0, atol=1e-12)
    assert np.allclose(reference.t, np.arange(0, 601) / 10, rtol=0, atol=1e-12)
    assert reference.yaw.abs().max() <= np.pi
    assert not any(frame.isna().any().any() for frame in (imu, gnss, reference))
    assert not list(tmp_path.glob(".*"))


def test_reference_carries_the_error_of_the_sample_that_ends_there(tmp_path):
    """With noise off, measured minus error is what a perfect IMU measures on the same roads."""
    scaled = {**QUIET, "turn_on_bias": 0.1, "scale_factor": 0.01, "misalignment": 0.01, "instability": 0.01}
    real = drives_in(config(imu=scaled), tmp_path / "real")
    perfect = drives_in(config(imu=QUIET), tmp_path / "perfect")
    apart = table(real, "imu").drop(columns="t") - table(perfect, "imu").drop(columns="t")
    reference = table(real, "reference")
    for sensor in ("accel", "gyro"):
        for axis in "xyz":
            error = reference[f"{sensor}_error_{axis}"].to_numpy()
            assert np.allclose(error[1:], apart[f"{sensor}_{axis}"].to_numpy()[9::10], rtol=0, atol=1e-12)
    assert table(real, "gnss").equals(table(perfect, "gnss"))


def test_one_unit_or_a_new_one_per_drive(tmp_path):
    def biases(**dataset):
        folder = tmp_path / "-".join(f"{key}{value}" for key, value in dataset.items())
        out = drives_in(config(**dataset), folder)
        return [table(out, "reference", k).accel_error_x.iloc[0] for k in range(3)]

    first = biases(imu_errors="one", seed=1)
    assert len(set(first)) == 1
    assert biases(imu_errors="one", seed=2) == first  # other roads, the same unit
    assert biases(imu_errors="one", unit_seed=5) != first
    assert len(set(biases(imu_errors="per_drive"))) == 3


def test_a_fleet_has_new_units_of_several_types(tmp_path):
    kinds = {name: {"name": name, "accel": BIASED, "gyro": BIASED} for name in ("a", "b", "c")}
    fleet = config(imu_errors="fleet", fleet=kinds, hours=0.2)
    drives = pd.read_parquet(drives_in(fleet, tmp_path / "fleet") / "drives.parquet")
    assert set(drives.imu) == {"a", "b", "c"}
    biases = [table(tmp_path / "fleet", "reference", k).accel_error_x.iloc[0] for k in range(len(drives))]
    assert len(set(biases)) == len(drives) == 12


CAR = {"sideslip": 0.0075, "imu_arm": [-0.32, 0.0, -0.6], "roughness": 64e-6, "vibration": 0.2}


def test_velocity_across_the_car_is_told_and_zero_for_a_point(tmp_path):
    point = pd.read_parquet(drives_in(config(), tmp_path / "point") / "drives.parquet")
    car = pd.read_parquet(drives_in(config(chassis=CAR), tmp_path / "car") / "drives.parquet")
    for column in ("lateral_axle_mps", "lateral_imu_mps", "down_imu_mps"):
        assert point[column].max() < 1e-12
        assert car[column].max() > 0.01
    assert (car.imu_arm_x_m == -0.32).all() and (car.sideslip_s2pm == 0.0075).all()
    reference, moved = table(tmp_path / "car", "reference"), table(tmp_path / "point", "reference")
    apart = np.hypot(reference.vel_n - moved.vel_n, reference.vel_e - moved.vel_e)
    assert 0 < apart.max() < 1.0  # the same road


def test_tunnels_leave_no_fixes(tmp_path):
    tunnels = {"tunnel_length": 100.0, "tunnel_spacing": 100.0}
    out = drives_in(config(surroundings=tunnels, drive_minutes=3.0), tmp_path / "toy")
    t = table(out, "gnss").t
    assert len(t) < 170 and np.diff(t).max() > 4


def test_existing_data_are_kept_unless_told(tmp_path):
    out = drives_in(config(), tmp_path / "toy")
    before = digest(out)
    with pytest.raises(InputError, match="overwrite=true"):
        drives_in(config(seed=2), out)
    assert digest(out) == before
    drives_in(config(seed=2), out, overwrite=True)
    assert digest(out) != before
    assert [path.name for path in tmp_path.iterdir()] == ["toy"]


def test_nothing_is_left_of_a_failed_run(tmp_path, monkeypatch):
    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr("dlkf.simulation.dataset.write_drive", fail)
    with pytest.raises(OSError, match="disk full"):
        drives_in(config(workers=2), tmp_path / "toy")
    assert not list(tmp_path.iterdir())


def test_hours_are_shared_out_evenly():
    assert DatasetConfig("x", hours=5.0, drive_minutes=10.0).durations == [600] * 30
    assert DatasetConfig("x", hours=0.75, drive_minutes=10.0).durations == [540] * 5
    assert sum(DatasetConfig("x", hours=1.001, drive_minutes=7.0).durations) == 3604


@pytest.mark.parametrize(
    ("dataset", "said"),
    [
        ({"hours": -1.0}, "hours"),
        ({"hours": float("nan")}, "hours"),
        ({"hours": "five"}, "hours"),
        ({"drive_minutes": 0.0}, "drive_minutes"),
        ({"gnss": {"rate_hz": 3.0}}, "multiple"),
        ({"gnss": {"rate_hz": 0.0}}, "multiple"),
        ({"reference_rate_hz": 30}, "multiple"),
        ({"imu_rate_hz": 104.3}, "imu_rate_hz"),
        ({"imu_errors": "some"}, "per_drive"),
        ({"unit_seed": -1}, "unit_seed"),
        ({"name": "a/b"}, "name"),
        ({"hour": 1.0}, "hour"),
        ({"vehicle": {"max_sped": 1.0}}, "max_sped"),
        ({"vehicle": {"manoeuvres": {"turns": 1.0}}}, "turns"),
        ({"vehicle": {"manoeuvres": {"turn": 0.9}}}, "sum"),
        ({"vehicle": {"min_radius": 40.0, "max_radius": 30.0}}, "max_radius"),
        ({"vehicle": {"min_lateral": 5.0, "min_radius": 150.0}}, "98.6 km/h"),
        ({"chassis": {"sideslip": -1.0}}, "sideslip"),
        ({"chassis": {"imu_arm": "left"}}, "imu_arm"),
        ({"surroundings": {"tunnel_length": -3.0}}, "tunnel_length"),
        ({"imu_errors": "fleet"}, "fleet"),
        ({"fleet": ["consumer"]}, "fleet"),
        ({"fleet": {"a": {"name": "a"}}}, "accel"),
        ({"vehicle": {"max_speed_kmh": 10.0}}, "km/h"),
        ({"gnss": {"lever_arm_b": [1.0]}}, "lever_arm_b"),
        ({"gnss": {"lever_arm_b": 1.0}}, "lever_arm_b"),
        ({"gnss": None}, "gnss"),
    ],
)
def test_bad_datasets_are_one_clear_line(dataset, said):
    with pytest.raises(InputError) as caught:
        dataset_config({"name": "toy", **dataset})
    assert said in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "change", [{"seed": -1}, {"seed": 1.5}, {"seed": None}, {"workers": 0}, {"imu": {"name": "toy"}}]
)
def test_bad_runs_are_one_clear_line(change, tmp_path):
    with pytest.raises(InputError, match=f"(?i){next(iter(change))}"):
        drives_in({**config(), **change}, tmp_path / "toy")
    assert not list(tmp_path.iterdir())
