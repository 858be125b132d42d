"""Every study can be started in the same way and says how; the quick ones run on a small world."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest

from dlkf.filters.build import build_filter

from ..filters.scene import IMU
from ..filters.test_stationarity import shaken

ROOT = Path(__file__).parents[2]
STUDIES = sorted(path.stem for path in (ROOT / "pipelines" / "studies").glob("*.py") if path.stem != "__init__")
CHAINS = sorted(path.stem for path in (ROOT / "pipelines").glob("*.py"))


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


QUICK = {  # a study: its arguments beside the dataset, and what it says or leaves
    "benchmark": (
        ["--threads", "1", "--hours", "0.1", "--length-s", "8", "--repeats", "1", "--parts", "strapdown", "scaling"],
        "bench.json",
    ),
    "streaming": (["road", "--hours", "0.02", "--model", "mbkf15"], "good: 64 epochs"),
}


@pytest.mark.parametrize("name", QUICK)
def test_a_study_runs_on_a_small_world(name, town, tmp_path, monkeypatch, capsys):
    arguments, said = QUICK[name]
    monkeypatch.chdir(tmp_path)
    places = {"town": town, "tmp": tmp_path}
    assert started(name, monkeypatch, *(a.format(**places) for a in arguments)) == 0
    assert said in capsys.readouterr().out


def test_standstills_counts_what_a_filter_finds():
    """Cars that stop 20 s into the outage: found to the second, not in motion, and worth what the truth is worth."""
    from pipelines.studies.standstills import line

    batch = shaken((0.2, 2e-3), (0.4, 8e-3))
    row = line("cars", "mbkf15_nhc", build_filter("mbkf15_nhc", IMU), batch, 0.01, 20.0, 78.0)
    stood, found, moving, _, without, expected = (cell.strip() for cell in row.strip("| ").split("|")[2:])
    assert float(stood) >= 8 * 55 and float(found) > 0.95 * float(stood) and float(moving) == 0
    assert float(without.split()[0]) > 3 and 0.8 < float(expected.split()[0]) < 1.1
