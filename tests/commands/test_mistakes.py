"""Whatever a user gets wrong: exit code 2, one line on stderr that says what and where, nothing half-written."""

from __future__ import annotations

import pickle
import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import lightning as L
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import torch
import yaml

from dlkf.command.faults import fault
from dlkf.data.schema import drive_file
from dlkf.filters.learned import LearnedConfig, LearnedFilter
from dlkf.filters.saved import save_filter
from dlkf.tracking import runs
from tests.shell import in_shell

DRIVE = "town-3-00001"  # the second of two: nothing of the first may be written either
FAST = {
    "evaluate": (
        "rate_hz=10",
        "length_s=60",
        "outage.first_s=20",
        "outage.duration_s=20",
        "injected_bias=null",
    ),
    "navigate": ("rate_hz=10",),
}


def change(kind: str, edit: Callable[[pd.DataFrame], pd.DataFrame | None]) -> Callable[[Path], None]:
    """A fault that edits one table of one drive."""

    def apply(folder: Path) -> None:
        path = drive_file(folder, kind, DRIVE)
        table = pd.read_parquet(path, partitioning=None)
        edited = edit(table)
        (table if edited is None else edited).to_parquet(path, index=False)

    return apply


def put(column: str, row: int, value: float) -> Callable[[pd.DataFrame], None]:
    def edit(table: pd.DataFrame) -> None:
        table.loc[row, column] = value

    return edit


def scale(prefix: str, factor: float) -> Callable[[pd.DataFrame], None]:
    def edit(table: pd.DataFrame) -> None:
        columns = [c for c in table if c.startswith(prefix)]
        table[columns] *= factor

    return edit


def swapped(table: pd.DataFrame) -> None:
    table[["lat_deg", "lon_deg"]] = table[["lon_deg", "lat_deg"]].to_numpy()


def as_text(table: pd.DataFrame) -> None:
    table["accel_x"] = table["accel_x"].map("{:.3f}".format)


def back_in_time(table: pd.DataFrame) -> None:
    table.loc[500:, "t"] -= 1.0


def twice(table: pd.DataFrame) -> pd.DataFrame:
    return table.iloc[[*range(500), *range(499, len(table))]]


def no_fix(table: pd.DataFrame) -> None:
    table["quality"] = np.int8(0)


def truncated(folder: Path) -> None:
    path = drive_file(folder, "imu", DRIVE)
    path.write_bytes(path.read_bytes()[:-1000])


def no_bytes(folder: Path) -> None:
    drive_file(folder, "imu", DRIVE).write_bytes(b"")


def drop(*parts: str) -> Callable[[Path], None]:
    """A fault: a file or folder that is not there."""

    def apply(folder: Path) -> None:
        path = folder.joinpath(*parts)
        shutil.rmtree(path) if path.is_dir() else path.unlink()

    return apply


