"""The same training on two processes: ``trainer.devices=2``, nothing else changed."""

import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from dlkf.base.errors import InputError
from dlkf.evaluation.metrics import end_errors
from dlkf.filters.integration import integrate
from dlkf.filters.saved import load_filter
from dlkf.training.fit import fit
from dlkf.training.processes import with_workers
from tests.numbers_in import numbers_in
from tests.shell import start_fork

from .test_resume import data, make_settings

EPOCHS = 2


def settings(devices: int):
    return make_settings(max_epochs=EPOCHS, validate_every=1, devices=devices)


def train(devices: int, dataset: Path, folder: Path) -> tuple[dict, Path]:
    """Last state and best weights; a further process is a fork: what a command would import anew is there."""

    def fit_here() -> Path:
        return fit(settings(devices), data(dataset), folder / "study", False, further=["along"])

    def fork(_, env):
        process = start_fork(folder, folder / "said", lambda: (os.environ.update(env), fit_here()))
        return SimpleNamespace(poll=lambda: process.exitcode, wait=process.join, kill=process.kill)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("dlkf.training.processes.subprocess", SimpleNamespace(Popen=fork))
        best = fit_here()
    return torch.load(folder / "study" / "last.ckpt", weights_only=True), best


@pytest.fixture(scope="module")
def trained(dataset, tmp_path_factory) -> list:
    """By one process and by two."""
    return [train(devices, dataset, tmp_path_factory.mktemp("run")) for devices in (1, 2)]


@pytest.mark.commands
def test_two_processes_learn_what_one_does(trained):
    """Averaged gradients are sums in another order: rounding, which the steps of two epochs spread a little."""
    (one, _), (two, _) = trained
    assert one["global_step"] == two["global_step"] >= EPOCHS
    for name, w in one["state_dict"].items():
        assert (w - two["state_dict"][name]).abs().max() <= 1e-5 * max(1.0, float(w.abs().max())), name
    states = [{k.partition("{")[0]: v for k, v in state["callbacks"].items()} for state in (one, two)]
    assert states[0]["BestWeights"]["epoch"] == states[1]["BestWeights"]["epoch"]
    assert states[0]["BestWeights"]["score"] == pytest.approx(states[1]["BestWeights"]["score"], rel=1e-5)
    for term, loss in states[0]["AdaptiveLossWeights"]["average"].items():  # losses of all epochs
        assert loss == pytest.approx(states[1]["AdaptiveLossWeights"]["average"][term], rel=1e-5)


def test_their_best_weights_score_alike(trained, dataset):
    (batch,) = data(dataset).batches("test")
    with torch.inference_mode():
        errors = [end_errors(batch, integrate(batch, load_filter(best)).posterior) for _, best in trained]
    assert np.allclose(*errors, rtol=1e-4) and len(errors[0])
    assert sorted(p.name for p in trained[0][1].parent.iterdir()) == sorted(
        p.name for p in trained[1][1].parent.iterdir()
    )


def test_a_further_process_that_fails_is_said():
    with pytest.raises(InputError, match="ended with code 3"), with_workers(("sh", "-c", "exit 3"), 2):
        raise AssertionError("the block must not begin")


SMALL = (
    "data.batch_size=5", "data.length_s=20", "data.eval_length_s=40", "model.network.dropout=0",
    "scoring.outage.first_s=10", "scoring.outage.duration_s=20",
    "model.network.lstm_hidden=16", "model.network.lstm_layers=1", "model.network.dense=[16,8]", "trainer.max_epochs=2",
    "trainer.validate_every=1", "trainer.best_from_epoch=0", "trainer.accelerator=cpu", "callbacks.curriculum=null",
    "callbacks.outage={start_epoch:0,duration_s:[3,6],before_s:5,after_s:2}", "baselines.models=[ins]",
    "baselines.tune=false", "baselines.segments=6", "seed=2",
)  # fmt: skip


@pytest.mark.commands
def test_the_command_on_two_processes_leaves_the_same_table(dataset, tmp_path):
    tables, losses = [], []
    for name, more in (("one", ()), ("two", ("trainer.devices=2",))):
        words = [sys.executable, "-m", "dlkf.train", f"name={name}", f"data.datasets=[{dataset}]", *SMALL, *more]
        done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr[-2000:]
        (report,) = (tmp_path / "outputs" / "train" / name).glob("*/report")
        tables.append(numbers_in(json.loads((report / "metrics.json").read_text())["results"]))
        state = torch.load(report.parent / "last.ckpt", weights_only=True)["callbacks"]
        average = next(v["average"] for k, v in state.items() if k.startswith("AdaptiveLossWeights"))
        losses.append([average[term] for term in sorted(average)])
    assert losses[0] == pytest.approx(losses[1], rel=1e-5)
    # a slope near zero is a difference of larger numbers, of which 5e-8 has been seen
    assert len(tables[0]) > 20 and tables[0] == pytest.approx(tables[1], rel=1e-5, abs=1e-7)
