"""Section 5.1 as the paper ran it: the words of the pipeline are settings of the commands, and mean what is said."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path

import pandas as pd
import pytest

from dlkf.command.composing import compose_command

SCRIPTS = Path(__file__).parents[2] / "pipelines"


@pytest.fixture
def script(monkeypatch, tmp_path):
    """The pipeline in a folder with a unit of known error; commands are composed, not run."""
    monkeypatch.syspath_prepend(SCRIPTS)
    import paper_imu_error
    import trainings

    monkeypatch.chdir(tmp_path)
    reference = tmp_path / "data" / "paper_clean" / "reference" / "drive=a"
    reference.mkdir(parents=True)
    names = [f"{sensor}_error_{axis}" for sensor in ("accel", "gyro") for axis in "xyz"]
    pd.DataFrame([range(1, 7)] * 2, columns=names, dtype=float).to_parquet(reference / "part-0.parquet")
    weights = tmp_path / "run" / "best"
    weights.mkdir(parents=True)
    (weights / "config.yaml").write_text("kind: dlkf\n")
    said: list[tuple[str, ...]] = []

    def run(*words: str) -> list[str]:
        said.append(words)
        for out in (Path(word.removeprefix("out=")) for word in words if word.startswith("out=")):
            out.mkdir(parents=True, exist_ok=True)
        return ["Report: run/report/report.html"]

    monkeypatch.setattr(trainings, "run", run)
    monkeypatch.setattr(paper_imu_error, "run", run)
    monkeypatch.setattr(trainings.Study, "parent", lambda *_: trainings.contextmanager(lambda: iter([None]))())
    return paper_imu_error, said


def composed(command: str, *words: str) -> dict:
    """What a command is given by these words, without a preset of one's own and without outages (outage=null)."""
    own = ("--config-dir", "tuning=published_start") if "--config-dir" in words else ()
    words = words[2:] if own else words
    return compose_command(command, *(word for word in words if word not in (*own, "outage=null")))


def test_the_published_filter_is_started_and_set_as_the_paper_says(script, monkeypatch):
    module, said = script
    monkeypatch.setattr(sys, "argv", ["paper_imu_error", "--as-published", "--seeds", "0", "trainer.max_epochs=3"])
    module.main()
    assert [words[0] for words in said] == ["train", "tune", "tune", *["evaluate"] * 3]
    training = composed(*said[0])
    fixes = compose_command("simulate", "simulated@dataset=paper_clean")["dataset"]["gnss"]
    tuning = training["baselines"]["tuning"]
    assert tuning["position_std"] * fixes["std_horizontal"] == pytest.approx(0.5)  # R017
    assert tuning["velocity_std"] * fixes["std_velocity"] == pytest.approx(0.05)
    assert training["data"]["start"]["yaw_deg"] == 60
    assert training["model"]["training_turn"] == pytest.approx(math.pi, abs=1e-5)
    assert not training["baselines"]["tune"] and training["trainer"]["max_epochs"] == 3
    *searched, first, second, third = (composed(*words) for words in said[1:])
    scored = (first, second, third)
    for given in (*searched, *scored):
        assert given["start"] == training["data"]["start"] and given["dataset"] == training["data"]["datasets"][0]
    assert [given["model"] for given in searched] == ["mbkf15", "mbkf15_prior"]
    for given in searched:
        assert given["fractions"] == training["data"]["fractions"] and given["objective"] == "pva"
    assert all("outage=null" in words for words in said[1:])
    for given in scored:
        assert given["prior"]["mean"] == [1, 2, 3, 4, 5, 6] and given["unseen"]
        assert (Path(given["model"][-1]) / "config.yaml").is_file() and given["length_s"] == 60
    assert scored[0]["tuning"] == tuning
    done = json.loads((module.HOME / "trainings.json").read_text())
    assert list(done) == [f"as_published{kind}/0" for kind in ("", "_prior", "_tuned", "_prior_tuned")]
    module.main()
    assert len(said) == 6  # what is finished is not done again
