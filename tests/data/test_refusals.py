"""Logs that are refused say what each file holds, what is missing and the key that mends it; damaged ones one line."""

from __future__ import annotations

import gzip
import re
import shutil
import zipfile
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest
import scipy.io
import yaml

import dlkf
from dlkf.base.errors import InputError
from dlkf.data.intake import IngestOptions, ingest
from dlkf.data.readers.auto import AutoReader
from dlkf.data.readers.logs import LogReader
from dlkf.data.readers.offers import recognise_file
from dlkf.data.schema import ACCEL, GYRO
from dlkf.data.tables import read_drives
from tests.cars import REAL, car
from tests.data.logs.clock import UNIX
from tests.data.logs.phones import gnss_logger, sensor_logger
from tests.data.test_auto import _hidden
from tests.data.test_csv import PLAIN
from tests.data.test_formats import read


def refusal(source: Path, **options) -> str:
    """The line that ``reader=auto`` refuses logs with."""
    with pytest.raises(InputError) as error:
        list(AutoReader(**options).read(source))
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.mark.parametrize("both", [False, True], ids=["accelerometer", "both"])
def test_a_left_handed_sensor(tmp_path, streets, both):
    """Refused with the axis to turn round; with that the log is read right."""
    imu = streets["imu"].copy()
    for names in (ACCEL, GYRO) if both else (ACCEL,):
        imu[names[1]] = -imu[names[1]]
    folder = tmp_path / "a"
    folder.mkdir()
    imu.to_csv(folder / "imu.csv", index=False)
    streets["gnss"].to_csv(folder / "gnss.csv", index=False)
    said = refusal(folder)
    assert (
        "not sure of reader.imu.accel.mirror" in said and "axes seem left-handed" in said and "best guess is y" in said
    )
    mirror = {"accel": {"mirror": "y"}, **({"gyro": {"mirror": "y"}} if both else {})}
    (got,) = AutoReader(imu=mirror).read(folder)
    for name in (*ACCEL, *GYRO):
        np.testing.assert_allclose(got.imu[name], streets["imu"][name], atol=0.05, err_msg=name)
    with pytest.raises(InputError, match=r"reader.imu.accel.mirror=w: must be x, y or z"):
        list(AutoReader(imu={"accel": {"mirror": "w"}}).read(folder))


def test_kf_gins_files_that_are_too_short_for_auto_name_the_preset(tmp_path):
    """With the command that reads them, which does."""
    tables = car(25)
    folder = tmp_path / "a"
    folder.mkdir()
    imu, gnss = tables["imu"], tables["gnss"]
    increments = imu[[*GYRO, *ACCEL]].to_numpy() * 0.01
    np.savetxt(folder / "box.txt", np.column_stack((345_600 + imu.t, increments)), fmt="%.10g")
    place = gnss[["lat_deg", "lon_deg", "height_m"]].to_numpy()
    stds = np.full((len(gnss), 3), 0.02)
    np.savetxt(folder / "rtk.txt", np.column_stack((345_600 + gnss.t, place, stds)), fmt="%.12g")
    said = refusal(folder)
    assert said.endswith("reader=kfgins reader.imu.file=box.txt reader.gnss.file=rtk.txt")
    (got,) = read(folder, said.partition("with its axes: ")[2].split())
    np.testing.assert_allclose(got.imu.accel_z, imu.accel_z, atol=1e-6)
    np.testing.assert_allclose(got.gnss.std_pos_n, 0.02)


def settings_of(line: str) -> dict:
    """The keys that a refusal names, as they would be given."""
    out: dict = {}
    for path, value in re.findall(r"reader\.([\w.]+)=([^\s,;]+)", line):
        *above, last = path.split(".")
        node = out
        for key in above:
            node = node.setdefault(key, {})
        node[last] = yaml.safe_load(value)
    return out


