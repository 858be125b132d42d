"""The commands as a user runs them: files, table, and one line for a mistake."""

import json
import shutil
from dataclasses import replace

import pandas as pd
import pyarrow.parquet as pq
import pytest

from dlkf.data.schema import drive_file
from dlkf.data.store import drive_rows
from dlkf.evaluation.chunks import EvaluationJob, evaluate_chunks, suggest_more_outages
from dlkf.evaluation.outages import OutagePlan
from dlkf.evaluation.protocol import Protocol
from dlkf.filters.build import build_filter
from dlkf.running.solution import GEO_SCHEMA
from tests.cars import IMU
from tests.shell import PATIENCE_S, start_command


@pytest.mark.parametrize("duration_s, said", [(5, "has"), (30, "gives more")])
def test_few_outages_are_compared_with_those_of_whole_drives(town, duration_s, said):
    """The number is that of the run that is suggested, or there is no suggestion."""
    filters, grid = {"ins": build_filter("ins", IMU)}, {"rate_hz": 20.0, "epoch_s": 1.0, "aids": ()}
    protocol = Protocol("segments", 50.0, 50.0, outage=OutagePlan(15, duration_s))
    names = [row.name for row in drive_rows(town)]
    kinds = dict.fromkeys(names, "simulated")
    work = EvaluationJob(str(town), filters, protocol, grid, kinds, {}, shown=False)
    chunks = [tuple(names[:2]), tuple(names[2:])]
    counts = []
    for mode in ("segments", "drives"):
        done = evaluate_chunks(replace(work, protocol=replace(protocol, mode=mode)), chunks)
        counts.append(len(done.scores.windows.segment))
    assert (counts[1] > counts[0]) == (said == "has")
    advice = suggest_more_outages(work, chunks, counts[0])
    assert str(counts[0]) in advice and f" {said}" in advice and str(counts[1]) in advice


@pytest.fixture
def own_town(town, tmp_path):
    """The town as ``town`` here, with a fix of one drive at 0°/0°."""
    shutil.copytree(town, tmp_path / "town")
    path = drive_file(tmp_path / "town", "gnss", "car-01")
    fixes = pd.read_parquet(path, partitioning=None)
    fixes.loc[35, ["lat_deg", "lon_deg"]] = 0.0
    fixes.to_parquet(path, index=False)


@pytest.mark.whole
@pytest.mark.usefixtures("own_town")
def test_evaluate_leaves_a_report(uri, tmp_path, monkeypatch):
    """The page too says which fix was refused."""
    monkeypatch.setenv("COLUMNS", "200")
    process = start_command(
        tmp_path, said := tmp_path / "said", "evaluate", "model=[ins,mbkf15]", "dataset=town", "out=report",
        "imu=consumer", "rate_hz=20", "length_s=50", "outage.first_s=20", "outage.duration_s=[10,20]",
        "injected_bias=null", "figures=true",
    )  # fmt: skip
    process.join(PATIENCE_S)
    out = said.read_text()
    assert process.exitcode == 0, out
    assert "town (simulated): 6 outages of 10 to 20 s, 6 drives" in out
    assert " without GNSS, 6 outages: " in out
    assert "mode=drives scores whole drives" in " ".join(out.split())
    content = json.loads((tmp_path / "report" / "metrics.json").read_text())
    assert content["protocol"]["mode"] == "segments" and content["protocol"]["imu"] == "consumer"
    assert content["protocol"]["rejected as implausible"] == {"car-01": "1 fix"}
    assert "drive car-01: rejected as implausible: 1 fix" in out
    assert "rejected as implausible" in (tmp_path / "report" / "report.html").read_text()
    assert content["results"][0]["count"]["outages"] == 6 == len(content["results"][0]["per_outage"])
    assert (tmp_path / "report" / "figures" / "error_over_time.png").stat().st_size > 10_000


@pytest.mark.usefixtures("own_town")
def test_navigate_writes_solutions_without_a_reference(call, tmp_path):
    shutil.rmtree(tmp_path / "town" / "reference")
    done = call("navigate", "model=mbkf15", "dataset=town", "out=solved", "rate_hz=20", "drives=[car-01]")
    assert done.code == 0, done.err
    assert "car-01: solution from t = " in done.out
    assert "Rejected as implausible: 1 fix of car-01." in (tmp_path / "solved" / "report.html").read_text()
    assert pq.read_schema(tmp_path / "solved" / "drive=car-01" / "solution.parquet").equals(GEO_SCHEMA)
    assert sorted(p.name for p in (tmp_path / "solved").iterdir()) == ["drive=car-01", "log.txt", "report.html"]
