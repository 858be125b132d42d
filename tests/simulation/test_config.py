"""The shipped configurations: every preset reads, every dataset brings its IMU, the command line wins."""

from pathlib import Path

import pandas as pd
import pytest
import yaml
from tests.drives import drives_in

from dlkf.command.composing import compose_command
from dlkf.data.validate import validate_dataset
from dlkf.navigation.imu_errors import imu_spec
from dlkf.simulation.dataset import dataset_config

CONF = Path(__file__).parents[2] / "conf"
PRESETS = sorted(path.stem for path in (CONF / "imu").glob("*.yaml") if path.stem != "auto")  # auto is not known before
BRINGS = {
    **dict.fromkeys(("one_imu", "one_imu_hour", "one_imu_tiny"), "automotive_mems"),
    "per_drive": "automotive_mems",
    **dict.fromkeys(("paper_clean", "paper_clean_hour", "paper_clean_units"), "table3_standin"),
    "paper_mems": "groves_consumer",
    "one_imu_hour": "automotive_mems",
    "paper_clean_hour": "table3_standin",
    "paper_clean_units": "table3_standin",
    "semi_real": "automotive_mems",
    **dict.fromkeys(("wide", "calm"), "wide"),
    **dict.fromkeys(("lifelike", "city", "highway", "car_park", "tunnel", "fleet", "other_imus"), "lifelike_mems"),
}

MINUTE = "dataset.drive_minutes=1"


def test_presets_read_and_say_where_they_come_from():
    specs = {name: imu_spec(yaml.safe_load((CONF / "imu" / f"{name}.yaml").read_text())) for name in PRESETS}
    assert [name for name, spec in specs.items() if spec.name != name or not spec.source] == []
    assert [name for name, spec in specs.items() if spec.accel.noise_density == 0] == ["perfect"]


@pytest.mark.parametrize(
    ("name", "accel", "gyro"),
    [  # √S of paper.md 2.10 in m/s²/√Hz and rad/s/√Hz, given to three digits
        ("groves_consumer", 9.81e-3, 2.91e-4),
        ("icm20602_datasheet", 9.81e-4, 6.98e-5),
        ("icm20602_i2nav", 3.33e-3, 5.82e-5),
        ("bmi055_class", 1.47e-3, 2.44e-4),
        ("bmi270", 1.57e-3, 1.22e-4),
        ("adis16465_i2nav", 1.67e-3, 2.91e-5),
    ],
)
def test_noise_densities_are_those_of_the_sources(name, accel, gyro):
    spec = imu_spec(yaml.safe_load((CONF / "imu" / f"{name}.yaml").read_text()))
    assert spec.accel.noise_density == pytest.approx(accel, rel=4e-3)
    assert spec.gyro.noise_density == pytest.approx(gyro, rel=4e-3)


@pytest.mark.parametrize("name", BRINGS)
def test_datasets_bring_their_imu_and_the_command_line_wins(name):
    config = compose_command("simulate", f"simulated@dataset={name}")
    assert dataset_config(config["dataset"]).name == name
    assert config["imu"]["name"] == BRINGS[name]
    assert config["out"] == f"data/{name}"
    assert compose_command("simulate", "imu=consumer", f"simulated@dataset={name}")["imu"]["name"] == "consumer"


def test_every_dataset_is_listed_here():
    assert sorted(BRINGS) == sorted(path.stem for path in (CONF / "simulated").glob("[!_]*.yaml"))


def test_a_simulated_dataset_keeps_the_contract(tmp_path):
    config = compose_command("simulate", "simulated@dataset=per_drive", MINUTE, "dataset.hours=0.05", "seed=4")
    rows = validate_dataset(drives_in(config, tmp_path / "toy"))
    assert [row.name for row in rows] == [f"per_drive-4-0000{k}" for k in range(3)]


def test_any_dataset_can_have_another_car():
    """Both settings are presets: the paper's point, and a lifelike car."""
    point = compose_command("simulate", "simulated@dataset=lifelike", "chassis@dataset.chassis=point")
    car = compose_command("simulate", "simulated@dataset=one_imu", "chassis@dataset.chassis=lifelike")
    assert dataset_config(point["dataset"]).chassis.is_point
    assert dataset_config(car["dataset"]).chassis.sideslip == 0.0075
    assert dataset_config(compose_command("simulate", "simulated@dataset=paper_clean")["dataset"]).chassis.is_point


def test_a_fleet_brings_its_types():
    fleet = compose_command("simulate", "simulated@dataset=fleet", "imu@dataset.fleet.consumer=roof_mems")
    config = dataset_config(fleet["dataset"])
    assert len(config.fleet) == 7 and config.fleet["consumer"].name == "roof_mems"


SMOOTH = "dataset.chassis.pitch_noise=0"  # as of commit de03f96, whose bodies did not pitch over swells


@pytest.mark.parametrize(
    ("name", "change", "row"),
    [
        ("per_drive", SMOOTH, (1.5492767586553957, 0.0027445155981323213, 52.14900391914931, -4.015150024877584,
                               -2.76424754)),
        ("lifelike", SMOOTH, (2.21345639, 0.008522112, 52.14899905164565, -4.01557466571004, -2.781035400067427)),
        ("tunnel", SMOOTH, (-0.81164058, 0.002530002, 52.15191703641227, 4.535831645478157, 0.3520133931390287)),
        ("fleet", SMOOTH, (2.213352918483799, 0.008828225993601948, 52.14899905164565, -4.01557466571004,
                           -2.781035400067427)),
        ("lifelike", "seed=3", (2.18592286, 0.008522112, 52.14899901308736, -4.015627795660897, -2.7810242965717453)),
        ("tunnel", "seed=3", (-0.78650127, 0.002530002, 52.15191700011498, 4.534374908019435, 0.3520084169061231)),
    ],
)  # fmt: skip
def test_a_seed_gives_the_drives_that_it_always_gave(name, change, row, tmp_path):
    """At 30 s: what is new is drawn after the old, or by generators of its own. The tolerance leaves room for another
    machine's rounding."""
    config = compose_command("simulate", f"simulated@dataset={name}", MINUTE, "dataset.hours=0.01", "seed=3", change)
    folder = drives_in(config, tmp_path / name)
    imu, gnss, reference = (
        pd.read_parquet(folder / kind / f"drive={name}-3-00000" / "part-0.parquet").iloc[at]
        for kind, at in (("imu", 3000), ("gnss", 30), ("reference", 300))
    )
    assert (imu.accel_x, imu.gyro_z, gnss.lat_deg, gnss.vel_e, reference.yaw) == pytest.approx(row, rel=1e-9)
