"""A folder as a reader of the pages has it, and commands called in it without a new interpreter."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from dlkf.command.composing import compose_command
from tests.drives import drives_in
from tests.shell import Ended
from tests.worlds import Once

Run = Callable[[Sequence[str]], None]
# what makes a command small; an override that is not wanted stands later in the line than the page's own
SMALL = {
    "simulate": ["dataset.hours=0.03", "dataset.drive_minutes=0.6", "dataset.imu_rate_hz=50"],
    "evaluate": ["outage.first_s=10", "outage.duration_s=10", "length_s=25", "stride_s=25", "injected_bias=null"],
    "train": [
        "data.datasets=[data/consumer]", "data.fractions=[0.5,0.25,0.25]", "data.length_s=20", "data.eval_length_s=30",
        "data.eval_outage={first_s:10,duration_s:10}", "trainer.max_epochs=1", "trainer.validate_every=1",
        "trainer.best_from_epoch=0",
        "scoring.outage={first_s:10,duration_s:10}", "baselines.models=[mbkf15]", "baselines.tune=false",
        "baselines.segments=2", "scoring.after_s=[]", "scoring.hour=null",
        "callbacks.curriculum.warm_s=15", "callbacks.curriculum.full_s=20",
        "callbacks.outage.duration_s=[4,10]", "callbacks.outage.before_s=5",
        "model.network.lstm_hidden=8", "model.network.lstm_layers=1", "model.network.dense=[8,8]",
    ],
}  # fmt: skip


@pytest.fixture(scope="session")
def drives(once: Once) -> Path:
    """Five drives of 40 s, as ``simulate dataset=per_drive`` makes them."""
    size = ["dataset.hours=0.0555", "dataset.drive_minutes=0.67", "dataset.imu_rate_hz=50", "seed=3"]
    config = compose_command("simulate", "simulated@dataset=per_drive", *size)
    return once("consumer", lambda folder: drives_in(config, folder / "consumer")) / "consumer"


@pytest.fixture
def desk(drives: Path, uri: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder that one stands in: data/consumer, an empty store, Python files importable."""
    shutil.copytree(drives, tmp_path / "data" / "consumer")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", uri)  # MLflow sets it; so it becomes again what it was
    monkeypatch.syspath_prepend(str(tmp_path))
    return tmp_path


@pytest.fixture
def run(desk: Path, call: Callable[..., Ended]) -> Run:
    """Runs ``python -m dlkf.<command> …`` of a page, small; fails unless it ends well."""

    def ended_well(words: Sequence[str]) -> None:
        assert list(words[:2]) == ["python", "-m"], words
        command = words[2].removeprefix("dlkf.")
        small = SMALL.get(command, [])
        given = [w for w in words[3:] if not any(w.startswith(s.split("=")[0] + "=") for s in small)]
        ended = call(command, *given, *small)
        assert ended.code == 0, f"{' '.join(words)}: {ended.err}"

    return ended_well
