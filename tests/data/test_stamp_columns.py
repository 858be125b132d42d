"""Which columns of a table are its stamps, and rows that repeat those of the row before."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from dlkf.base.errors import InputError
from dlkf.data.readers.auto import AutoReader
from tests.data.logs.clock import UNIX
from tests.data.test_csv import log_reader
from tests.data.test_foreign_tables import ENGLISH, Tables, box, fixes, read


def test_fixes_written_several_times_with_their_own_stamp(tmp_path: Path, drive: Tables) -> None:
    """Three or four rows of each; no fix is lost where the car stands."""
    gnss = drive["gnss"].copy()
    gnss.loc[40:50, ["lat_deg", "lon_deg", "height_m"]] = gnss.loc[40, ["lat_deg", "lon_deg", "height_m"]].to_numpy()
    box(drive["imu"]).to_csv(tmp_path / "a.csv", index=False)
    table = fixes(gnss, ENGLISH, timestamps=UNIX + gnss.t)
    again = table.loc[np.repeat(table.index, 3 + table.index % 2)]
    again.to_csv(tmp_path / "b.csv", index=False)
    got, notes = read(tmp_path, {**drive, "gnss": gnss})
    assert f"took {len(gnss)} of {len(again)} rows for fixes: the others repeat the stamp and position before" in notes
    assert got.mapping["gnss"]["rows"] == "once"


def test_the_stamps_that_settings_name_count(tmp_path: Path, drive: Tables) -> None:
    """Of two columns that rise, under any name; without the settings the table is refused."""
    box(drive["imu"]).to_csv(tmp_path / "a.csv", index=False)
    t = drive["gnss"].t
    fixes(drive["gnss"], ENGLISH, beat=t, drum=3 * t).to_csv(tmp_path / "b.csv", index=False)
    with pytest.raises(InputError, match="lacks stamps that can be read"):
        list(AutoReader().read(tmp_path))
    for named in ({"column": "beat"}, {"column": "beat", "unit": "s"}):
        (got,) = AutoReader(gnss={"time": named}).read(tmp_path)
        np.testing.assert_allclose(got.gnss.t, t, atol=0.012)


def test_repeated_rows_of_any_reader(tmp_path: Path, drive: Tables) -> None:
    for kind in ("imu", "gnss"):
        drive[kind].loc[np.repeat(drive[kind].index, 2)].to_csv(tmp_path / f"{kind}.csv", index=False)
    (got,) = log_reader(imu__rows="once", gnss__rows="once").read(tmp_path)
    for kind, table in (("imu", got.imu), ("gnss", got.gnss)):
        pd.testing.assert_frame_equal(table[["t"]], drive[kind][["t"]], check_exact=False, rtol=0, atol=1e-6)
