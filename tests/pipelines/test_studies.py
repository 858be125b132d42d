"""Every study can be started in the same way and says how; the quick ones run on a small world."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
STUDIES = sorted(path.stem for path in (ROOT / "pipelines" / "studies").glob("*.py") if path.stem != "__init__")
CHAINS = sorted(path.stem for path in (ROOT / "pipelines").glob("*.py") if path.stem != "trainings")


def started(name: str, monkeypatch, *arguments: object) -> int:
    """Exit code of ``python -m pipelines.studies.<name> …``."""
    monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
    try:
        code = importlib.import_module(f"pipelines.studies.{name}").main()
    except SystemExit as end:
        code = end.code
    return int(code or 0)


@pytest.mark.parametrize("name", STUDIES)
def test_a_study_tells_how_it_is_started(name, monkeypatch, capsys):
    assert started(name, monkeypatch, "--help") == 0
    assert "usage" in capsys.readouterr().out
    text = (ROOT / "pipelines" / "studies" / f"{name}.py").read_text()
    assert f"python -m pipelines.studies.{name}" in text.split('"""')[1] or f"make {name[:5]}" in text.split('"""')[1]


@pytest.mark.parametrize("name", CHAINS)
def test_a_chain_starts_commands_and_measures_nothing(name):
    """What computes belongs into a study; a chain may read results and print them."""
    text = (ROOT / "pipelines" / f"{name}.py").read_text()
    assert f"pipelines/{name}.py" in text.split('"""')[1]
    assert not {"import torch", "import numpy"} & {line.strip() for line in text.splitlines()}


def test_a_log_at_rest(tmp_path, monkeypatch):
    assert started("static_log", monkeypatch, tmp_path / "bench", "--imu", "consumer", "--hours", "0.01") == 0
    assert (tmp_path / "bench" / "drives.parquet").is_file()


def test_the_benchmark_runs_on_a_small_world(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words = ["--threads", "1", "--hours", "0.1", "--length-s", "8", "--repeats", "1", "--parts", "strapdown"]
    assert started("benchmark", monkeypatch, *words) == 0
    assert "bench.json" in capsys.readouterr().out