FAULTS: dict[str, tuple[Callable[[Path], None], tuple[str, ...]]] = {
    "no drives.parquet": (drop("drives.parquet"), ("drives.parquet is missing",)),
    "no IMU folder": (drop("imu", f"drive={DRIVE}"), (DRIVE, "imu")),
    "no GNSS folder": (drop("gnss", f"drive={DRIVE}"), (DRIVE, "no GNSS")),
    "missing column": (change("imu", lambda t: t.drop(columns="gyro_y")), (DRIVE, "gyro_y missing")),
    "missing GNSS column": (change("gnss", lambda t: t.drop(columns="vel_e")), (DRIVE, "vel_e missing")),
    "wrong type": (change("imu", as_text), (DRIVE, "accel_x", "must be double")),
    "NaN in the IMU": (change("imu", put("gyro_z", 700, np.nan)), (DRIVE, "row 700", "gyro_z")),
    "infinite IMU": (change("imu", put("accel_y", 700, np.inf)), (DRIVE, "row 700", "accel_y")),
    "infinite position": (change("gnss", put("height_m", 7, np.inf)), (DRIVE, "row 7", "height_m")),
    "time goes back": (change("imu", back_in_time), (DRIVE, "row 500", "goes back")),
    "time of GNSS goes back": (change("gnss", put("t", 9, 3.0)), (DRIVE, "gnss", "row 9")),
    "duplicate stamps": (change("imu", twice), (DRIVE, "row 500", "twice")),
    "gap": (change("imu", lambda t: t.drop(index=range(800, 900))), (DRIVE, "row 800", "gap of 2.0")),
    "no rows": (change("imu", lambda t: t.iloc[:0]), (DRIVE, "no rows")),
    "no GNSS rows": (change("gnss", lambda t: t.iloc[:0]), (DRIVE, "gnss", "no rows")),
    "empty file": (no_bytes, (DRIVE, "not a whole Parquet file")),
    "truncated file": (truncated, (DRIVE, "not a whole Parquet file")),
    "gyro in degrees": (change("imu", scale("gyro_", 180 / np.pi)), (DRIVE, "degrees")),
    "position in radians": (change("gnss", scale("l", np.pi / 180)), (DRIVE, "radians")),
    "accelerations in g": (change("imu", scale("accel_", 1 / 9.80665)), (DRIVE, "looks like g", "9.80665")),
    "latitude and longitude swapped": (change("gnss", swapped), (DRIVE, "swapped")),
    "no fix at all": (change("gnss", no_fix), (DRIVE, "no GNSS fix")),
    "another clock": (change("gnss", lambda t: t.assign(t=t["t"] + 1e6)), (DRIVE, "same clock")),
}
REFERENCE_FAULTS = {
    "attitude in degrees": (change("reference", scale("yaw", 180 / np.pi)), (DRIVE, "yaw", "degrees")),
    "reference time goes back": (change("reference", put("t", 9, 0.2)), (DRIVE, "reference", "row 9")),
    "reference without a column": (change("reference", lambda t: t.drop(columns="roll")), ("roll missing",)),
}


def is_refused(ended, *said: str, folder: Path) -> None:
    assert ended.code == 2, ended
    lines = ended.err.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("dlkf: error: "), ended.err
    assert len(lines[0]) < 500
    for text in said:
        assert text in lines[0], lines[0]
    left = [path.name for path in folder.iterdir() if path.name not in ("town", "mine", "logs")]
    assert left == [], f"left behind: {left}"


@pytest.fixture
def copy(town, tmp_path) -> Path:
    return Path(shutil.copytree(town, tmp_path / "town"))


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("command", FAST)
def test_faulty_data(command, fault, copy, call, tmp_path):
    spoil, said = FAULTS[fault]
    spoil(copy)
    done = call(command, "model=mbkf15", "dataset=town", "out=made/here", *FAST[command])
    is_refused(done, *said, folder=tmp_path)


@pytest.mark.parametrize("fault", REFERENCE_FAULTS)
def test_a_faulty_reference_stops_evaluate_and_not_navigate(fault, copy, call, tmp_path):
    spoil, said = REFERENCE_FAULTS[fault]
    spoil(copy)
    is_refused(call("evaluate", "model=ins", "dataset=town", "out=made", *FAST["evaluate"]), *said, folder=tmp_path)
    done = call("navigate", "model=ins", "dataset=town", "out=made", *FAST["navigate"])
    assert done.code == 0, done.err


@pytest.mark.parametrize("command", FAST)
@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["model=mbkf15", "dataset=nowhere"], ("nowhere", "no such folder")),
        (["model=mbkf16", "dataset=town"], ("unknown model 'mbkf16'", "mbkf15")),
        (["model=mbkf15_prior", "dataset=town"], ("prior.mean",)),
        (["model=mbkf15", "dataset=town", "imu=best"], ("imu/best", "consumer")),
        (["model=mbkf15", "dataset=town", "speed=1"], ("unknown config key 'speed'",)),
        (["model=mbkf15", "dataset=town", "tuning.fun=2"], ("unknown config key 'tuning.fun'",)),
        (["model=mbkf15", "dataset=town", "imu.gyro.noise_density=-1"], ("noise_density", "-1")),
        (["model=mbkf15", "dataset=town", "imu.gyro.noise_density=low"], ("noise_density", "'low'")),
        (["model=mbkf15", "dataset=town", "rate_hz=0"], ("rate_hz",)),
        (["model=mbkf15", "dataset=town", "drives=[nobody]"], ("nobody",)),
        (["model=mbkf15", "dataset=town", "drives=[]"], ("drives", "null")),
        (["model=mbkf15", "dataset=town", "drives=[car-00,car-00]"], ("car-00", "twice")),
        (["model=mbkf15", "dataset"], ("dataset",)),
        (["model=mbkf15"], ("dataset is missing",)),
        (["dataset=town"], ("model is missing",)),
    ],
    ids=lambda x: " ".join(x),
)
def test_wrong_arguments(command, arguments, said, copy, call, tmp_path):
    done = call(command, *arguments, "out=made")
    is_refused(done, *said, folder=tmp_path)


