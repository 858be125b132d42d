"""Experiment 5.2 from its trainings to figures, tables and trends, with Kalman filters in the place of the networks."""

from __future__ import annotations

import json
import sys

import pytest
import torch
from pipelines.studies import gain_trends

from dlkf.evaluation.gains import measure_gains, write_gains
from dlkf.evaluation.results import summarise_scores
from dlkf.evaluation.table import as_json
from dlkf.filters.build import build_filter
from tests.evaluation.scoring import score
from tests.filters.scene import IMU, scene

NOISE = {"set1": (0, 0), "set2": (1, 0), "set3": (5, 0), "set4": (0, 0.5), "set5": (0, 2), "set6": (2, 0.5)}


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """Six trainings, as far as the study reads them."""
    folder = tmp_path_factory.mktemp("kalman_gain")
    filters = {"dlkf": build_filter("mbkf21", IMU), "mbkf15": build_filter("mbkf15", IMU)}
    for name, (s_p, s_v) in NOISE.items():
        batch = scene(2, 20, seed=1, position_std=0.03 + s_p, velocity_std=0.02 + s_v)
        report = folder / name / "report"
        write_gains(report, measure_gains(filters, [(batch, torch.zeros(batch.size[:2], dtype=torch.bool))]), name)
        results = summarise_scores(score(filters, [batch], kinds="simulated"))
        noise = {"s_p": s_p, "s_v": s_v} if s_p or s_v else None
        content = {"protocol": {"gnss_noise": noise}, "results": [results.as_dict()]}
        (report / "metrics.json").write_text(as_json(content))
    done = {"parent": "abc"} | {f"{name}/0": str(folder / name) for name in NOISE}
    (folder / "trainings.json").write_text(json.dumps(done))
    return folder


def study(monkeypatch, folder) -> int:
    monkeypatch.setattr(sys, "argv", ["gain_trends", str(folder)])
    return gain_trends.main()


@pytest.mark.commands
def test_figures_tables_and_trends(home, monkeypatch, capsys):
    assert study(monkeypatch, home) == 0, capsys.readouterr().out
    assert all((home / f"figure{n}.png").read_bytes().startswith(b"\x89PNG") for n in (7, 8, 9))
    assert "| set6 | 2 | 0.5 |" in (home / "table4.md").read_text()
    assert (home / "table5.md").read_text().count("\n") == 2 + 2 * 6
    assert (home / "trends.md").read_text().count("| yes |") == 2 * 4


@pytest.mark.commands
def test_a_gain_that_does_not_follow_is_said(home, monkeypatch, capsys):
    monkeypatch.setattr(gain_trends, "FIGURES", {})  # drawn above
    file = home / "set3" / "report" / "gains.json"
    whole = json.loads(file.read_text())
    whole["dlkf"]["K_pp"] = 1.5
    file.write_text(json.dumps(whole))
    assert study(monkeypatch, home) == 1 and "| no |" in capsys.readouterr().out


def test_without_trainings_it_says_what_to_run(tmp_path, monkeypatch, capsys):
    assert study(monkeypatch, tmp_path) == 2 and "paper_kalman_gain.py" in capsys.readouterr().err
