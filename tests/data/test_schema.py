"""What is written is what is read, and nothing is left behind when writing fails."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from dlkf.base.errors import InputError
from dlkf.data.schema import SCHEMAS, drive_file, new_dataset, write_drive, write_drives_table
from dlkf.data.tables import dataset_digest, read_drives, read_table


def test_tables_come_back_with_the_contracts_columns_and_types(tmp_path, tables):
    extra = tables["reference"].assign(accel_error_x=0.1)
    row = write_drive(tmp_path, {"drive": "a", "lever_arm_x_m": 1.5}, tables["imu"], tables["gnss"], extra)
    write_drives_table(tmp_path, [row])
    for kind, schema in SCHEMAS.items():
        on_disk = pq.ParquetFile(drive_file(tmp_path, kind, "a")).schema_arrow
        assert [on_disk.field(n).type for n in schema.names] == list(schema.types)
        back = read_table(tmp_path, kind, "a")
        for name in schema.names:
            assert np.array_equal(back[name], tables[kind][name].to_numpy())
    assert "accel_error_x" in read_table(tmp_path, "reference", "a")
    drive = read_drives(tmp_path)[0]
    assert (drive.name, drive.group, drive.lever_arm_b) == ("a", "a", (1.5, 0.0, 0.0))
    table = pd.read_parquet(tmp_path / "drives.parquet")
    assert table.imu_rate_hz[0] == pytest.approx(100) and table.gnss_rate_hz[0] == pytest.approx(1)
    # the mean speed is 10 m/s plus what is left of the sine over 60 s: 3/0.2 (1 − cos 12) = 2.3 m
    assert table.distance_m[0] == pytest.approx(600 + 15 * (1 - np.cos(12)), abs=0.5)


def test_other_engines_read_the_dataset_as_it_is(town):
    import pyarrow.dataset as ds

    imu = ds.dataset(town / "imu", partitioning="hive").to_table(columns=["drive", "t"])
    assert imu.num_rows == 6 * 6000 and set(imu["drive"].unique().to_pylist()) == {f"car-{k}" for k in range(6)}


def test_a_missing_column_is_named(tmp_path, tables):
    with pytest.raises(InputError, match="drive a, imu: column gyro_y missing"):
        write_drive(tmp_path, {"drive": "a"}, tables["imu"].drop(columns="gyro_y"), tables["gnss"])


@pytest.mark.parametrize("name", ["", "a/b", "a=b", ".a", " a"])
def test_names_that_cannot_be_paths_are_refused(tmp_path, tables, name):
    with pytest.raises(InputError, match="name"):
        write_drive(tmp_path, {"drive": name}, tables["imu"], tables["gnss"])


def test_a_dataset_appears_whole_or_not_at_all(tmp_path, tables):
    target = tmp_path / "set"
    with pytest.raises(RuntimeError), new_dataset(target) as folder:
        write_drive(folder, {"drive": "a"}, tables["imu"], tables["gnss"])
        raise RuntimeError
    assert not list(tmp_path.iterdir())
    with new_dataset(target) as folder:
        (folder / "drives.parquet").write_bytes(b"1")
    assert [p.name for p in tmp_path.iterdir()] == ["set"]
    with pytest.raises(InputError, match="exists already"), new_dataset(target):
        pass
    with new_dataset(target, overwrite=True) as folder:
        (folder / "other").write_bytes(b"2")
    assert [p.name for p in target.iterdir()] == ["other"] and len(list(tmp_path.iterdir())) == 1


def test_the_digest_knows_contents_and_not_dates(tmp_path, tables):
    digests = []
    for k, shift in enumerate((0.0, 0.0, 1e-9)):
        imu = tables["imu"].assign(gyro_x=tables["imu"].gyro_x + shift)
        row = write_drive(tmp_path / str(k), {"drive": "a"}, imu, tables["gnss"])
        write_drives_table(tmp_path / str(k), [row])
        digests.append(dataset_digest(tmp_path / str(k)))
    assert digests[0] == digests[1] != digests[2] and len(digests[0]) == 32