@pytest.fixture
def model(tmp_path) -> Path:
    """A saved filter, small."""
    network = {"lstm_hidden": 8, "lstm_layers": 1, "dense": [8, 8], "cnn_channels": 4}
    folder = tmp_path / "mine"
    save_filter(LearnedFilter(LearnedConfig.from_mapping({"network": network, "rate_hz": 10.0})), folder)
    return folder


def other_width(model: Path) -> None:
    config = yaml.safe_load((model / "config.yaml").read_text())
    config["network"]["lstm_hidden"] = 16
    (model / "config.yaml").write_text(yaml.safe_dump(config))


def other_key(model: Path) -> None:
    config = yaml.safe_load((model / "config.yaml").read_text())
    (model / "config.yaml").write_text(yaml.safe_dump(config | {"colour": "red"}))


def as_pickle(model: Path) -> None:
    torch.save({"weight": torch.zeros(3)}, model / "weights.safetensors")


class Trap:
    """A pickle that would make a folder if anybody loaded it."""

    def __reduce__(self):
        return (Path.mkdir, (Path("pwned"),))


def as_trap(model: Path) -> None:
    (model / "weights.safetensors").write_bytes(pickle.dumps(Trap()))


BROKEN = {
    "other width": (other_width, ("does not fit config.yaml", "in the config")),
    "unknown key": (other_key, ("unknown key colour",)),
    "torch pickle": (as_pickle, ("not a safetensors file",)),
    "trap": (as_trap, ("not a safetensors file",)),
    "no weights": (lambda m: (m / "weights.safetensors").unlink(), ("has no weights.safetensors",)),
    "no config": (lambda m: (m / "config.yaml").unlink(), ("has no config.yaml",)),
    "empty config": (lambda m: (m / "config.yaml").write_text(""), ("holds no settings",)),
    "not YAML": (lambda m: (m / "config.yaml").write_text("a: [1"), ("not readable YAML",)),
    "no network": (lambda m: (m / "config.yaml").write_text("network: 3"), ("model.network is 3",)),
    "a word for a number": (
        lambda m: (m / "config.yaml").write_text("network: {lstm_hidden: many}"),
        ("lstm_hidden is 'many'",),
    ),
    "half weights": (
        lambda m: (m / "weights.safetensors").write_bytes((m / "weights.safetensors").read_bytes()[:-9]),
        ("not a safetensors file",),
    ),
}


@pytest.mark.parametrize("fault", BROKEN)
@pytest.mark.parametrize("command", FAST)
def test_a_model_that_does_not_load(command, fault, model, copy, call, tmp_path):
    spoil, said = BROKEN[fault]
    spoil(model)
    done = call(command, "model=mine", "dataset=town", "out=made", *FAST[command])
    is_refused(done, *said, folder=tmp_path)
    assert not (tmp_path / "pwned").exists()


@pytest.mark.parametrize("command", FAST)
def test_a_pickle_as_model(command, copy, call, tmp_path):
    (tmp_path / "mine").mkdir()
    torch.save({}, tmp_path / "mine" / "model.pt")
    done = call(command, "model=mine/model.pt", "dataset=town", "out=made")
    is_refused(done, "pickles are not read", folder=tmp_path)


@pytest.mark.parametrize("command", FAST)
def test_another_rate_than_the_models(command, model, copy, call, tmp_path):
    done = call(command, "model=mine", "dataset=town", "out=made", *FAST[command], "rate_hz=20")
    is_refused(done, "leave rate_hz and epoch_s to the model", folder=tmp_path)


