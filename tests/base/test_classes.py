"""What a name may stand for: a class with the methods of what it must be, checked before it is called."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
import torch

from dlkf.base.classes import find_class, instantiate
from dlkf.base.errors import InputError
from dlkf.command.composing import imu_preset
from dlkf.data.readers.logs import LogReader
from dlkf.filters.build import build_filter
from dlkf.filters.learned import LearnedConfig, LearnedFilter
from dlkf.tracking.models import resolve_model
from dlkf.training.callbacks.guard import StepGuard
from dlkf.training.loss import build_loss
from dlkf.training.optimization import OptimizationPlan
from dlkf.training.settings import CALLBACK

MADE = "made-by-a-stranger"  # a file that appears where one of these is called
STRANGERS = {
    "os.system": {"command": f"touch {MADE}"},
    "os:system": {"command": f"touch {MADE}"},
    "subprocess.Popen": {"args": ["touch", MADE]},
    "subprocess.getoutput": {"cmd": f"touch {MADE}"},
    "builtins.exec": {"source": f"open({MADE!r}, 'w')"},
    "io.FileIO": {"file": MADE, "mode": "w"},
    "zipfile.ZipFile": {"file": MADE, "mode": "w"},
    "posix.system": {"command": f"touch {MADE}"},
    "pathlib.Path": {},
    "pyarrow.OSFile": {"path": MADE, "mode": "w"},
    "dlkf.base.files.write_into": {"folder": MADE},
    "numpy.save": {"file": MADE, "arr": [1]},
    "torch.save": {"obj": [1], "f": MADE},
    "dlkf.base.files.subprocess": {},
    "os..system": {},
}
FIXED = {"lr": 1e-3, "head_lr_factor": 1.0, "weight_decay": 0.0}
IMU = imu_preset("consumer")
PLACES = {
    "reader": lambda values: instantiate(values, "reader", ("read",)),
    "callback": lambda values: instantiate(values, "callbacks.mine", CALLBACK),
    "loss": build_loss,
    "network": lambda values: LearnedFilter(LearnedConfig.from_mapping({"network": values})),
    "optimizer": lambda values: OptimizationPlan.of({**FIXED, **values}, {}).build([torch.nn.Parameter()], []),
    "schedule": lambda values: OptimizationPlan.of(FIXED, values).build([torch.nn.Parameter()], []),
    "model": lambda values: resolve_model(values["_target_"].replace(".", ":"), IMU),
    "source": lambda values: build_filter("mbkf15+" + values["_target_"].replace(".", ":"), IMU),
}


@pytest.mark.parametrize("place", PLACES)
def test_what_is_no_class_of_its_kind_is_refused_before_it_is_called(place, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(subprocess, "Popen", _never)
    through = []
    for name, arguments in STRANGERS.items():
        try:
            PLACES[place]({"_target_": name, **arguments})
        except InputError:
            continue
        through.append(name)
    assert through == [] and list(tmp_path.iterdir()) == []


class _never:
    def __init__(self, *_, **__):
        raise AssertionError("called")


def test_a_class_of_its_kind_is_found():
    assert find_class("dlkf.data.readers.logs.LogReader", "reader", ("read",)) is LogReader
    assert find_class("dlkf.training.callbacks.guard:StepGuard", "callbacks.guard", CALLBACK) is StepGuard


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("os.system", "reader=os.system is a part of Python"),
        ("nowhere.Reader", "No module named 'nowhere'; give module:Class"),
        ("dlkf.data.readers.logs.Nothing", "Nothing"),
        ("torch.nn.Identity", "has no read"),
        ("torch.save", "is no class of yours"),
    ],
)
def test_the_line_says_why(name, said):
    with pytest.raises(InputError, match=said):
        find_class(name, "reader", ("read",))


def test_a_reader_that_came_with_a_dataset_runs_nothing(tmp_path, call):
    """``ingest --config-dir data/town reader=found``, as docs/readers.md has it, on a dataset of somebody else."""
    (tmp_path / "town" / "reader").mkdir(parents=True)
    made = Path(MADE)
    for name, arguments in {
        "os.system": {"command": f"touch {MADE}"},
        "subprocess.Popen": {"args": ["touch", MADE]},
    }.items():
        values = {"_target_": name, **arguments}
        (tmp_path / "town" / "reader" / "found.yaml").write_text(str(values))
        ended = call("ingest", "--config-dir", "town", "reader=found", "source=.", "out=made")
        assert ended.code == 2 and "is a part of Python" in ended.err and len(ended.err.splitlines()) == 1, ended
    assert not made.exists()


HOOK = "# @package _global_\nhydra: {callbacks: {x: {_target_: pathlib.Path.touch, self: made-by-a-stranger}}}\n"


@pytest.mark.parametrize("text", [HOOK, "# @package hydra.callbacks\nx: {_target_: pathlib.Path.touch}\n"])
def test_a_preset_names_nothing_for_hydra_to_call(text, tmp_path, call):
    (tmp_path / "mine" / "reader").mkdir(parents=True)
    (tmp_path / "mine" / "reader" / "found.yaml").write_text(text)
    ended = call("ingest", "--config-dir", "mine", "reader=found", "source=.", "out=made")
    assert ended.code == 2 and "found.yaml: names a class or function for Hydra to call" in ended.err, ended
    assert len(ended.err.splitlines()) == 1 and not Path(MADE).exists()


@pytest.mark.parametrize(
    ("given", "text", "package"),
    [
        ("[hook]", HOOK, "reader"),
        ("[/reader/hook]", HOOK, "reader"),
        ("[{/imu: hook}]", HOOK, "imu"),
        ("[{override /hydra/callbacks: [none, hook]}]", "x: {_target_: pathlib.Path.touch}\n", "hydra/callbacks"),
        ("[{/imu@_global_.hydra.callbacks: hook}]", "x: {_target_: pathlib.Path.touch}\n", "imu"),
        ("[/imu/hook@_global_.hydra.callbacks]", "x: {_target_: pathlib.Path.touch}\n", "imu"),
    ],
)
def test_what_a_preset_takes_into_its_defaults_runs_nothing(given, text, package, tmp_path, call):
    for folder in ("reader", package):
        (tmp_path / "mine" / folder).mkdir(parents=True, exist_ok=True)
    (tmp_path / "mine" / "reader" / "found.yaml").write_text(f"defaults: {given}\n_target_: x.Reader\n")
    (tmp_path / "mine" / package / "hook.yaml").write_text(text)
    ended = call("ingest", "--config-dir", "mine", "reader=found", "source=.", "out=made")
    assert ended.code == 2 and "hook.yaml: names a class or function for Hydra to call" in ended.err, ended
    assert not Path(MADE).exists()
