"""What README.md and the pages tell a newcomer to type works in this order, on small data."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.docs.conftest import Run
from tests.docs.pages import ROOT, blocks, commands

README = ROOT / "README.md"
LONGEST = 100  # lines


def shell(page: Path, heading: str) -> list[list[str]]:
    """The commands below a heading of a page."""
    return [w for b in blocks(page) if b.heading == heading and not b.language for w in commands(b.text)]


def write_logs(dataset: Path, folder: Path) -> None:
    """Two drives of a dataset as the logs of docs/data.md: xsens.csv, ublox.csv, truth.csv."""
    for name, drive in zip(("monday-1", "monday-2"), pd.read_parquet(dataset / "drives.parquet")["drive"]):
        tables = {k: pd.read_parquet(dataset / k / f"drive={drive}") for k in ("imu", "gnss", "reference")}
        (folder / name).mkdir(parents=True)
        imu, gnss, truth = tables["imu"], tables["gnss"], tables["reference"]
        flu = {"x": 1.0, "y": -1.0, "z": -1.0}
        xsens = {"time_ns": np.round(imu["t"] * 1e9).astype("int64")}
        xsens |= {f"a{a}": sign * imu[f"accel_{a}"] / 9.80665 for a, sign in flu.items()}
        xsens |= {f"g{a}": sign * np.degrees(imu[f"gyro_{a}"]) for a, sign in flu.items()}
        ublox = {"time_ns": np.round(gnss["t"] * 1e9).astype("int64")}
        ublox |= {"lat": gnss["lat_deg"], "lon": gnss["lon_deg"], "alt": gnss["height_m"]}
        ublox |= {"speed_kmh": 3.6 * np.hypot(gnss["vel_n"], gnss["vel_e"])}
        ublox |= {"course": np.degrees(np.arctan2(gnss["vel_e"], gnss["vel_n"])) % 360, "fix": "RTK"}
        truth[["roll", "pitch", "yaw"]] = np.degrees(truth[["roll", "pitch", "yaw"]])
        for file, columns in (("xsens", xsens), ("ublox", ublox), ("truth", truth)):
            pd.DataFrame(columns).to_csv(folder / name / f"{file}.csv", index=False)


def test_the_front_page_is_short_and_says_where_to_read_on() -> None:
    text = README.read_text()
    assert len(text.splitlines()) <= LONGEST
    pages = {f"docs/{p.name}" for p in (ROOT / "docs").glob("*.md")} | {"RESULTS.md"}
    assert pages <= set(re.findall(r"\]\(([^)#]+)", text))


@pytest.fixture
def own_logs(desk: Path) -> Path:
    """Logs and their mapping as docs/data.md has them."""
    write_logs(desk / "data" / "consumer", desk / "logs")
    (mapping,) = (b for b in blocks(ROOT / "docs" / "data.md") if b.file == "mine/reader/xsens.yaml")
    (desk / "mine" / "reader").mkdir(parents=True)
    (desk / "mine" / "reader" / "xsens.yaml").write_text(mapping.text)
    return desk


def test_your_own_drives(own_logs: Path, run: Run) -> None:
    ours = [words for words in shell(README, "Your own drives") if "data/town" in " ".join(words)]
    assert [words[2] for words in ours] == ["dlkf.ingest", "dlkf.navigate", "dlkf.evaluate"]
    for words in ours:
        run(words)
    town = own_logs / "data" / "town"
    made = pd.read_parquet(town / "imu" / "drive=monday-1")
    drive = pd.read_parquet(own_logs / "data" / "consumer" / "drives.parquet")["drive"][0]
    source = pd.read_parquet(own_logs / "data" / "consumer" / "imu" / f"drive={drive}")
    np.testing.assert_allclose(made["accel_z"], source["accel_z"], atol=1e-9)
    np.testing.assert_allclose(made["gyro_z"], source["gyro_z"], atol=1e-12)
    assert (pd.read_parquet(town / "gnss" / "drive=monday-2")["quality"] == 4).all()
    assert pd.read_parquet(town / "drives.parquet")["lever_arm_z_m"].tolist() == [-1.2, -1.2]
    solved = pd.read_parquet(own_logs / "outputs" / "town" / "drive=monday-1" / "solution.parquet")
    assert solved["gnss_used"].any()
    assert "with plus." in (own_logs / "outputs" / "town" / "log.txt").read_text()  # the default


def test_simulated_drives(desk: Path, run: Run, monkeypatch: pytest.MonkeyPatch, capfd) -> None:
    """The second block of the same chapter; then the stream of docs/vehicle.md over its drives."""
    (desk / "empty").mkdir()
    monkeypatch.chdir(desk / "empty")
    ours = [words for words in shell(README, "Your own drives") if "data/consumer" in " ".join(words)]
    assert [words[2] for words in ours] == ["dlkf.simulate", "dlkf.evaluate", "dlkf.navigate"]
    for words in ours:
        run(words)
    assert Path("outputs/consumer/report.html").is_file()
    (program,) = (b for b in blocks(ROOT / "docs" / "vehicle.md") if b.language == "python")
    capfd.readouterr()
    exec(compile(program.text, "vehicle.md", "exec"), {"__name__": "vehicle"})
    printed = [[float(x) for x in line.split()] for line in capfd.readouterr().out.splitlines()]
    solved = pd.read_parquet("outputs/consumer_solved/drive=per_drive-3-00000/solution.parquet").set_index("t")
    t, lat, lon, _ = printed[-1]
    assert abs(lat - solved.loc[t, "lat_deg"]) < 1e-6 and abs(lon - solved.loc[t, "lon_deg"]) < 1e-6  # 0.1 m
