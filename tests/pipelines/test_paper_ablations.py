"""A chain of trainings from its command to its table, and a second call that trains nothing again."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.cars import write_cars

ROOT = Path(__file__).parents[2]
SMALL = (
    "data.datasets=[town]", "data.fractions=[0.5,0.2,0.3]", "data.batch_size=3", "data.length_s=30",
    "data.eval_length_s=40", "data.eval_outage={first_s: 15, duration_s: 20}", "scoring.after_s=[]",
    "scoring.outage.first_s=15", "scoring.outage.duration_s=20", "callbacks.curriculum.full_s=30",
    "callbacks.curriculum.warm_until=0", "callbacks.curriculum.full_from=0", "trainer.max_epochs=1",
    "trainer.validate_every=1", "baselines.tune=false", "baselines.segments=3", "model.network.lstm_hidden=8",
    "model.network.lstm_layers=1", "model.network.dense=[8,8]",
)  # fmt: skip


def ablations(folder: Path, *words: str) -> subprocess.CompletedProcess:
    paths = {"PYTHONPATH": os.pathsep.join([str(ROOT / "src"), str(ROOT), os.environ.get("PYTHONPATH", "")])}
    command = [sys.executable, str(ROOT / "pipelines" / "paper_ablations.py"), *words]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, env=os.environ | paths)


@pytest.mark.commands
def test_rows_are_trained_once_and_end_in_a_table(template, tmp_path):
    shutil.copy(template, tmp_path / "mlflow.db")
    write_cars(tmp_path / "town", 5, seconds=90.0)
    first = ablations(tmp_path, "--rows", "base", *SMALL)
    assert first.returncode == 0, first.stdout + first.stderr
    home = tmp_path / "outputs" / "paper" / "ablations"
    (line,) = [x for x in (home / "ablations.md").read_text().splitlines() if x.startswith("| base | 0 |")]
    done = json.loads((home / "trainings.json").read_text())
    content = json.loads((tmp_path / done["base/0"] / "report" / "metrics.json").read_text())
    assert any(row[1] == "dlkf" for row in content["results"][0]["values"]["data"]) and len(line.split("|")) == 10
    again = ablations(tmp_path, "--rows", "base", *SMALL)
    assert again.returncode == 0 and "dlkf.train" not in again.stdout
    assert ablations(tmp_path, "--rows", "bse").returncode == 2
