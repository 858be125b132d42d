"""The commands as a user runs them: files, table, and one line for a mistake."""

import json
import shutil

import pyarrow.parquet as pq
import pytest

from dlkf.running.solution import GEO_SCHEMA
from tests.shell import in_shell


def test_evaluate_leaves_a_report(town, template, tmp_path):
    shutil.copy(template, tmp_path / "mlflow.db")
    done = in_shell(
        tmp_path, "evaluate", "model=[ins,mbkf15]", f"dataset={town}", "out=report", "imu=consumer",
        "rate_hz=20", "length_s=50", "outage.first_s=20", "outage.duration_s=[10,20]", "injected_bias=null",
    )  # fmt: skip
    assert done.code == 0, done.err
    assert "town (simulated): 6 pieces, 6 drives" in done.out and "ratio to" in done.out
    assert "mode=drives has them over all of every drive" in " ".join(done.out.split())
    content = json.loads((tmp_path / "report" / "metrics.json").read_text())
    assert content["protocol"]["mode"] == "pieces" and content["protocol"]["imu"] == "consumer"
    assert content["results"][0]["count"]["outages"] == 6 == len(content["results"][0]["per_outage"])
    assert (tmp_path / "report" / "figures" / "error_over_time.png").stat().st_size > 10_000


def test_navigate_writes_solutions_without_a_reference(town, call, tmp_path):
    shutil.copytree(town, tmp_path / "town")
    shutil.rmtree(tmp_path / "town" / "reference")
    done = call("navigate", "model=mbkf15", "dataset=town", "out=solved", "rate_hz=20", "drives=[car-01]")
    assert done.code == 0, done.err
    assert "car-01: aligned at t = " in done.out
    assert pq.read_schema(tmp_path / "solved" / "drive=car-01" / "solution.parquet").equals(GEO_SCHEMA)
    assert sorted(p.name for p in (tmp_path / "solved").iterdir()) == ["drive=car-01", "log.txt", "report.html"]


@pytest.mark.parametrize(
    ("command", "arguments", "said"),
    [
        ("navigate", ["model=mbkf99"], "unknown model 'mbkf99'"),
        ("navigate", ["model=mbkf15", "imu=none_such"], "none_such"),
        ("evaluate", ["model=mbkf15", "tuning.gyro_noise=-1.0"], "tuning: gyro_noise is -1.0"),
    ],
)
def test_a_mistake_is_one_line_and_leaves_nothing(town, call, tmp_path, command, arguments, said):
    done = call(command, *arguments, f"dataset={town}", "out=made", "rate_hz=20")
    assert done.code == 2
    assert len(done.err.strip().splitlines()) == 1 and said in done.err
    assert not (tmp_path / "made").exists()
