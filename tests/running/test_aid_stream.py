"""A stream with wheel speed, heading and barometer says what a batch says, late samples included, and so does C."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from dlkf.data.aid_tables import STANDARD
from dlkf.data.alignment import SEARCH
from dlkf.data.store import drive_from_tables, drive_rows
from dlkf.data.validate import read_drive
from dlkf.filters.aids.attach import aid_columns, with_aids
from dlkf.filters.build import build_filter
from dlkf.filters.saved import load_filter
from dlkf.filters.shipped import shipped_folder
from dlkf.onboard.compiled_filter import compile_filter
from dlkf.onboard.library import find_compiler
from dlkf.report.navigation import TrackOnMap
from dlkf.running.offline import navigate_drives
from dlkf.running.replay import replay_drive, stream_drive
from dlkf.running.streaming import Status, StreamingFilter
from tests.cars import IMU, write_cars

CAUSAL = SEARCH  # how a stream starts
GRID = {"rate_hz": 50.0, "epoch_s": 1.0}


@pytest.fixture(scope="module")
def tables(tmp_path_factory):
    """A minute of the exact car with all three sensors; the wheel lacks ten seconds."""
    wheel = {"scale": 1.02, "delay_s": 0.1, "right_m": 0.5}
    folder = write_cars(tmp_path_factory.mktemp("data") / "aided", 1, aids=wheel, seconds=60.0)
    tables = read_drive(folder, drive_rows(folder)[0], reference=False)
    speed = tables.aids["speed"]
    kept = (speed["t"] < 30) | (speed["t"] > 40)
    return replace(tables, aids={**tables.aids, "speed": {k: v[kept] for k, v in speed.items()}})


def _filters():
    return {
        "mbkf21_car": with_aids(build_filter("mbkf21_car", IMU), STANDARD.values()),
        "plus": with_aids(load_filter(shipped_folder("plus")), [STANDARD["speed"]]),
    }


def _apart(a, b) -> float:
    """Greatest distance of two solutions [m], and their further columns are the same."""
    assert list(a.table.columns) == list(b.table.columns) and len(a.table) == len(b.table)
    place = np.radians((a.table[["lat_deg", "lon_deg"]] - b.table[["lat_deg", "lon_deg"]]).to_numpy())
    height = (a.table["height_m"] - b.table["height_m"]).abs().max()
    extra = [c for c in a.table.columns if c.startswith(("speed", "wheel", "heading", "baro"))]
    assert extra and np.allclose(a.table[extra], b.table[extra], rtol=1e-5, atol=1e-6, equal_nan=True)
    return max(6.4e6 * float(np.abs(place).max()), float(height))


@pytest.mark.parametrize("name, late_s", [("mbkf21_car", 0.45), ("plus", 0.0)])
def test_a_stream_is_a_batch_run(tables, name, late_s):
    """With sensors on time, or all of them late: then every update interval is replayed."""
    model = _filters()[name]
    drive = drive_from_tables(tables, "", **GRID, dtype=torch.float64)
    batch = next(navigate_drives([drive], model, align=CAUSAL))
    assert batch.table["speed_used"].sum() > 40
    expected = r", speed in 4\d of 4\d updates \(normalised innovation RMS .*, at the end wheel scale error [12]\.\d"
    assert re.search(expected, batch.summary())
    assert TrackOnMap(batch, None).for_the_map().result.sensors() == batch.sensors()
    assert _apart(batch, stream_drive(tables, model, **GRID, late_s=late_s)) < 1e-6


@pytest.mark.skipif(find_compiler() is None, reason="needs a C compiler")
@pytest.mark.parametrize("step", [None, 1 / 3.6], ids=["exact", "whole km/h"])
def test_a_compiled_filter_is_a_batch_run(tables, step):
    model = _filters()["mbkf21_car"]
    if step is not None:
        speed = tables.aids["speed"]
        rounded = {"t": speed["t"][::20], "speed": step * np.round(speed["speed"][::20] / step)}
        tables = replace(tables, aids={**tables.aids, "speed": rounded})
    drive = drive_from_tables(tables, "", **GRID, dtype=torch.float64)
    made = compile_filter(model, **GRID)
    assert aid_columns(made) == aid_columns(model)
    batch = next(navigate_drives([drive], model, align=CAUSAL))
    assert _apart(batch, next(navigate_drives([drive], made, align=CAUSAL))) < 1e-6
    assert _apart(batch, stream_drive(tables, made, **GRID)) < 1e-6


def test_what_lies_before_the_first_interval_is_not_late(tables):
    """A log that begins within a second: the grid is laid later, through its fixes."""

    def cut(table):
        return {column: values[table["t"] > 5.3] for column, values in table.items()}

    stream = StreamingFilter(_filters()["mbkf21_car"], **GRID)
    aids = {name: cut(table) for name, table in tables.aids.items()}
    list(replay_drive(stream, cut(tables.imu), cut(tables.gnss), aids=aids))
    assert stream.latest is not None and not stream.counts["refused"]


def test_what_cannot_be_taken_is_refused_with_a_reason(tables):
    stream = StreamingFilter(_filters()["plus"], phase_s=0.0)
    assert stream.speed(1.0, 3.0).status is Status.TAKEN and stream.speed(1.0, 3.0, None).status is Status.TAKEN
    assert "takes no baro" in stream.baro(1.0, None).reason and "takes no baro" in stream.baro(1.0).reason
    for receipt, reason in (
        (stream.heading(1.0, 0.1), "takes no heading"),
        (stream.speed(1.0, float("nan")), "not a finite number"),
        (stream.speed(float("inf"), 1.0), "not a finite number"),
        (stream.speed(1.0, 1.7e308), "a value beyond 1e+09"),
        (stream.speed(1.0, 1.0, -0.1), "std is below 0"),
        (stream.speed(None, 1.0), "not a finite number"),
        (stream.speed(1.0, "fast"), "not a finite number"),
        (stream.speed(2**2000, 1.0), "not a finite number"),
    ):
        assert receipt.status is Status.REFUSED and reason in receipt.reason
    for k in range(1, 1001):
        stream.imu(0.02 * k, (0.0, 0.0, -9.81), (0.0, 0.0, 0.0))
    assert "s late" in stream.speed(0.5, 3.0).reason and "ahead of the IMU" in stream.speed(60.0, 3.0).reason
    assert stream.speed(19.9, 3.0).status is Status.REPLAYED and "duplicate" in stream.speed(19.9, 3.0).reason


def test_a_bridged_gap_has_no_measurements_of_sensors(tables):
    """No sensor is used in it: innovations are unknown there, the estimates of its parameters stay."""
    t = tables.imu["t"]
    imu = {k: v[(t < 22.3) | (t > 22.8)] for k, v in tables.imu.items()}
    stream = StreamingFilter(_filters()["mbkf21_car"])
    rows, said = {}, []
    for receipt in replay_drive(stream, imu, tables.gnss, aids=tables.aids):
        rows.update((round(e.t, 6), e.row) for e in receipt.estimates)
        said.append(receipt.status)
    assert Status.BRIDGED in said
    end = min(t for t in rows if t > 22.8)
    assert rows[end - 1]["speed_used"] == 1.0
    for sensor in ("speed", "heading", "baro"):
        said = [rows[end][f"{sensor}_{x}"] for x in ("innovation", "innovation_std", "used")]
        assert np.isnan(said[:2]).all() and said[2] == 0.0
    assert rows[end]["wheel_scale"] == pytest.approx(rows[end - 1]["wheel_scale"])
