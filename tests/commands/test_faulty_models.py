"""Models that do not load: exit code 2, one line on stderr that says why, and no pickle is read."""

from __future__ import annotations

import pickle
from pathlib import Path

import pyarrow.parquet as pq
import pytest
import torch
import yaml

from dlkf.filters.learned import LearnedConfig, LearnedFilter
from dlkf.filters.saved import save_filter
from tests.commands.refusals import DRIVE, FAST, is_refused


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