def test_a_sound_model_runs(model, copy, call, tmp_path):
    """The same files and arguments as above, unspoilt."""
    done = call("navigate", "model=mine", "dataset=town", "out=made", *FAST["navigate"])
    assert done.code == 0, done.err
    assert pq.read_table(tmp_path / "made" / f"drive={DRIVE}" / "solution.parquet").num_rows > 60


@pytest.mark.parametrize(
    ("command", "arguments", "said"),
    [
        ("simulate", ["dataset=mars"], "simulated/mars"),
        ("simulate", ["dataset.hours=-1", "out=made"], "hours"),
        ("simulate", ["dataset.vehicle.colour=red", "out=made"], "dataset.vehicle.colour"),
        ("simulate", ["out=town"], "exists already"),
        ("ingest", ["source=nowhere", "out=made"], "nowhere"),
        ("ingest", ["reader=tape", "source=town", "out=made"], "reader/tape"),
    ],
)
def test_of_making_data(command, arguments, said, copy, call, tmp_path):
    is_refused(call(command, *arguments), said, folder=tmp_path)


@pytest.mark.parametrize(
    ("command", "arguments", "said"),
    [
        (
            "evaluate",
            ["model=mbkf15", "dataset=town", "colour=red", "out=made"],
            "unknown config key 'colour'",
        ),
        ("navigate", ["model=mbkf15", "dataset=town", "out=made", "rate_hz=10"], "gyro_z"),
    ],
)
def test_in_a_shell(command, arguments, said, copy, tmp_path):
    FAULTS["NaN in the IMU"][0](copy)
    is_refused(in_shell(tmp_path, command, *arguments), said, folder=tmp_path)


