"""What no car and no sensor of one can give is refused, counted, and not refused for ever."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from dlkf.base.errors import InputError
from dlkf.data.limits import FASTEST_M_S, FULL_SCALE, JUMP_M, FixScreen, Refused, screen_fixes
from dlkf.data.schema import POSITION, STD, VELOCITY, drive_file, write_drive, write_drives_table
from dlkf.data.store import load_dataset
from tests.cars import car

M = 1 / 111_195.0  # degrees per metre of latitude


def fixes(seconds: int, hz: float = 1.0, speed: float = 10.0) -> dict[str, np.ndarray]:
    """A car that drives north."""
    t = np.arange(round(seconds * hz)) / hz
    zero = np.zeros_like(t)
    columns = {"t": t, "lat_deg": 48 + speed * t * M, "lon_deg": zero + 9, "height_m": zero + 150}
    return columns | dict(zip(VELOCITY, (zero + speed, zero, zero))) | {c: zero + 0.05 for c in STD}


def refused(gnss: dict[str, np.ndarray]) -> list[int]:
    return np.flatnonzero(~screen_fixes(gnss).keep).tolist()


FAULTS = {
    "0°/0°": {"lat_deg": 0.0, "lon_deg": 0.0},
    "two degrees off": {"lat_deg": 50.0},
    "height zero": {"height_m": -5.0},
    "in space": {"height_m": 8e4},
    "a thousand times as fast": {"vel_n": 1e4},
    "1σ of no number's size": {"std_pos_n": 1e30},
}


@pytest.mark.parametrize("fault", FAULTS)
def test_one_fix_that_cannot_be_is_refused_alone(fault):
    gnss = fixes(60)
    for column, value in FAULTS[fault].items():
        gnss[column][30] = value
    assert refused(gnss) == [30]
    assert refused(fixes(60)) == []


def test_the_limit_of_a_jump_is_what_a_car_can_drive():
    """Way over time and the slack beyond it, both fixes' 1σ included; after a gap of a minute 7 km are no fault."""
    gnss = fixes(60)
    limit = FASTEST_M_S + JUMP_M + 6 * 2 * 0.05 * 3**0.5
    for off, kept in ((0.99 * limit - 10, []), (1.02 * limit, [30])):
        jumped = {c: x.copy() for c, x in gnss.items()}
        jumped["lat_deg"][30] += off * M
        assert refused(jumped) == kept
    late = {c: np.delete(x, np.s_[20:50]) for c, x in gnss.items()}
    late["lat_deg"][20:] += 3000 * M
    assert refused(late) == []


@pytest.mark.parametrize("hz", [1.0, 5.0])
def test_fixes_three_kilometres_off_for_five_seconds_are_refused_whatever_their_rate(hz):
    gnss = fixes(60, hz)
    wrong = (gnss["t"] >= 30) & (gnss["t"] < 35)
    gnss["lat_deg"][wrong] += 3000 * M
    assert refused(gnss) == np.flatnonzero(wrong).tolist()


def test_a_receiver_that_stays_elsewhere_is_right_after_ten_seconds():
    gnss = fixes(90)
    gnss["lat_deg"][30:] += 3000 * M
    assert refused(gnss) == list(range(30, 40))
    assert [t for t, _ in screen_fixes(gnss).switched] == [40.0]


def test_a_wrong_first_fix_refuses_one_good_one():
    gnss = fixes(60)
    gnss["lat_deg"][0] = 51.0
    assert refused(gnss) == [1]


def test_a_position_that_stays_while_the_velocity_goes_on_is_frozen():
    """Refused from 10 m on, and no longer once it moves; a car at rest may repeat its fix for ever."""
    gnss = fixes(60)
    gnss["lat_deg"][30:40] = gnss["lat_deg"][30]
    assert refused(gnss) == list(range(32, 40))
    assert refused(fixes(60, speed=0.0)) == []
    gnss["vel_d"][:] = np.nan  # of NMEA
    assert refused(gnss) == list(range(32, 40))


def test_row_by_row_is_as_the_whole_table():
    gnss = fixes(120, 2.0)
    rng = np.random.default_rng(1)
    gnss["lat_deg"][rng.integers(0, 240, 12)] += 0.1
    screen = FixScreen()
    rows = zip(*(gnss[c] for c in ("t", *POSITION)), strict=True)
    reasons = [screen.find_refusal(t, place, 10.0, np.full(6, 0.05)) for t, *place in rows]
    assert [k for k, reason in enumerate(reasons) if reason] == refused(gnss)
    assert all("implausible jump" in r for r in reasons if r)


def write(folder, tables, **meta):
    row = write_drive(folder, {"drive": "town", **meta}, tables["imu"], tables["gnss"], tables["reference"])
    write_drives_table(folder, [row])


