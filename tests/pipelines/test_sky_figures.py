"""Pictures of the sky, and the command that measures fixes: what they show is what the tables say."""

import numpy as np
import pandas as pd
import pytest
from pipelines.studies.figures import sky_figures
from pipelines.studies.satellite_sky import above_horizon, fix_errors, summary, tables

from dlkf.data.tables import read_table
from dlkf.data.validate import validate_dataset
from dlkf.navigation.imu_errors import SensorErrors
from tests.drives import drives_in

QUIET = {**dict.fromkeys(SensorErrors.__dataclass_fields__, 0.0), "correlation_time": 3600.0}


def make(out, workers=1, raw=True, receiver=None):
    dataset = {
        "name": "toy", "hours": 0.1, "drive_minutes": 3.0, "gnss": {"lever_arm_b": [0.5, 0.0, -1.5]},
        "surroundings": {"tunnel_length": 100.0, "tunnel_spacing": 400.0, "building_height": 8.0},
    }  # fmt: skip
    receiver = receiver or {"name": "lone", "std_range": 0.5, "multipath": 0.5, "reacquire_s": 1.0}
    imu = {"name": "toy", "accel": QUIET, "gyro": QUIET}
    config = {"dataset": dataset, "imu": imu, "seed": 6, "receiver": receiver, "raw": raw, "workers": workers}
    return drives_in(config, out)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return make(tmp_path_factory.mktemp("sky") / "toy")


def test_a_dataset_with_satellites_keeps_the_contract(dataset):
    """Extra columns of the fixes are carried along and not in the readers' way."""
    assert len(validate_dataset(dataset)) == 2
    read = read_table(dataset, "gnss", "toy-6-00000")
    fixes, _, raw = tables(dataset, "toy-6-00000")
    assert {"satellites", "gdop", "pdop", "hdop", "vdop"} <= set(fixes) and "satellites" not in read
    assert np.array_equal(raw.groupby("t").size().reindex(fixes.t, fill_value=0), fixes.satellites)
    rows = pd.read_parquet(dataset / "drives.parquet")
    assert rows.gnss.str.contains("receiver lone, GPS almanac of week 2429").all()


def test_the_same_bits_whatever_the_workers_and_raw_only_when_asked(dataset, tmp_path):
    other = make(tmp_path / "two", workers=2)
    for path in dataset.rglob("*.parquet"):
        assert path.read_bytes() == (other / path.relative_to(dataset)).read_bytes()
    assert not (make(tmp_path / "bare", raw=False) / "raw").exists()


def test_pictures_show_the_tables(dataset):
    fixes, reference, raw = tables(dataset, "toy-6-00000")
    lost = int((fixes.quality == 0).sum())
    assert lost > 0
    top, bottom = sky_figures.dilution(fixes).axes
    assert np.array_equal(top.lines[0].get_ydata(), fixes.satellites)
    assert np.isnan(bottom.lines[0].get_ydata()).sum() == lost
    dots = sky_figures.route(fixes, reference).axes[0]
    assert len(dots.collections[0].get_offsets()) == len(fixes) - lost and len(dots.lines[1].get_xdata()) == lost
    above = above_horizon(raw, reference)
    names = {text.get_text()[:3] for text in sky_figures.sky_plot(raw, above).axes[0].texts}
    assert names >= {f"G{prn:02d}" for prn in raw.prn.unique()}
    error = fix_errors(fixes, reference, np.array([0.5, 0.0, -1.5]))
    assert (np.abs(error[:, :3] / fixes[["std_pos_n", "std_pos_e", "std_pos_d"]]).max() < 5).all()
    shown = sky_figures.errors(fixes, error[:, :3]).axes[0].lines[0].get_ydata()
    assert np.array_equal(shown, np.where(fixes.quality > 0, error[:, 0], np.nan), equal_nan=True)


def test_the_summary_counts_what_is_there(dataset, capsys):
    summary(dataset)
    said = capsys.readouterr().out
    assert "2 drives, 362 epochs" in said and "position error RMS" in said and "velocity error not known" in said


def test_fixes_without_satellites_are_told_from_others(dataset, tmp_path):
    bare = make(tmp_path / "white", raw=False, receiver={"name": "white"})
    with pytest.raises(SystemExit, match="receiver=standalone"):
        summary(bare)