SCORED = ("model=mbkf15", "dataset=town", "out=made", *FAST["evaluate"])
SOLVED = ("model=mbkf15", "dataset=town", "out=made", *FAST["navigate"])
NOWHERE = "tracking.uri=sqlite:///nowhere.db"
TRAINED = ("data=drives", "data.datasets=[town]")
OF_ALL_COMMANDS: dict[str, tuple[str, tuple[str, ...], str]] = {
    "a word for a seed": ("evaluate", (*SCORED, "seed=abc"), "seed is 'abc', must be a whole number"),
    "a seed below zero": ("evaluate", (*SCORED, "seed=-1"), "seed is -1, must be a whole number ≥ 0"),
    "roads of a seed below zero": ("simulate", ("seed=-3", "out=made"), "seed is -3"),
    "a test of a seed below zero": ("train", (*TRAINED, "scoring.seed=-3"), "scoring.seed is -3"),
    "a score before the start": ("evaluate", (*SCORED, "settle_s=-5"), "settle_s is -5, must be 0 or more"),
    "a test before the start": (
        "train",
        (*TRAINED, "scoring.settle_s=-5"),
        "scoring.settle_s is -5, must be 0 or more",
    ),
    "a consistency before the start": (
        "consistency",
        ("model=mbkf15", "out=made", "settle_s=-5"),
        "settle_s is -5, must",
    ),
    "a strategy that is none": (
        "train",
        (*TRAINED, "trainer.devices=2", "trainer.strategy=fsdp"),
        "trainer.strategy is 'fsdp', must be",
    ),
    "a key too many": ("evaluate", (*SCORED, "+colour=red"), "unknown config key 'colour'"),
    "a key too many in a section": ("navigate", (*SOLVED, "+align.colour=red"), "align: unknown key colour"),
    "a key too many beside the store": ("navigate", (*SOLVED, "+tracking.colour=red"), "tracking: unknown key colour"),
    "a key too many of a training": ("train", (*TRAINED, "++colour=red"), "unknown config key 'colour'"),
    "a key too many of the data": ("train", (*TRAINED, "+data.colour=red"), "takes no colour"),
    "a preset that the command does not take": ("ingest", ("+tuning=untuned", "source=x", "out=made"), "key 'tuning'"),
    "a word for a length": ("evaluate", (*SCORED, "length_s=long"), "length_s is 'long', must be a number"),
    "a word for a switch": ("evaluate", (*SCORED, "overwrite=maybe"), "overwrite is 'maybe', must be true or false"),
    "a baseline that nobody knows": ("evaluate", (*SCORED, "baseline=foo"), "baseline=foo is none of the models"),
    "a reference that nobody knows": ("evaluate", (*SCORED, "reference=best"), "reference=best is none of file"),
    "an outage of a word": ("evaluate", (*SCORED, "outage.first_s=soon"), "outage.first_s is 'soon'"),
    "a folder as store": ("evaluate", (*SCORED, "tracking.uri=runs"), "is a plain folder"),
    "a piece longer than the drives": ("evaluate", (*SCORED, "mode=pieces", "length_s=1e4"), "no piece of 10000 s"),
    "an outage longer than a piece": ("evaluate", (*SCORED, "length_s=30"), "after 40 s but pieces are 30 s"),
    "an outage after the end": (
        "evaluate",
        (*SCORED, "mode=drives", "outage.first_s=900", "outage.duration_s=20"),
        "no outage fits into these drives: outage.first_s=900",
    ),
    "a drive that is not there": ("evaluate", (*SCORED, "drives=nobody"), "no drive nobody"),
    "an export that nobody knows": ("navigate", (*SOLVED, "export=[kml,shp]"), "export=shp: unknown format"),
    "a clock that nobody knows": ("navigate", (*SOLVED, "export_clock=tai"), "export_clock=tai is none of auto"),
    "several models to navigate": ("navigate", (*SOLVED, "model=[ins,mbkf15]"), "one model at a time"),
    "a smoother in a stream": ("navigate", (*SOLVED, "smoother=rts", "streaming=true"), "smoother or streaming"),
    "a smoother of ins": ("navigate", ("model=ins", *SOLVED[1:], "smoother=rts"), "needs a filter with a covariance"),
    "an epoch of no whole samples": ("navigate", (*SOLVED, "epoch_s=0.33"), "whole number of samples"),
    "an unknown alias": ("navigate", ("model=models:/town@champion", *SOLVED[1:], NOWHERE), "no MLflow store"),
    "an alias that MLflow refuses": ("train", (*TRAINED, "tracking.alias=latest"), "neither latest nor v<number>"),
    "a name that MLflow refuses": ("train", (*TRAINED, "tracking.register=a/b"), "has none of / : @"),
    "a rate of letters": ("train", (*TRAINED, "optimizer.lr=fast"), "optimizer.lr is 'fast', must be a number"),
    "no data to train on": ("train", ("data=drives", "data.datasets=[nowhere]"), "no such folder"),
    "too few recordings": ("train", TRAINED, "group"),
    "a batch of nothing": ("train", (*TRAINED, "data.batch_size=0"), "batch_size"),
    "a filter without noise": ("tune", ("model=ins", "dataset=town", "out=made"), "no noise to tune"),
    "an objective that nobody knows": ("tune", ("model=mbkf15", "dataset=town", "out=made", "objective=q"), "none of"),
    "a name that is no file's": ("tune", ("model=mbkf15", "dataset=town", "out=made", "name=a/b"), "letters, digits"),
    "no run to register": ("register", ("run=" + "0" * 32, "name=town", NOWHERE), "no MLflow store"),
    "no name to register": ("register", ("run=" + "0" * 32,), "name is missing"),
    "one report alone": ("compare", ("runs=[town]", "out=made"), "at least two"),
    "no report at all": ("compare", ("town", "logs", "out=made"), "no metrics.json"),
    "a doctor without a patient": ("doctor", ("dataset=nowhere",), "no such folder"),
    "a moving bench": ("allan", ("dataset=town", "out=made", f"drive={DRIVE}"), DRIVE),
    "an allan of nobody": ("allan", ("dataset=town", "out=made", "drive=nobody"), "nobody"),
    "a consistency of nothing": ("consistency", ("model=[]", "out=made"), "empty list"),
    "a consistency without noise": ("consistency", ("model=ins", "out=made"), "ins"),
    "a simulation of nothing": ("simulate", ("dataset.hours=0", "out=made"), "hours"),
    "an export of nobody": ("export", ("model=mbkf99", "out=made"), "unknown model 'mbkf99'"),
    "an export that looks ahead": ("export", ("model=mbkf21_rts", "out=made"), "looks ahead"),
    "an export of several": ("export", ("model=[ins,mbkf15]", "out=made"), "unknown model"),
    "an export without a rate": ("export", ("model=mbkf15", "out=made", "rate_hz=0"), "rate_hz is 0, must be above 0"),
    "an export back in time": ("export", ("model=mbkf15", "out=made", "epoch_s=-1"), "epoch_s is -1, must be above 0"),
    "an export of a third": ("export", ("model=mbkf15", "out=made", "epoch_s=0.33"), "whole number of samples"),
    "an export checked nowhere": ("export", ("model=mbkf15", "out=made", "dataset=nowhere"), "no such folder"),
    "an export checked on nobody": (
        "export",
        ("model=mbkf15", "out=made", "dataset=town", "drive=nobody"),
        "no drive nobody",
    ),
    "an export over data": ("export", ("model=mbkf15", "out=town"), "out=town exists already"),
    "an export of a word": ("export", ("model=mbkf15", "out=made", "latency=maybe"), "latency is 'maybe'"),
    "compiled, perhaps": ("navigate", (*SOLVED, "compiled=maybe"), "compiled is 'maybe', must be true or false"),
    "compiled and smoothed": ("navigate", (*SOLVED, "compiled=true", "smoother=rts"), "leave compiled=true out"),
    "compiled smoother": ("navigate", ("model=mbkf15_rts", *SOLVED[1:], "compiled=true"), "leave compiled=true out"),
    "noise of a network": ("navigate", ("model=plus", "dataset=town", "out=made", "imu=auto"), "takes none"),
    "noise of no filter": (
        "tune",
        ("model=plus", "dataset=town", "out=made", "objective=likelihood"),
        "no noise to tune",
    ),
    "noise in no time": (
        "tune",
        ("model=mbkf21", "dataset=town", "out=made", "objective=likelihood", "minutes=0"),
        "minutes is 0",
    ),
    "factors in no rounds": ("tune", ("model=mbkf21", "dataset=town", "out=made", "rounds=0"), "rounds is 0, must be"),
    "factors of no pieces": ("tune", ("model=mbkf21", "dataset=town", "out=made", "pieces=-2"), "pieces is -2, must"),
    "a consistency of no drives": ("consistency", ("model=mbkf15", "out=made", "drives=0"), "drives is 0, must be"),
    "a consistency of no time": ("consistency", ("model=mbkf15", "out=made", "minutes=-1"), "minutes is -1, must be"),
    "noise in few minutes": (
        "tune",
        ("model=mbkf21", "dataset=town", "out=made", "objective=likelihood", "minutes=few"),
        "minutes is 'few'",
    ),
    "a lever arm of one number": ("ingest", ("reader.lever_arm_m=0.5", "source=logs", "out=made"), "lever_arm_m"),
}


