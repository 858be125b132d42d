"""The page of the paper: what was run stands beside what was published, what was not is named with its command."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path

from dlkf.evaluation.outages import OutagePlan
from dlkf.evaluation.results import summarise_scores
from dlkf.evaluation.table import as_json, format_number
from dlkf.filters.build import build_filter
from tests.evaluation.scoring import score
from tests.filters.scene import IMU, scene

SCRIPT = Path(__file__).parents[2] / "pipelines" / "paper_report.py"


def paper_report(monkeypatch, *arguments: object) -> int:
    spec = importlib.util.spec_from_file_location("paper_report", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.syspath_prepend(SCRIPT.parent)
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
    later = {
        "title": "town: heading when GNSS goes",
        "note": "",
        "columns": ["Filter", "22 s"],
        "rows": [["dlkf", "3"]],
    }
    content = {"dataset": "town", "results": [results.as_dict()], "tables": [later]}
    (report / "metrics.json").write_text(as_json(content))
    (tmp_path / "paper" / "outage").mkdir(parents=True)
    done = {"parent": "abc", "dlkf/0": str(tmp_path / "run")}
    (tmp_path / "paper" / "outage" / "trainings.json").write_text(json.dumps(done))
    assert paper_report(monkeypatch, "--home", tmp_path / "paper") == 0
    said, page = capsys.readouterr().out, (tmp_path / "paper" / "report.html").read_text()
    ratios = [results.versus("dlkf", "segments", "all", q, "mean").ratio for q in ("position", "velocity", "attitude")]
    met = sum(r <= mark for r, mark in zip(ratios, (0.63 / 1.43, 0.13 / 0.23, 0.17 / 0.23)))
    (line,) = [line for line in said.splitlines() if "Outages of 30 to 50 s" in line]
    assert line.split(" | ")[1:3] == ["0.44 / 0.57 / 0.74", " / ".join(format_number(r, digits=2) for r in ratios)]
    assert line.endswith({0: "no", 3: "yes"}.get(met, f"in part: {met} of 3"))
    assert "town: heading when GNSS goes (dlkf/0)" in page
    assert "1.43 m" in page and "Not run yet: python pipelines/paper_kalman_gain.py" in page
    assert "python pipelines/paper_imu_error.py | not run" in said
    assert all(f"Figure {n} (drawn anew" in page for n in (1, 2, 3, 5)) and page.count("data:image/png") == 4


def test_seeds_share_the_rows_of_classical_filters(tmp_path, monkeypatch, capsys):
    batch = scene(4, 40, seed=3)
    mask = OutagePlan(20.0, 15.0).masks(batch)[0]
    done = {}
    for seed, learned in enumerate(("mbkf21", "mbkf21_nhc")):
        filters = {"mbkf15": build_filter("mbkf15", IMU), "dlkf": build_filter(learned, IMU)}
        results = summarise_scores(score(filters, [batch], outages=[mask], kinds="simulated"))
        report = tmp_path / str(seed) / "report"
        report.mkdir(parents=True)
        content = {"dataset": "town", "results": [results.as_dict()], "tables": []}
        (report / "metrics.json").write_text(as_json(content))
        done[f"minute/{seed}"] = str(report.parent)
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures" / "trainings.json").write_text(json.dumps(done))
    assert paper_report(monkeypatch, "--home", tmp_path) == 0
    page = (tmp_path / "report.html").read_text()
    assert page.count("<td>minute</td>") == 3  # mbkf15 once, dlkf for each seed
    assert "about 0.5 | " in capsys.readouterr().out
