"""The recipes of docs/developing.md, followed to the letter on small data; and its map of the rooms."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

from dlkf.base.config import config_dir
from dlkf.base.errors import InputError
from dlkf.filters.saved import load_filter
from dlkf.navigation.imu_errors import imu_spec
from dlkf.tracking.models import resolve_model
from tests.docs.conftest import Run
from tests.docs.pages import ROOT, Block, blocks, commands
from tests.test_imports import FLOORS, GLUED

PAGE = ROOT / "docs" / "developing.md"
RECIPES: dict[str, list[Block]] = {}
for block in blocks(PAGE):
    RECIPES.setdefault(block.heading, []).append(block)
LONGEST = 28  # lines of code


def written(recipe: str, desk: Path) -> None:
    """The files of a recipe."""
    for block in RECIPES[recipe]:
        if block.file:
            (desk / block.file).parent.mkdir(parents=True, exist_ok=True)
            (desk / block.file).write_text(block.text)


def lines(recipe: str) -> list[list[str]]:
    """The commands of a recipe."""
    return [words for block in RECIPES[recipe] if not block.file for words in commands(block.text)]


def followed(recipe: str, desk: Path, run: Run) -> None:
    """Write the files and run the commands of a recipe."""
    written(recipe, desk)
    for words in lines(recipe):
        run(words)


def test_the_map_shows_the_floors() -> None:
    rows = re.findall(r"^\| (\d+) \| ([^|]+) \|", PAGE.read_text(), re.M)
    assert [int(n) for n, _ in rows] == list(range(len(FLOORS), 0, -1))
    for number, rooms in rows:
        assert set(re.findall(r"`(\w+)`", rooms)) == FLOORS[int(number) - 1] - {""}, f"floor {number}"
    above = PAGE.read_text().partition("| | | |")[0]
    lowest = len(FLOORS) + 1 - len(re.findall(r"^\| \d+ \|", above, re.M))
    assert all(rooms & GLUED for rooms in FLOORS[lowest - 1 :][:2])
    assert not any(rooms & GLUED for rooms in FLOORS[: lowest - 1])


def test_recipes_are_short() -> None:
    long = []
    for recipe, parts in RECIPES.items():
        for part in parts:
            code = [line for line in part.text.splitlines() if line.strip() and not line.startswith("#")]
            long += [f"{recipe}: {len(code)} lines"] if len(code) > LONGEST else []
    assert not long, long


def test_a_filter_and_a_source(desk: Path, run: Run) -> None:
    followed("A filter", desk, run)
    metrics = json.loads((desk / "outputs" / "blend" / "metrics.json").read_text())
    assert "Blend" in json.dumps(metrics)
    followed("A source of measurements", desk, run)
    solved = {f: pd.read_parquet(next((desk / "outputs" / f).glob("drive=*"))) for f in ("limited", "blended")}
    speed = {f: np.hypot(s["vel_n"], s["vel_e"]).max() for f, s in solved.items()}
    assert speed["limited"] < speed["blended"]


def test_a_sensor(desk: Path, run: Run) -> None:
    for drive in (desk / "data" / "consumer" / "reference").glob("drive=*"):
        truth = pd.read_parquet(drive)
        table = pd.DataFrame({"t": truth["t"], "speed": 1.03 * np.hypot(truth["vel_n"], truth["vel_e"])})
        (desk / "data" / "consumer" / "radar" / drive.name).mkdir(parents=True)
        table.to_parquet(desk / "data" / "consumer" / "radar" / drive.name / "part-0.parquet")
    followed("A sensor", desk, run)
    solved = pd.read_parquet(next((desk / "outputs" / "radar").glob("drive=*")))
    assert solved["radar_used"].sum() > 20
    assert abs(solved["radar_scale"].iloc[-1] - 0.03) < 0.01 > solved["std_radar_scale"].iloc[-1]


def test_mistakes_in_a_filter_of_ones_own() -> None:
    imu = imu_spec(yaml.safe_load((config_dir() / "imu" / "consumer.yaml").read_text()))
    for spec, said in (("no_such_module:Blend", "No module named"), ("json:dumps", "is a part of Python")):
        with pytest.raises(InputError, match=said):
            resolve_model(spec, imu)


def test_an_imu(desk: Path, run: Run) -> None:
    followed("An IMU", desk, run)
    assert next((desk / "outputs" / "shed").glob("drive=*/solution.parquet")).is_file()


def test_a_car(desk: Path, run: Run) -> None:
    followed("A car", desk, run)
    table = pd.read_parquet(desk / "data" / "van" / "drives.parquet")
    assert (table["lever_arm_z_m"] == -1.9).all()


def test_a_reader(desk: Path, run: Run) -> None:
    (desk / "logs" / "shed").mkdir(parents=True)
    drive = pd.read_parquet(desk / "data" / "consumer" / "drives.parquet")["drive"][0]
    tables = {k: pd.read_parquet(desk / "data" / "consumer" / k / f"drive={drive}") for k in ("imu", "gnss")}
    columns = ["t", "lat_deg", "lon_deg", "height_m", "vel_n", "vel_e", "vel_d"]
    imu = ["t", "gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z"]
    np.savez(desk / "logs" / "shed" / "monday.npz", imu=tables["imu"][imu], gnss=tables["gnss"][columns])
    followed("A reader", desk, run)
    read = pd.read_parquet(desk / "data" / "shed" / "imu" / "drive=monday")
    np.testing.assert_array_equal(read["accel_z"], tables["imu"]["accel_z"])


def test_an_experiment_a_callback_a_network_and_a_loss(desk: Path, run: Run, client) -> None:
    """One training that all four recipes ask for; then its model is loaded again."""
    (experiment,) = lines("An experiment")
    recipes = ("A callback", "A network", "A loss")
    own = [word for recipe in recipes for word in lines(recipe)[0] if re.match(r"\+?(callbacks|model|loss)\.", word)]
    assert len(own) == 5
    for recipe in ("An experiment", *recipes):
        written(recipe, desk)
    run([*experiment, *own])
    (config,) = (desk / "outputs" / "train" / "fresh_bias").glob("*/best/config.yaml")
    assert load_filter(config.parent).network.width == 32
    (made,) = client.search_runs([e.experiment_id for e in client.search_experiments()])
    assert made.data.metrics["train/epoch_s"] > 0 and made.data.params["loss._target_"] == "straight.Straight"
