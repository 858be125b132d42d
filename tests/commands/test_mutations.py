"""Spoilt datasets and models end in a solution or in one line: no traceback, no hang, nothing left behind.

Here a few of them; ``python -m pytest -m mutations tests/commands/test_mutations.py`` tries them all, some minutes.
"""

from __future__ import annotations

import shutil
import signal
import traceback
from collections.abc import Callable
from pathlib import Path

import pytest

from dlkf.filters.learned import LearnedConfig, LearnedFilter
from dlkf.filters.saved import save_filter
from tests.commands.mutations import mutate_dataset, mutate_model
from tests.shell import Ended

LONGEST_S = 120
SOLVE = ("navigate", "dataset=town", "out=made", "rate_hz=10")
DATASETS, MODELS = 500, 60


@pytest.fixture
def small_model(tmp_path) -> Path:
    network = {"lstm_hidden": 8, "lstm_layers": 1, "dense": [8, 8], "cnn_channels": 4}
    card = {"datasets": {"town": "0" * 32}, "imus": ["consumer"], "trained_on": ["a"], "chosen_on": []}
    model = LearnedFilter(LearnedConfig.from_mapping({"network": network, "rate_hz": 10.0}))
    save_filter(model, tmp_path / "sound", card)
    return tmp_path / "sound"


class Hang(BaseException):
    """Longer than anybody waits."""


def trial(call: Callable[..., Ended], *words: str) -> str:
    """What is wrong with how a command ended; empty where nothing is."""

    def wake(*_: object) -> None:
        raise Hang

    before = signal.signal(signal.SIGALRM, wake)
    signal.alarm(LONGEST_S)
    try:
        ended = call(*words)
    except Hang as error:
        return "hang at " + str(traceback.extract_tb(error.__traceback__)[-1])
    except BaseException as error:
        at = traceback.extract_tb(error.__traceback__)[-1]
        return f"traceback {type(error).__name__}: {error!s:.80} at {at.filename}:{at.lineno}"
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
    left = [p.name for p in Path().iterdir() if p.name.startswith(".") or p.name in ("pwned", "x")]
    if left or (ended.code and Path("made").exists()):
        return f"left behind: {left or 'made'}"
    said = [line for line in ended.err.splitlines() if line.startswith("dlkf: error: ")]
    if ended.code not in (0, 2) or (ended.code == 2 and (len(said) != 1 or len(said[0]) > 700)):
        return f"exit code {ended.code}, {ended.err[-300:]}"
    return ""


def tried_datasets(seeds: range, town: Path, call: Callable[..., Ended]) -> list[str]:
    wrong = []
    for seed in seeds:
        for folder in ("town", "made"):
            shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(town, "town")
        what = mutate_dataset(Path("town"), seed)
        model = "plus" if seed % 5 == 4 else "mbkf15"
        if fault := trial(call, *SOLVE, f"model={model}", *(["export=all"] if seed % 3 == 0 else [])):
            wrong.append(f"{seed}: {what}: {fault}")
            print(wrong[-1], flush=True)
    return wrong


def tried_models(seeds: range, town: Path, sound: Path, call: Callable[..., Ended]) -> list[str]:
    wrong = []
    for seed in seeds:
        for folder in ("town", "made", "mine"):
            shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(town, "town")
        shutil.copytree(sound, "mine")
        what = mutate_model(Path("mine"), seed)
        if fault := trial(call, *SOLVE, "model=mine"):
            wrong.append(f"{seed}: {what}: {fault}")
            print(wrong[-1], flush=True)
    return wrong


@pytest.mark.whole
@pytest.mark.filterwarnings("ignore")
def test_some_spoilt_datasets(town, call):
    assert tried_datasets(range(0, DATASETS, DATASETS // 5), town, call) == []


@pytest.mark.whole
@pytest.mark.filterwarnings("ignore")
def test_some_spoilt_models(town, small_model, call):
    assert tried_models(range(0, MODELS, MODELS // 10), town, small_model, call) == []


@pytest.mark.mutations
@pytest.mark.filterwarnings("ignore")
def test_spoilt_datasets(town, call):
    assert tried_datasets(range(DATASETS), town, call) == []


@pytest.mark.mutations
@pytest.mark.filterwarnings("ignore")
def test_spoilt_models(town, small_model, call):
    assert tried_models(range(MODELS), town, small_model, call) == []