@pytest.fixture
def tables():
    return {kind: frame.copy() for kind, frame in car(60).items()}


def test_samples_beyond_full_scale_and_far_fixes_are_left_out_and_counted(tmp_path, tables):
    """One specific force of 1e30 m/s², one rate of 100 rad/s, one fix at 0°/0°: the drive without them."""
    clean = {kind: frame.copy() for kind, frame in tables.items()}
    tables["imu"].loc[2000, "accel_x"], tables["imu"].loc[2500, "gyro_z"] = 1e30, 100.0
    tables["gnss"].loc[20, ["lat_deg", "lon_deg"]] = 0.0
    write(tmp_path / "bad", tables)
    drive = load_dataset(tmp_path / "bad")[0]
    assert drive.refused == Refused(2, 1) and str(drive.refused) == "2 samples and 1 fix"
    clean["imu"], clean["gnss"] = clean["imu"].drop([2000, 2500]), clean["gnss"].drop(20)
    write(tmp_path / "less", clean)
    less = load_dataset(tmp_path / "less")[0]
    assert less.refused == Refused()
    assert torch.equal(drive.imu, less.imu) and torch.equal(drive.gnss_valid, less.gnss_valid)
    assert drive.imu.abs().max() < FULL_SCALE[0]


def change(kind: str, column: str, rows, by):
    def apply(tables: dict[str, pd.DataFrame]) -> None:
        tables[kind].loc[rows, column] = by(tables[kind].loc[rows, column])

    return apply


REFUSED = {
    "accelerations": (change("imu", "accel_x", slice(0, None, 50), lambda x: x + 1e6), "120 of 6000 samples.*400 m/s²"),
    "a run of them": (change("imu", "accel_x", slice(3000, 3040), lambda x: x + 1e6), "IMU gap.*41 samples beyond"),
    "velocities": (change("gnss", "vel_n", slice(None), lambda x: 1000 * x), "fixes are impossible.*a velocity of"),
    "a jump": (change("gnss", "lat_deg", slice(30, None), lambda x: x + 2.7), "positions jump by 300 km before t = 40"),
    "frozen": (change("gnss", "lat_deg", slice(None), lambda x: 0 * x + 48.7), "fixes are impossible.*frozen receiver"),
    "1σ": (change("gnss", "std_pos_n", slice(None), lambda x: x + 1e30), "fixes are impossible.*1σ beyond"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_many_of_them_are_one_line(tmp_path, tables, case):
    apply, expected = REFUSED[case]
    if case == "frozen":
        tables["gnss"]["lon_deg"] = 9.0
    apply(tables)
    write(tmp_path, tables)
    with pytest.raises(InputError, match=expected) as error:
        load_dataset(tmp_path)
    assert "drive town" in str(error.value) and "\n" not in str(error.value)


def test_a_lever_arm_of_kilometres_and_whole_degrees_are_refused(tmp_path, tables):
    write(tmp_path / "arm", tables, lever_arm_x_m=1e6)
    with pytest.raises(InputError, match=r"drive town: a lever arm of 1e\+06 m"):
        load_dataset(tmp_path / "arm")
    write(tmp_path / "whole", tables)
    path = drive_file(tmp_path / "whole", "gnss", "town")
    tables["gnss"].assign(lat_deg=48).to_parquet(path)
    with pytest.raises(InputError, match="lat_deg is int64: whole degrees"):
        load_dataset(tmp_path / "whole")


def test_flipped_bits_are_seen_by_their_checksum(tmp_path, tables):
    """One bit in the data of a table is enough, wherever it lies."""
    write(tmp_path, tables)
    path = drive_file(tmp_path, "imu", "town")
    whole = bytearray(path.read_bytes())
    end = pq.ParquetFile(path).metadata.row_group(0).column(0).total_compressed_size
    for at in (200, end // 2, len(whole) // 2):
        flipped = bytearray(whole)
        flipped[at] ^= 1
        path.write_bytes(bytes(flipped))
        with pytest.raises(InputError, match="not a whole Parquet file"):
            load_dataset(tmp_path)
    path.write_bytes(bytes(whole))
    assert load_dataset(tmp_path)


def test_numbers_that_no_float_holds_exactly_are_read(tmp_path, tables):
    write(tmp_path, tables)
    path = drive_file(tmp_path, "gnss", "town")
    table = pa.Table.from_pandas(tables["gnss"], preserve_index=False)
    quality = pa.array([2**60] + [4] * (len(table) - 1), pa.int64())
    pq.write_table(table.set_column(table.schema.get_field_index("quality"), "quality", quality), path)
    assert load_dataset(tmp_path)[0].refused == Refused()
