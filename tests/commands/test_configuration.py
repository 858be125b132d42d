"""Every shipped configuration composes, and what it names can be built."""

from __future__ import annotations

from itertools import zip_longest
from pathlib import Path

import pytest

from dlkf.base.classes import find_class, instantiate
from dlkf.base.config import config_dir
from dlkf.base.settings import settings_from
from dlkf.command.composing import compose_command
from dlkf.command.scored import EvaluateSettings, TuneSettings
from dlkf.command.settings import (
    AllanSettings,
    CompareSettings,
    DoctorSettings,
    ExportSettings,
    FilterSettings,
    IngestSettings,
    NavigateSettings,
    RegisterSettings,
)
from dlkf.command.simulated import ConsistencySettings
from dlkf.filters.saved import build_learned_filter
from dlkf.simulation.dataset import SimulateSettings
from dlkf.training.settings import TrainSettings

CONF = config_dir()
GROUPS = {  # group of the defaults list: folder under conf/
    "simulate": {"imu": "imu", "receiver": "receiver", "sensors": "sensors", "simulated@dataset": "simulated"},
    "ingest": {"reader": "reader"},
    "evaluate": {"imu": "imu", "tuning": "tuning", "start": "start", "outage": "outage"},
    "navigate": {"imu": "imu", "tuning": "tuning"},
    "export": {"imu": "imu", "tuning": "tuning"},
    "allan": {"imu": "imu"},
    "register": {},
    "compare": {},
    "doctor": {},
    "tune": {"imu": "imu", "tuning": "tuning", "start": "start", "outage": "outage"},
    "consistency": {"imu": "imu", "tuning": "tuning", "chassis": "chassis", "start": "start", "outage": "outage"},
    "train": {
        "imu": "imu",
        "data": "data",
        "filter@model": "filter",
        "start@data.start": "start",
        "outage@scoring.outage": "outage",
    },
}
SETTINGS = {
    "simulate": SimulateSettings,
    "ingest": IngestSettings,
    "evaluate": EvaluateSettings,
    "navigate": NavigateSettings,
    "export": ExportSettings,
    "allan": AllanSettings,
    "register": RegisterSettings,
    "compare": CompareSettings,
    "doctor": DoctorSettings,
    "tune": TuneSettings,
    "consistency": ConsistencySettings,
    "train": TrainSettings,
}


def presets(folder: str) -> list[str]:
    """Those to choose from; what several share begins with an underscore."""
    return sorted(path.stem for path in (CONF / folder).glob("[!_]*.yaml"))


EXPERIMENTS = [
    [f"+experiment={experiment}", *profile]
    for experiment in presets("experiment")
    for profile in ([], *([f"+profile={name}"] for name in presets("profile")))
] + [["+experiment=kalman_gain", f"+noise={name}"] for name in presets("noise")]
ALL_IMUS = {"simulate", "evaluate"}  # the other commands read a preset of an IMU as evaluate does
SOME_IMUS = {"auto", "consumer", "perfect"}


def options(primary: str, groups: dict[str, str]) -> list[list[str]]:
    """What chooses presets for a command: every one of each group, groups side by side."""
    kept = {group: presets(folder) for group, folder in groups.items()}
    kept["imu"] = [x for x in kept.get("imu", ()) if x in SOME_IMUS or primary in ALL_IMUS]
    if primary != "navigate":  # which alone finds the noise
        kept["imu"] = [x for x in kept["imu"] if x != "auto"]
    words = [[f"{group}={name}" for name in names] for group, names in kept.items()]
    return [[], *([x for x in chosen if x] for chosen in zip_longest(*words))]


CASES = {primary: options(primary, groups) for primary, groups in GROUPS.items()}
for words in CASES["simulate"]:
    words += ["++dataset.imu_errors=wide"] * ("imu=wide" in words)
CASES["train +experiment"] = EXPERIMENTS
CASES["train filter and data"] = [  # profiles and noises set numbers only, other presets replace one node whole
    [f"{group}={name}", f"+experiment={experiment}"]
    for group in ("data", "filter@model")
    for name in presets(GROUPS["train"][group])
    for experiment in presets("experiment")
]