@pytest.mark.parametrize("name", OF_ALL_COMMANDS)
def test_of_all_commands(name, copy, call, tmp_path):
    command, arguments, said = OF_ALL_COMMANDS[name]
    (tmp_path / "logs").mkdir()
    is_refused(call(command, *arguments), said, folder=tmp_path)


@pytest.mark.parametrize("lock", ["IMMEDIATE", "EXCLUSIVE"])
@pytest.mark.parametrize(
    "given",
    [
        ("evaluate", *SCORED),
        ("train", *TRAINED),
        ("register", "run=" + "0" * 32, "name=town"),
        ("evaluate", "-m", *SCORED, "model=ins,mbkf15"),
    ],
    ids=["evaluate", "train", "register", "sweep"],
)
def test_a_locked_store_is_told_before_any_work(given, lock, copy, call, tmp_path, monkeypatch):
    """By another program that writes, as long as the command waits; and nothing was begun."""
    monkeypatch.setattr(runs, "LOCKED_S", 0.2)
    kept = tmp_path / "logs"
    kept.mkdir()
    store = kept / "store.db"
    with closing(sqlite3.connect(store)) as other:
        other.executescript(f"CREATE TABLE t (x); BEGIN {lock}")
        ended = call(*given, f"tracking.uri=sqlite:///{store}")
    is_refused(ended, "store.db is locked by another program", folder=tmp_path)


