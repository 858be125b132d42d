"""Receiver logs of several recordings, of a receiver that finds its date late, and ones that end within a line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from dlkf.data.readers.formats import nmea, novatel, ubx
from tests.cars import car
from tests.data.logs.receivers import ubx_fixes

PLACE = "5100.0000,N,01000.0000,E"
SECOND = 10**9


def log(*sentences: str) -> pd.DataFrame:
    """The fixes of NMEA sentences that are given without frame and checksum."""
    sums = [int(np.bitwise_xor.reduce(np.frombuffer(x.encode(), np.uint8))) for x in sentences]
    text = "\r\n".join(f"${x}*{s:02X}" for x, s in zip(sentences, sums))
    return nmea.fixes(nmea.sentences(text.encode()), "town.nmea")


def rmc(time: str, date: str) -> str:
    return f"GPRMC,{time},A,{PLACE},10.0,90.0,{date},,,A"


def gga(time: str, quality: str = "1") -> str:
    return f"GPGGA,{time},{PLACE},{quality},08,1.0,100.0,M,47.0,M,,"


def stamps(*utc: str) -> list[int]:
    return [int(np.datetime64(x, "ns").astype(np.int64)) for x in utc]


@pytest.mark.parametrize("second", ["05T11:00:00", "05T09:00:00", "02T11:00:00", "02T09:00:00"])
def test_two_recordings_in_an_nmea_log_have_a_date_each(second):
    day, time = second.split("T")
    time = time.replace(":", "") + ".00"
    found = log(rmc("100000.00", "010126"), gga("100000.00"), rmc(time, f"{day}0126"), gga(time))
    assert found["utc_ns"].tolist() == stamps("2026-01-01T10:00:00", f"2026-01-{second}")


def test_a_date_that_comes_after_midnight_is_that_of_its_row():
    """GGA at 2 Hz, RMC every 2 s: two fixes of the new day before its date, two before any."""
    times = [f"2359{s:04.1f}0" for s in (58, 58.5, 59, 59.5)] + [f"0000{s:04.1f}0" for s in (0, 0.5, 1, 1.5)]
    dated = {2: rmc(times[2], "010126"), 6: rmc(times[6], "020126")}
    found = log(*(x for k, t in enumerate(times) for x in (gga(t), dated.get(k)) if x))
    first = stamps("2026-01-01T23:59:58")[0]
    assert found["utc_ns"].tolist() == [first + k * SECOND // 2 for k in range(8)]


def test_the_date_of_a_clock_that_is_not_set_holds_only_until_there_is_another():
    found = log(rmc("000001.00", "060180"), gga("000001.00", "0"), rmc("100000.00", "010126"), gga("100000.00"))
    assert found["utc_ns"].iloc[1] == stamps("2026-01-01T10:00:00")[0]


def test_empty_cells_of_nmea_are_unknown():
    found = log("GPZDA,100000.00,,,2026,00,00", gga("100000.00", ""), rmc("100001.00", "010126"), gga("100001.00"))
    assert found["quality"].tolist() == [0, 1]
    assert found["utc_ns"].tolist() == stamps("2026-01-01T10:00:00", "2026-01-01T10:00:01")


def test_two_recordings_a_week_apart_in_a_ubx_log(tmp_path: Path):
    """They have the same times of the week, and NAV-HPPOSLLH and NAV-COV that belong to one of them."""
    first = car(12)
    moved = {**first, "gnss": first["gnss"].assign(t=first["gnss"]["t"] + ubx.WEEK_S, lat_deg=48.1234567891)}
    for name, tables in (("a", first), ("b", moved)):
        ubx_fixes(tmp_path / name, tables)
    both = tmp_path / "both.ubx"
    both.write_bytes(b"".join((tmp_path / name).read_bytes() for name in "ab"))
    found = ubx.read(both, kind="gnss", table=None, text={}).frame
    assert len(found) == 2 * len(first["gnss"])
    np.testing.assert_allclose(np.diff(found["t_ns"]) / SECOND, np.diff([*first["gnss"]["t"], *moved["gnss"]["t"]]))
    np.testing.assert_allclose(found["lat_deg"], [*first["gnss"]["lat_deg"], *moved["gnss"]["lat_deg"]], atol=1e-9)


HEAD = "COM1,0,60.0,FINESTEERING,2100,{},02000000,cdba,16809"
BESTPOS = "#BESTPOSA," + HEAD + ';SOL_COMPUTED,SINGLE,51.1,10.2,100.0,47.0,WGS84,1.0,1.0,2.0,"",0,0,9,9,9,9,0,6,3,3'
CUT = ("#BESTPOSA,COM1,0,60.0,FINESTEERING,2100,1005.0,0,0,0;SOL_COMPUTED,SINGLE,51.1", "#BESTPOSA,COM1,0;SOL")


@pytest.mark.parametrize("last", [*CUT, BESTPOS.format(1005.0)])
def test_a_cut_line_of_novatel_is_left_out(last, tmp_path):
    """Its cells or its checksum are missing."""
    whole = [BESTPOS.format(1000.0 + k) + ("*0a1b2c3d" if last.startswith(BESTPOS[:30]) else "") for k in range(5)]
    path = tmp_path / "town.asc"
    path.write_text("\n".join((*whole, last)))
    found = novatel.read(path, kind="gnss", table=None, text={})
    assert found.frame["sow"].tolist() == [1000.0 + k for k in range(5)]
    assert found.notes == ("town.asc: 1 damaged or cut line left out",)


def test_a_cut_line_of_novatel_s_imu_is_left_out(tmp_path):
    path = tmp_path / "town.asc"
    rows = [f"%RAWIMUSA,2100,{t};2100,{t},00000000,1,2,3,4,5,6" for t in (1000.0, 1000.1)]
    path.write_text("\n".join((*rows, "%RAWIMUSA,2100,1000.2;2100,1000.2,00000000,1,2")))
    found = novatel.read(path, kind="imu", table=None, text={})
    assert found.frame["sow"].tolist() == [1000.0, 1000.1]