@pytest.mark.parametrize("name", ["rough", "wid-03-dot", "wid-04-dot"])
def test_fixes_that_jump_name_all_that_must_be_given(tmp_path, streets, name):
    """Positions alone, their noise above the car's motion: one line with every key and no guess; the keys mend it."""
    imu, gnss = streets["imu"], streets["gnss"].copy()
    if name == "rough":
        noise = np.random.default_rng(5).normal(0.0, 3.0 / 111_000, (len(gnss), 2))
        gnss[["lat_deg", "lon_deg"]] += noise
        gnss[["vel_n", "vel_e", "vel_d"]] = np.nan
    else:
        if not (REAL / "wid").is_dir():
            pytest.skip("needs the real drives")
        imu, gnss = (pd.read_parquet(REAL / "wid" / kind / f"drive={name}") for kind in ("imu", "gnss"))
    imu.to_csv(tmp_path / "imu.csv", index=False)
    gnss.to_csv(tmp_path / "gnss.csv", index=False)
    said = refusal(tmp_path)
    given = settings_of(said)
    assert given["gnss"]["time"]["offset_s"] == 0 and given["imu"]["accel"]["axes"] == "frd", said
    assert "if both files have one clock" in said and "best guess" not in said
    (got,) = AutoReader(**given).read(tmp_path)
    assert len(got.gnss) == len(gnss)
    np.testing.assert_allclose(got.imu[list(ACCEL)], imu[list(ACCEL)], atol=1e-6)


def test_files_of_two_clocks_are_not_taken_for_one(tmp_path, streets):
    """Hours apart: the line asks for the seconds, not for zero."""
    gnss = streets["gnss"].assign(vel_n=np.nan, vel_e=np.nan, vel_d=np.nan, t=streets["gnss"].t + 7200)
    gnss[["lat_deg", "lon_deg"]] += np.random.default_rng(5).normal(0.0, 3.0 / 111_000, (len(gnss), 2))
    streets["imu"].to_csv(tmp_path / "imu.csv", index=False)
    gnss.to_csv(tmp_path / "gnss.csv", index=False)
    assert "reader.gnss.time.offset_s=… (seconds to be added to its stamps)" in refusal(tmp_path)


def test_gnss_logger_without_gps_lines(tmp_path, streets):
    """Fused fixes alone: the line says which lines there are and how to take them; with that they are read."""
    tables = {"imu": streets["imu"], "gnss": streets["gnss"]}
    folder = tmp_path / "a"
    folder.mkdir()
    gnss_logger(folder, tables)
    (file,) = folder.iterdir()
    file.write_text(
        "\n".join(li for li in file.read_text().replace("Fix,GPS", "Fix,FLP").split("\n") if "NLP" not in li)
    )
    said = refusal(folder)
    assert "no line matches ^Fix,(GPS|gps)" in said and "Fix,FLP (" in said and "reader.gnss.lines='^Fix,FLP'" in said
    (got,) = AutoReader(gnss={"lines": "^Fix,FLP"}).read(folder)
    assert len(got.gnss) == len(streets["gnss"])


