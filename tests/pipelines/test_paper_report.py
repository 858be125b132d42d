"""The page of the paper: what was run stands beside what was published, what was not is named with its command."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path

import torch

from dlkf.evaluation.outages import OutagePlan
from dlkf.evaluation.results import summarise_scores
from dlkf.evaluation.table import as_json
from dlkf.filters.build import build_filter
from tests.evaluation.scoring import score
from tests.filters.scene import IMU, scene

SCRIPT = Path(__file__).parents[2] / "pipelines" / "paper_report.py"


def paper_report(monkeypatch, *arguments: object) -> int:
    spec = importlib.util.spec_from_file_location("paper_report", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(sys, "argv", ["paper_report", *map(str, arguments)])
    return module.main()


def test_what_was_run_and_what_was_not(tmp_path, monkeypatch, capsys):
    batch = scene(4, 40, seed=3)
    filters = {"mbkf15": build_filter("mbkf15", IMU), "dlkf": build_filter("mbkf21", IMU)}
    mask = OutagePlan(20.0, 15.0).masks(batch)[0]
    results = summarise_scores(score(filters, [batch], outages=[mask], kinds="simulated"))
    report = tmp_path / "run" / "report"
    report.mkdir(parents=True)
    (report / "metrics.json").write_text(as_json({"results": [results.as_dict()]}))
    (tmp_path / "paper" / "outage").mkdir(parents=True)
    done = {"parent": "abc", "dlkf/0": str(tmp_path / "run")}
    (tmp_path / "paper" / "outage" / "trainings.json").write_text(json.dumps(done))
    assert paper_report(monkeypatch, "--home", tmp_path / "paper") == 0
    said, page = capsys.readouterr().out, (tmp_path / "paper" / "report.html").read_text()
    ratio = results.versus("dlkf", "pieces", "all", "position", "mean").ratio
    assert f"dlkf/0: {ratio:.2g}"[:12] in said and "paper_imu_error.py" in said and "paper_kalman_gain.py" in said
    assert "1.43 m" in page and "Not run yet: python pipelines/paper_kalman_gain.py" in page
    assert torch.isfinite(torch.tensor(ratio))