def test_all_folders_are_covered():
    """A new folder of presets must be added to GROUPS."""
    folders = {path.name for path in CONF.iterdir() if path.is_dir()}
    assert folders == {f for groups in GROUPS.values() for f in groups.values()} | {"experiment", "noise", "profile"}


@pytest.mark.parametrize(
    "name", [pytest.param(x, marks=[pytest.mark.commands] * x.startswith("train ")) for x in CASES]
)
def test_every_preset_composes_and_builds(name):
    wrong, primary = [], name.split()[0]
    for overrides in CASES[name]:
        try:
            compose_and_build(primary, overrides)
        except Exception as error:
            wrong.append(f"{primary} {' '.join(overrides)}: {type(error).__name__}: {error}")
    assert not wrong, "\n".join(wrong)


BUILT: set[str] = set()  # settings of networks


def compose_and_build(primary: str, overrides: list[str]) -> None:
    """Fails unless a command's configuration composes with these words and makes its settings."""
    config = compose_command(primary, *overrides)  # what a user must give stays a word, ???
    if primary == "train":
        config["baselines"]["models"] = ["mbkf15"]  # a study refuses the trained filter's name among them
    settings = settings_from(SETTINGS[primary], config, "")
    if isinstance(settings, FilterSettings):
        assert settings.spec.name == config["imu"]["name"]
    if isinstance(settings, ConsistencySettings):
        assert settings.matched.drives == 100
    if isinstance(settings, SimulateSettings):
        assert settings.recipe.dataset.name == config["dataset"]["name"]
    if isinstance(settings, IngestSettings):
        instantiate(settings.reader, "reader", ("read",))
    if isinstance(settings, TrainSettings):
        fit = settings.study.fit
        if (model := repr(fit.model)) not in BUILT:
            build_learned_filter(fit.model)
            BUILT.add(model)
        assert all(callback.state_dict() is not None for callback in fit.callbacks)
        find_class(settings.data["_target_"], "data._target_", ("setup", "describe"))


def test_every_callback_of_a_training_can_be_left_out():
    """Without the curriculum outages and the choice of weights begin at once."""
    for name in compose_command("train")["callbacks"]:
        config = compose_command("train", f"callbacks.{name}=null")
        start = 0 if name == "curriculum" else config["callbacks"]["curriculum"]["full_from"]
        assert config["trainer"]["best_from_epoch"] == start
        assert len(settings_from(TrainSettings, config, "").fit.callbacks) == len(config["callbacks"]) - 1


def test_no_file_is_another_s_twin():
    """What several presets share stands once, in one that they name in their defaults."""
    settings = {}
    for file in CONF.rglob("*.yaml"):
        kept = "\n".join(line for line in file.read_text().splitlines() if not line.startswith(("#", "name:")))
        assert not kept.strip() or settings.setdefault(kept, file) is file, f"{file} says what {settings[kept]} says"


def test_every_command_and_experiment_opens_with_its_command():
    silent = []
    for name in (*GROUPS, *(f"experiment/{name}" for name in presets("experiment"))):
        text = (CONF / f"{name}.yaml").read_text()
        lead = text[: text.index("\n", text.rindex("#   python") if "#   python" in text else 0)]
        command = "train" if "/" in name else name
        silent += [] if f"python -m dlkf.{command}" in lead else [name]
    assert not silent, silent


@pytest.mark.whole
def test_a_users_own_presets_are_found(tmp_path, call, town):
    """``--config-dir`` adds to every group of a command."""
    mine = tmp_path / "mine"
    for folder, text in {
        "imu": (CONF / "imu" / "consumer.yaml").read_text().replace("name: consumer", "name: mine"),
        "simulated": "defaults: [one_imu, _self_]\nname: mine\nhours: 0.01\n",
    }.items():
        (mine / folder).mkdir(parents=True)
        (mine / folder / "mine.yaml").write_text(text)
    done = call("simulate", "--config-dir", mine, "dataset=mine", "imu=mine")
    assert done.code == 0, done.err
    assert "data/mine: 0.01 h" in done.out and "IMU mine" in done.out
    assert Path("data/mine/drives.parquet").is_file()
    done = call("navigate", "--config-dir", mine, "model=mbkf15", "imu=mine", f"dataset={town}", "out=solved")
    assert done.code == 0, done.err
