"""The commands as a user runs them: files, table, and one line for a mistake."""

import json
import os
import shutil
import subprocess
import sys

import pyarrow.parquet as pq
import pytest

from dlkf.running.solution import GEO_SCHEMA


def run(folder, command, *arguments):
    return subprocess.run(
        [sys.executable, "-m", f"dlkf.{command}", *map(str, arguments)],
        cwd=folder,
        env={**os.environ, "OMP_NUM_THREADS": "1", "COLUMNS": "120"},
        capture_output=True,
        text=True,
        timeout=120,
    )


def test_evaluate_leaves_a_report(town, tmp_path):
    done = run(
        tmp_path, "evaluate", "model=[ins,mbkf15]", f"dataset={town}", "out=report", "imu=consumer",
        "rate_hz=20", "length_s=50", "outage.first_s=20", "outage.duration_s=[10,20]", "injected_bias=null",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "town (simulated): 6 pieces, 6 drives" in done.stdout and "ratio to" in done.stdout
    content = json.loads((tmp_path / "report" / "metrics.json").read_text())
    assert content["protocol"]["mode"] == "pieces" and content["protocol"]["imu"] == "consumer"
    assert content["results"][0]["count"]["outages"] == 6 == len(content["results"][0]["per_outage"])
    assert (tmp_path / "report" / "figures" / "error_over_time.png").stat().st_size > 10_000


def test_navigate_writes_solutions_without_a_reference(town, tmp_path):
    shutil.copytree(town, tmp_path / "town")
    shutil.rmtree(tmp_path / "town" / "reference")
    done = run(
        tmp_path, "navigate", "model=mbkf15", "dataset=town", "out=solved", "rate_hz=20", "drives=[car-01]"
    )
    assert done.returncode == 0, done.stderr
    assert "car-01: aligned at t = " in done.stdout
    assert pq.read_schema(tmp_path / "solved" / "drive=car-01" / "solution.parquet").equals(GEO_SCHEMA)
    assert sorted(p.name for p in (tmp_path / "solved").iterdir()) == ["drive=car-01", "report.html"]


@pytest.mark.parametrize(
    ("command", "arguments", "said"),
    [
        ("navigate", ["model=mbkf99"], "unknown model 'mbkf99'"),
        ("navigate", ["model=mbkf15", "imu=none_such"], "none_such"),
        ("evaluate", ["model=mbkf15", "tuning.gyro_noise=-1"], "tuning: gyro_noise is -1"),
    ],
)
def test_a_mistake_is_one_line_and_leaves_nothing(town, tmp_path, command, arguments, said):
    done = run(tmp_path, command, *arguments, f"dataset={town}", "out=made", "rate_hz=20")
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1 and said in done.stderr
    assert not (tmp_path / "made").exists()