def test_a_phones_zip_is_taken_as_it_is(tmp_path, drive):
    """Alone, and among other drives; beside what a phone of Apple's adds; by reader=auto and by the app's own."""
    (tmp_path / "x").mkdir()
    options = sensor_logger(tmp_path / "x", drive)
    source = tmp_path / "logs" / "monday.zip"
    source.parent.mkdir()
    with zipfile.ZipFile(source, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in (tmp_path / "x").iterdir():
            archive.write(file, f"monday/{file.name}")
        archive.writestr("__MACOSX/monday/._Gyroscope.csv", "nothing")
    (got,) = AutoReader().read(source)
    (own,) = read(source, options)
    (again,) = AutoReader().read(source.parent)
    assert got.name == own.name == again.name == "monday" and len(own.gnss) == len(drive["gnss"])
    np.testing.assert_allclose(got.gnss.lat_deg, drive["gnss"].lat_deg, atol=1e-6)
    pd.testing.assert_frame_equal(got.imu, again.imu)


def test_a_zip_that_is_none_or_unpacks_without_end(tmp_path):
    (tmp_path / "a.zip").write_bytes(b"PK\3\4 nonsense")
    assert "no log that can be recognised" in refusal(tmp_path)
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("imu.csv", "0" * (100 << 20))
    assert "unpacks to 0.1 GiB, which no log of its size does" in refusal(tmp_path / "a.zip")
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.writestr("../../evil.csv", "t,ax,ay,az,gx,gy,gz\n")
    assert refusal(tmp_path / "a.zip").startswith(f"{tmp_path / 'a.zip'}: no IMU found") and not list(
        tmp_path.parent.glob("evil.csv")
    )


def test_matlab_matrices_and_a_phones_structures(tmp_path, streets):
    """Plain matrices under any name; structures as MATLAB Mobile has them, stamps as serial date numbers (10 µs)."""
    imu, gnss = streets["imu"], streets["gnss"]
    matrices = tmp_path / "matrices"
    matrices.mkdir()
    place = ["t", "lat_deg", "lon_deg", "height_m", "vel_n", "vel_e", "vel_d"]
    content = {"sensor": imu[["t", *GYRO, *ACCEL]].to_numpy(), "gps": gnss[place].to_numpy(), "note": "town"}
    scipy.io.savemat(matrices / "a.mat", content)
    phone = tmp_path / "phone"
    phone.mkdir()

    def days(t):
        return 719_529.0 + (UNIX + t.to_numpy()) / 86_400

    speed, course = np.hypot(gnss.vel_n, gnss.vel_e), np.degrees(np.arctan2(gnss.vel_e, gnss.vel_n)) % 360
    fix = {"Timestamp": days(gnss.t), "latitude": gnss.lat_deg, "longitude": gnss.lon_deg, "altitude": gnss.height_m}
    fix |= {"speed": speed, "course": course, "hacc": np.full(len(gnss), 3.0)}
    structures = {
        "Acceleration": {"Timestamp": days(imu.t), **{a: imu[c].to_numpy() for a, c in zip("XYZ", ACCEL)}},
        "AngularVelocity": {"Timestamp": days(imu.t), **{a: imu[c].to_numpy() for a, c in zip("XYZ", GYRO)}},
        "Position": {name: np.asarray(values) for name, values in fix.items()},
    }
    scipy.io.savemat(phone / "sensorlog.mat", structures)
    for folder in (matrices, phone):
        (got,) = AutoReader().read(folder)
        for name in (*ACCEL, *GYRO):
            np.testing.assert_allclose(got.imu[name], imu[name], atol=0.05, err_msg=name)
        np.testing.assert_allclose(got.gnss.vel_n, gnss.vel_n, atol=0.01)
    assert set(got.gnss.std_pos_n) == {3.0} and abs(got.meta["gps_zero_s"] - (UNIX - 315_964_782)) < 2
    scipy.io.savemat(matrices / "a.mat", {**content, "other": content["sensor"]})
    assert "sensor, other all hold IMU; choose one with reader.imu.table" in refusal(matrices)
    (got,) = AutoReader(imu={"table": "other"}).read(matrices)
    assert "a.mat: other" in got.notes[0]


def test_sensors_in_files_of_their_own(tmp_path, streets):
    """Three columns x, y, z, of which the file's name says the sensor."""
    imu = streets["imu"]
    for name, columns in (("accelerometer", ACCEL), ("gyroscope", GYRO)):
        table = pd.DataFrame({"t": imu.t, **{a: imu[c] for a, c in zip("xyz", columns)}})
        table.to_csv(tmp_path / f"{name}.csv", index=False)
    streets["gnss"].to_csv(tmp_path / "gps.csv", index=False)
    (got,) = AutoReader().read(tmp_path)
    np.testing.assert_allclose(got.imu.gyro_z, imu.gyro_z, atol=0.01)
    (tmp_path / "gyroscope.csv").unlink()
    assert "accelerometer.csv (csv with x, y, z, without a gyroscope); gps.csv (csv with" in refusal(tmp_path)


def test_what_each_file_holds_is_said(tmp_path, drive):
    """Of a folder that has half a sensor, a picture, a receiver's log, an empty file."""
    drive["imu"].drop(columns=list(GYRO)).to_csv(tmp_path / "acc.csv", index=False)
    drive["gnss"].drop(columns="height_m").to_csv(tmp_path / "fixes.csv", index=False)
    (tmp_path / "photo.jpg").write_bytes(b"\xff\xd8\0\0")
    (tmp_path / "empty.txt").touch()
    assert "lacks a height" in recognise_file(tmp_path / "fixes.csv").held
    said = refusal(tmp_path)
    for part in ("acc.csv (csv with accel_x", "photo.jpg (of no format that is known)", "empty.txt (empty)"):
        assert part in said, part


@pytest.mark.parametrize(("dead", "named"), [("gyro_z", "gyro_y is -0.1"), ("accel_x", "accel_x is 0.1")])
def test_a_dead_axis_is_named_in_any_pose(dead, named, tmp_path, streets):
    """Of a sensor on its side, whose y points up: it is no doubt of a unit."""
    imu = streets["imu"].assign(**{dead: 0.1})
    for sensor in ("gyro", "accel"):
        imu[[f"{sensor}_y", f"{sensor}_z"]] = np.column_stack((-imu[f"{sensor}_z"], imu[f"{sensor}_y"]))
    imu.to_csv(tmp_path / "imu.csv", index=False)
    streets["gnss"].to_csv(tmp_path / "gnss.csv", index=False)
    assert f"imu.csv: {named} in every row though the car turns" in refusal(tmp_path)


@pytest.mark.parametrize(("kept", "lacks"), [(ACCEL, "a gyroscope"), (GYRO, "an accelerometer")])
def test_the_sensor_that_an_imu_lacks_is_named(kept, lacks, tmp_path, drive):
    """In a table of its own, and beside fixes; where a file is given, the line begins with that file."""
    alone, both = tmp_path / "alone.csv", tmp_path / "both.csv"
    drive["imu"][["t", *kept]].to_csv(alone, index=False)
    pd.merge_asof(drive["gnss"], drive["imu"][["t", *kept]], on="t").to_csv(both, index=False)
    for file in (alone, both):
        said = refusal(file)
        assert said.startswith(f"{file}: no IMU found") and f", without {lacks})" in said


@pytest.mark.commands
def test_a_table_of_a_hundred_thousand_columns(tmp_path):
    (tmp_path / "a.csv").write_text("\n".join(",".join(f"{c}{k}" for k in range(100_000)) for c in ("c", "", "1")))
    assert "a table of 100000 columns, which no log has" in refusal(tmp_path)


def test_a_gzip_that_unpacks_without_end(tmp_path):
    (tmp_path / "imu.csv.gz").write_bytes(gzip.compress(b"0,1,2,3,4,5,6\n" * (10 << 20)))
    with pytest.raises(InputError, match=r"unpacks to more than 0\.062 GiB, which no log of its size does"):
        read(tmp_path, ["reader=csv", "reader.imu.file=imu.csv.gz"])


@pytest.mark.parametrize("seed", range(3))
def test_random_bytes_as_ubx(tmp_path, seed):
    """Random ones, and messages with sound checksums and nonsense in them."""
    from pyubx2 import GET, UBXMessage

    random = np.random.default_rng(seed)
    mess = random.bytes(20_000).replace(b"\0\0", b"$G").replace(b"\1", b"\xb5b\x01\x07")
    whole = [UBXMessage("NAV", "NAV-PVT", GET, payload=random.bytes(92)).serialize() for _ in range(50)]
    for content in (mess, b"".join(whole)):
        (tmp_path / "a.ubx").write_bytes(content)
        with pytest.raises(InputError, match=r"NAV-PVT|which are no motion|no IMU"):
            read(tmp_path / "a.ubx", ["reader=ubx"])


def test_hdf5_that_holds_itself_or_terabytes(tmp_path):
    """As MATLAB 7.3; read by its variable all the same, where that is one."""
    with h5py.File(tmp_path / "self.mat", "w", userblock_size=512) as file:
        file.create_group("imu")["again"] = file["/"]
        file["imu/again2"] = file["imu"]
    with h5py.File(tmp_path / "large.mat", "w", userblock_size=512) as file:
        file.create_dataset("imu", shape=(7, 1 << 40), dtype="f8", chunks=(7, 1024))
    for name in ("self", "large"):
        with (tmp_path / f"{name}.mat").open("r+b") as file:
            file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\0\2IM")
    with pytest.raises(InputError, match="has no rows"):
        read(tmp_path / "self.mat", ["reader=matlab"])
    with pytest.raises(InputError, match="holds a variable of 57344 GiB, which no log is"):
        read(tmp_path / "large.mat", ["reader=matlab"])


def test_an_unsure_drive_does_not_lose_the_others(tmp_path):
    """Short ones take pose, units and clocks of a long one; one whose clock was set anew is left out, or refused."""
    logs = tmp_path / "logs"
    noise = np.random.default_rng(1)
    for name, seconds in (("long", 100), ("short", 45), ("other", 45)):
        tables = car(seconds)
        tables["gnss"]["vel_n"] += noise.normal(0.0, 0.02, seconds + 1)
        tables["gnss"]["vel_e"] += noise.normal(0.0, 0.02, seconds + 1)
        _hidden(logs / name, tables)
    table = pd.read_csv(logs / "other" / "receiver.csv")
    table.assign(unix_time=table.unix_time + 77.0).to_csv(logs / "other" / "receiver.csv", index=False)
    notes = []
    with pytest.raises(InputError, match=r"drive other: not sure of .*; or skip_unsure=true leaves such drives out"):
        ingest(AutoReader(), logs, tmp_path / "out", IngestOptions(), parallel=None)
    assert not (tmp_path / "out").exists()
    options = {"parallel": None, "skip_unsure": True, "progress": lambda one, _: notes.extend(one.notes)}
    assert ingest(AutoReader(), logs, tmp_path / "out", IngestOptions(), **options) == 2
    assert {row.name for row in read_drives(tmp_path / "out")} == {"long", "short"}
    with pytest.warns(UserWarning, match="left out: drive other: not sure of"):
        frames = dlkf.read_logs(logs, skip_unsure=True)
    assert [one.name for one in frames] == ["long", "short"] and frames[1].notes[0].startswith("short: not sure by")
    (shared,) = (note for note in notes if note.startswith("short: not sure by itself"))
    assert "reader.imu.accel.axes={roll" in shared and "reader.imu.accel.unit=g" in shared and "offset_s=" in shared
    assert any(note.startswith("left out: drive other: not sure of") for note in notes)


def test_a_stray_folder_and_a_faulty_drive_do_not_stop_the_others(tmp_path, drive):
    """Refused with the option that leaves them out; with it each has a line, and no table of theirs is written."""
    logs = tmp_path / "logs"
    for name in ("a-bad", "b-good"):
        _hidden(logs / name, drive)
    fixes = pd.read_csv(logs / "a-bad" / "receiver.csv")
    fixes.loc[5, "Latitude"] += 100
    fixes.to_csv(logs / "a-bad" / "receiver.csv", index=False)
    (logs / "c-notes").mkdir()
    (logs / "c-notes" / "read.me").write_text("Tuesday: rain\n")
    with pytest.raises(InputError, match=r"lat_deg is 148.*; or skip_unsure=true leaves such drives out"):
        ingest(AutoReader(), logs, tmp_path / "out", IngestOptions(), parallel=None)
    notes = []
    options = {"parallel": None, "skip_unsure": True, "progress": lambda one, _: notes.extend(one.notes)}
    assert ingest(AutoReader(), logs, tmp_path / "out", IngestOptions(), **options) == 1
    left = [note for note in notes if note.startswith("left out: ")]
    assert len(left) == 2 and "lat_deg is 148" in left[0] and "c-notes: no IMU found in read.me" in left[1]
    assert not list((tmp_path / "out").rglob("*a-bad*")) and list((tmp_path / "out").rglob("*b-good*"))


def test_subfolders_beside_logs_are_named(tmp_path, drive):
    _hidden(tmp_path / "logs", drive)
    _hidden(tmp_path / "logs" / "monday", drive)
    (tmp_path / "logs" / "pictures").mkdir()
    (got,) = AutoReader().read(tmp_path / "logs")
    (said,) = (note for note in got.notes if note.startswith("subfolders that are not read"))
    assert "monday" in said and "pictures" not in said and got.name == "logs"


def test_drives_that_disagree_are_named(tmp_path, drive):
    """A sensor that was mounted anew: each drive has its own pose, and the difference is said."""
    logs = tmp_path / "logs"
    _hidden(logs / "a", drive)
    shutil.copytree(logs / "a", logs / "b")
    box = pd.read_csv(logs / "b" / "box.txt", sep=";")
    for s in ("acc", "gyr"):
        box[[f"{s}_x", f"{s}_y"]] = np.column_stack((box[f"{s}_y"], -box[f"{s}_x"]))
    box.to_csv(logs / "b" / "box.txt", index=False, sep=";")
    notes = []
    count = ingest(AutoReader(), logs, tmp_path / "out", IngestOptions(), parallel=None,
                   progress=lambda one, _: notes.extend(one.notes))  # fmt: skip
    (said,) = (n for n in notes if n.startswith("reader.imu.accel.axes is not the same in all drives: {roll"))
    assert count == 2 and said.endswith("; each keeps its own, set it if they are one")


def test_a_reader_with_settings_left_open_shares_them_too(tmp_path):
    """As reader=csv with auto in it."""
    logs = tmp_path / "logs"
    for name, seconds in (("long", 100), ("short", 15)):
        tables = car(seconds)
        (logs / name).mkdir(parents=True)
        for kind in ("imu", "gnss"):
            tables[kind].to_csv(logs / name / f"{kind}.csv", index=False)
    imu = {**PLAIN["imu"], **{k: {**PLAIN["imu"][k], "axes": "auto"} for k in ("accel", "gyro")}}
    notes = []
    count = ingest(LogReader(imu, PLAIN["gnss"]), logs, tmp_path / "out", IngestOptions(), parallel=None,
                   progress=lambda one, _: notes.extend(one.notes))  # fmt: skip
    assert count == 2 and any("short: not sure by itself" in n for n in notes)


def test_counts_are_refused_with_the_scales_to_give(tmp_path, drive):
    """A sensor's raw numbers: the line gives both scales, which read the log."""
    imu = drive["imu"].copy()
    imu[list(ACCEL)] = (imu[list(ACCEL)] / 9.80665 * 16384).round()
    imu[list(GYRO)] = (np.degrees(imu[list(GYRO)]) * 131).round()
    imu.to_csv(tmp_path / "imu.csv", index=False)
    drive["gnss"].to_csv(tmp_path / "gnss.csv", index=False)
    with pytest.raises(InputError) as refused:
        list(AutoReader().read(tmp_path))
    found = re.search(r"give reader.imu.accel.unit=(\S+) reader.imu.gyro.unit=([^\s,]+)", str(refused.value))
    accel, gyro = map(float, found.groups())
    (got,) = AutoReader({"accel": {"unit": accel}, "gyro": {"unit": gyro}}).read(tmp_path)
    # the median force of these turns is above gravity by 1.7 %
    np.testing.assert_allclose(got.imu[list(ACCEL)], drive["imu"][list(ACCEL)], atol=0.2)
    np.testing.assert_allclose(got.imu[list(GYRO)], drive["imu"][list(GYRO)], atol=0.01)
