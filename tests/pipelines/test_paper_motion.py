"""Real motion joined with a unit's errors."""

from __future__ import annotations

import sys
from pathlib import Path

import pandas as pd

from dlkf.command.composing import compose_command

SCRIPTS = Path(__file__).parents[2] / "pipelines"


def test_the_motion_of_all_sources_is_one_dataset_of_a_unit(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(SCRIPTS)
    monkeypatch.chdir(tmp_path)
    import paper_real_motion

    said = []
    errors = {f"{sensor}_error_{axis}": [0.5] for sensor in ("accel", "gyro") for axis in "xyz"}

    def run(*words: str) -> None:
        said.append(words)
        given = dict(word.split("=", 1) for word in words[1:])
        if words[0] != "simulate":
            return
        assert given["dataset.unit_seed"] in ("177", "5") and given["dataset.imu_errors"] == "one"
        out, drive = Path(given["out"]), f"{given['source']}-1"
        for table in ("imu", "gnss", "reference"):
            (out / table / f"drive={drive}").mkdir(parents=True)
            pd.DataFrame(errors).to_parquet(out / table / f"drive={drive}" / "part-0.parquet")
        pd.DataFrame([{"drive": drive, "group": drive}]).to_parquet(out / "drives.parquet")

    monkeypatch.setattr(paper_real_motion, "run", run)
    words = ["paper_real_motion", "--real", "a,b", "--units", "177,5", "--learned", "net"]
    monkeypatch.setattr(sys, "argv", words)
    paper_real_motion.main()
    assert [w[0] for w in said] == ["simulate", "simulate", "evaluate"] * 2
    for unit in ("177", "5"):
        dataset = tmp_path / "data" / f"real_motion_{unit}"
        assert sorted(pd.read_parquet(dataset / "drives.parquet").drive) == ["a-1", "b-1"]
        assert sorted(x.name for x in (dataset / "gnss").iterdir()) == ["drive=a-1", "drive=b-1"]
    first, second = (compose_command(*words) for words in said[2::3])
    assert first["model"] == ["mbkf15", "mbkf21_car", "plus", "mbkf15_prior", "net"]
    assert second["model"] == first["model"][:3] and first["prior"]["mean"] == [0.5] * 6
    assert first["outage"]["duration_s"] == 30 and first["mode"] == "drives" and first["tuning"]["accel_noise"] > 1