@pytest.mark.parametrize("command", FAST)
def test_an_older_result_is_not_written_over(command, copy, call, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "report.html").write_text("of last week")
    done = call(command, "model=ins", "dataset=town", "out=mine", *FAST[command])
    is_refused(done, "out=mine exists already", "overwrite=true", folder=tmp_path)
    assert (tmp_path / "mine" / "report.html").read_text() == "of last week"


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (OSError(28, "No space left on device", "/data/x"), "the disk is full"),
        (PermissionError(13, "Permission denied", "/data/x"), "/data/x: permission denied"),
        (OSError(30, "Read-only file system", "/data/x"), "read-only"),
        (RuntimeError("(sqlite3.OperationalError) database is locked"), "locked by another program"),
        (RuntimeError("attempt to write a readonly database"), "cannot be written"),
        (RuntimeError("file is not a database"), "damaged"),
        (RuntimeError("Detected out-of-date database schema (found version a, but expected b)"), "another version"),
        (RuntimeError("No supported gpu backend found!"), "trainer.accelerator=cpu"),
        (RuntimeError("CUDA out of memory. Tried to allocate 2 GiB"), "smaller data.batch_size"),
    ],
)
def test_faults_of_the_machine_are_one_line(error, said):
    """Also from deep inside: what was raised is found in the chain of what it became."""
    try:
        try:
            raise error
        except Exception as inner:
            raise ValueError("Error in call to target") from inner
    except ValueError as outer:
        line = fault(outer)
    assert line is not None and said in line and "\n" not in line
    assert fault(ValueError("a fault of ours")) is None


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU here")
@pytest.mark.parametrize(("accelerator", "said"), [("gpu", "there is no GPU"), ("tpux", "accelerator is unknown")])
def test_a_gpu_that_is_not_there_is_one_line(accelerator, said):
    """Whatever words this version of Lightning finds for it; ``auto`` takes the CPU instead."""
    settings = {"devices": 1, "logger": False, "enable_checkpointing": False, "enable_progress_bar": False}
    with pytest.raises(Exception) as raised:
        L.Trainer(accelerator=accelerator, **settings)
    line = fault(raised.value)
    assert line is not None and said in line and "\n" not in line
    assert L.Trainer(accelerator="auto", **settings).strategy.root_device.type == "cpu"


@pytest.mark.parametrize(
    ("command", "arguments"),
    [("export", ("model=mbkf15", "out=made", "dataset=town")), ("navigate", (*SOLVED, "compiled=true"))],
    ids=["export", "compiled step"],
)
def test_without_a_c_compiler(command, arguments, copy, call, tmp_path, monkeypatch):
    """A filter is exported unchecked, and says so; a compiled step cannot be made."""
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "logs"))
    ended = call(command, *arguments)
    if command == "navigate":
        is_refused(ended, "no C compiler found", folder=tmp_path)
    else:
        assert ended.code == 0 and "not checked: no C compiler here" in ended.out, ended.err


def test_what_was_said_lies_beside_the_report(copy, call, tmp_path):
    """The answer, the tables, the drives, as they stood on the screen."""
    for command in FAST:
        ended = call(command, "model=mbkf15", "dataset=town", f"out={command}", *FAST[command])
        assert ended.code == 0, ended.err
        said = (tmp_path / command / "log.txt").read_text().splitlines()
        assert len(said) > 3 and set(said) <= set(ended.out.splitlines())


def test_a_point_that_fails_leaves_the_others(copy, call, tmp_path):
    """It is named, twice: when it fails and at the end; the others have their folders and the page beside them."""
    points = ("model=ins,mbkf99,mbkf15", "tracking.log=false")
    done = call("evaluate", "-m", *points, "dataset=town", "out=made", *FAST["evaluate"])
    assert done.code == 2, done.err
    lines = [line for line in done.err.splitlines() if line.startswith("dlkf: error: ")]
    assert lines[0].startswith("dlkf: error: model=mbkf99: unknown model 'mbkf99'")
    assert lines[1] == "dlkf: error: 1 of the points failed: model=mbkf99"
    assert {p.name for p in (tmp_path / "made").iterdir()} == {"0-model=ins", "2-model=mbkf15", "compare.html"}
