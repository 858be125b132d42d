"""The comparison of plus with tuned classical filters, on three minutes of drives and factors found before."""

import sys
from dataclasses import asdict

import yaml
from pipelines.studies import plus

from dlkf.filters.tuning import Tuning


def test_it_scores_and_writes_its_tables(simulated, tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    out.mkdir()
    (out / "factors.yaml").write_text(yaml.safe_dump({name: asdict(Tuning()) for name in plus.CLASSICAL}))
    words = ["--train", "none", "--test", str(simulated), "--outages", "20", "--ablation", "--out", str(out)]
    words += ["--model", "plus", "plus"]
    monkeypatch.setattr(sys, "argv", ["plus", *words])
    plus.main()
    assert (out / "ratios.png").read_bytes()[:4] == b"\x89PNG"
    table = (out / "table.md").read_text()
    lines = [line for line in table.splitlines() if line.startswith(f"| {simulated.name} | 20 |")]
    assert len(lines) == 3 and table in capsys.readouterr().out + "\n"
    cells = [c.strip() for c in lines[0].split("|")[4:9]]
    assert all(0 < float(c.split(" / ")[0]) < 1e4 for c in cells)
    seeds = [c.strip() for c in lines[1].split("|")[3:-1]]
    assert seeds[:4] == seeds[4:] and seeds[0] == cells[-1]
    head = table.splitlines()[0]
    assert "told its IMU" in head and 0 < float(lines[0].split("|")[-2].split(" / ")[0]) < 1e4
    assert all(name in head for name in (*plus.CLASSICAL, "plus"))
