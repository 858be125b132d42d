"""Drives from text tables: any columns, units, axes, clocks, told by a mapping (``conf/reader/csv.yaml``)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from dlkf.data.readers import units
from dlkf.data.readers.frames import DriveFrames
from dlkf.data.schema import ACCEL, ATTITUDE, GYRO, POSITION, STD, VELOCITY
from dlkf.errors import InputError

Spec = Mapping[str, Any]


class CsvReader:
    """Reads a folder with one set of files, or one subfolder per drive.

    ``imu``, ``gnss`` and ``reference`` say file, columns, units and axes as the comments of
    ``conf/reader/csv.yaml`` explain; the other arguments are the format of the text and the drive's row in
    ``drives.parquet``. All errors are InputErrors with file, and column or line.
    """

    def __init__(
        self,
        imu: Spec,
        gnss: Spec,
        reference: Spec | None = None,
        *,
        separator: str = ",",
        decimal: str = ".",
        header: bool = True,
        comment: str | None = None,
        skip_rows: int = 0,
        time_zero: str = "imu",
        drive: str | None = None,
        group: str | None = None,
        lever_arm_m: Sequence[float] = (0.0, 0.0, 0.0),
        meta: Spec | None = None,
    ) -> None:
        if time_zero not in ("imu", "keep"):
            raise InputError(
                f"reader.time_zero={time_zero}: must be imu (count from the first sample) or keep"
            )
        if len(lever_arm_m) != 3:
            raise InputError(
                f"reader.lever_arm_m={list(lever_arm_m)}: must be three numbers, IMU → antenna, FRD"
            )
        self.imu, self.gnss = imu, gnss
        self.reference = reference if reference and reference.get("file") else None
        self.separator, self.decimal, self.header = separator, decimal, header
        self.comment, self.skip_rows, self.time_zero = comment, skip_rows, time_zero
        self.drive, self.group, self.lever_arm_m, self.meta = drive, group, lever_arm_m, dict(meta or {})

    def read(self, source: str | Path) -> Iterator[DriveFrames]:
        """The drives of a folder, in the order of their names."""
        source = Path(source)
        if not source.is_dir():
            raise InputError(
                f"source={source}: no such folder; it holds the CSV files, or one subfolder per drive"
            )
        if list(source.glob(self.imu["file"])):
            yield self._drive(source, self.drive or source.absolute().name)
            return
        folders = sorted(p for p in source.iterdir() if p.is_dir() and not p.name.startswith("."))
        if not folders:
            raise InputError(
                f"source={source}: no file {self.imu['file']} and no subfolders; set reader.imu.file"
            )
        for folder in folders:
            yield self._drive(folder, folder.name)

    def _drive(self, folder: Path, name: str) -> DriveFrames:
        tables = {"imu": self._table(folder, self.imu, "imu"), "gnss": self._table(folder, self.gnss, "gnss")}
        if self.reference is not None:
            tables["reference"] = self._table(folder, self.reference, "reference")
        stamps = {kind: table.stamps() for kind, table in tables.items()}
        zero = int(stamps["imu"][0][0]) if self.time_zero == "imu" else 0
        t = {kind: (whole - zero) + part for kind, (whole, part) in stamps.items()}
        meta = {"drive": name, "group": self.group or name, "time_zero_s": float(zero), **self.meta}
        meta |= dict(zip(("lever_arm_x_m", "lever_arm_y_m", "lever_arm_z_m"), map(float, self.lever_arm_m)))
        reference = tables.get("reference")
        return DriveFrames(
            meta,
            _imu_frame(tables["imu"], t["imu"]),
            _gnss_frame(tables["gnss"], t["gnss"]),
            None if reference is None else _reference_frame(reference, t["reference"]),
        )

    def _table(self, folder: Path, spec: Spec, kind: str) -> _Table:
        found = sorted(folder.glob(str(spec["file"])))
        if len(found) != 1:
            have = ", ".join(sorted(p.name for p in folder.iterdir() if p.is_file())[:8]) or "nothing"
            what = "no" if not found else f"{len(found)} files match, one must be"
            raise InputError(
                f"{folder}: {what} {kind} file {spec['file']}; has {have}; set reader.{kind}.file"
            )
        path = found[0]
        try:
            frame = pd.read_csv(
                path,
                sep=self.separator,
                decimal=self.decimal,
                header=0 if self.header else None,
                comment=self.comment,
                skiprows=self.skip_rows,
                skipinitialspace=True,
            )
        except (pd.errors.ParserError, pd.errors.EmptyDataError, UnicodeDecodeError) as error:
            raise InputError(
                f"{path}: cannot be read as a table: {str(error).splitlines()[0].strip()}"
            ) from None
        frame.columns = [str(c).strip() for c in frame.columns]
        if not len(frame):
            raise InputError(f"{path}: has no rows; leave the drive out or give its data")
        return _Table(path, frame, spec, kind, self.skip_rows + (2 if self.header else 1))


class _Table:
    """A text table with the part of the mapping that explains it."""

    def __init__(self, path: Path, frame: pd.DataFrame, spec: Spec, kind: str, first_line: int) -> None:
        self.path, self.frame, self.spec, self.kind, self.first_line = path, frame, spec, kind, first_line

    def column(self, name: str | int, *, nan: bool) -> np.ndarray:
        """A column as numbers; empty cells are NaN where ``nan`` allows."""
        name = str(name)
        if name not in self.frame:
            have = ", ".join(self.frame.columns)
            raise InputError(f"{self.path}: no column {name!r}; has {have}; set it in reader.{self.kind}")
        values = self.frame[name]
        if not pd.api.types.is_numeric_dtype(values) or pd.api.types.is_bool_dtype(values):
            empty = values.isna() | (values.astype(str).str.strip() == "")
            numbers = pd.to_numeric(values.astype(str).str.strip(), errors="coerce")
            bad = np.flatnonzero(
                (numbers.isna() & ~empty & (values.astype(str).str.lower() != "nan")).to_numpy()
            )
            if len(bad):
                self._fail(int(bad[0]), name, f"is {values.iloc[bad[0]]!r}, not a number; mend the line")
            values = numbers
        if not nan and bool(values.isna().any()):
            self._fail(int(np.flatnonzero(values.isna())[0]), name, "is empty; mend or remove the line")
        return values.to_numpy()

    def vector(self, key: str, count: tuple[int, ...], *, nan: bool) -> np.ndarray:
        """The columns of an entry of the mapping, as floats (rows, n)."""
        names = self.spec[key]["columns"]
        if len(names) not in count:
            many = " or ".join(str(c) for c in count)
            raise InputError(f"reader.{self.kind}.{key}.columns has {len(names)} names, must have {many}")
        return np.stack([self.column(n, nan=nan).astype(float) for n in names], -1)

    def has(self, key: str) -> bool:
        """Whether the mapping explains an optional entry."""
        return bool(self.spec.get(key)) and bool(
            self.spec[key].get("columns") or self.spec[key].get("column")
        )

    def stamps(self) -> tuple[np.ndarray, np.ndarray]:
        """Whole seconds and the rest of the rows' times, offset included."""
        time = self.spec["time"]
        week = self.column(time["week"], nan=False) if time.get("week") is not None else None
        values = self.column(time["column"], nan=False)
        whole, part = units.seconds(values, time.get("unit", "s"), week, time.get("clock"), str(self.path))
        return whole, part + float(time.get("offset_s") or 0.0)

    def scale(self, key: str, table: Mapping[str, float], name: str = "unit") -> float:
        """SI per unit of an entry; the first unit of the table if the entry has none."""
        unit = self.spec[key].get(name)
        where = f"reader.{self.kind}.{key}.{name}"
        return units.factor(next(iter(table)) if unit is None else unit, table, where)

    def _fail(self, row: int, name: str, what: str) -> None:
        raise InputError(f"{self.path}: line {row + self.first_line}: column {name!r} {what}")


def _imu_frame(table: _Table, t: np.ndarray) -> pd.DataFrame:
    step = np.diff(t, prepend=np.nan)
    usual = float(np.median(step[1:])) if len(t) > 1 else float("nan")
    step[0] = usual
    out: dict[str, np.ndarray] = {}
    for key, names, known in (("gyro", GYRO, units.RATE), ("accel", ACCEL, units.ACCELERATION)):
        values = table.vector(key, (3,), nan=False) * table.scale(key, known)
        turn = units.rotation(table.spec[key].get("axes", "frd"), f"reader.imu.{key}.axes")
        if table.spec.get("increments"):
            values = values / step[:, None]
        out |= dict(zip(names, (values @ turn.T).T))
    late = {"end": 0.0, "middle": 0.5, "start": 1.0}
    stamp = table.spec.get("stamp", "end")
    if stamp not in late:
        raise InputError(f"reader.imu.stamp={stamp}: must be end, middle or start of the sample's interval")
    return pd.DataFrame({"t": t + late[stamp] * usual, **out})


def _positions(table: _Table) -> dict[str, np.ndarray]:
    llh = table.vector("position", (3,), nan=True)
    angle = table.scale("position", {"deg": 1.0, "rad": 1 / units.DEG, "1e-7deg": 1e-7})
    height = table.scale("position", units.LENGTH, "height_unit")
    return dict(zip(POSITION, (llh[:, 0] * angle, llh[:, 1] * angle, llh[:, 2] * height)))


def _velocities(table: _Table) -> dict[str, np.ndarray]:
    if not table.has("velocity"):
        return dict.fromkeys(VELOCITY, np.full(len(table.frame), np.nan))
    v = table.vector("velocity", (2, 3), nan=True)
    frame = table.spec["velocity"].get("frame", "ned")
    speed = table.scale("velocity", units.SPEED)
    third = v[:, 2] * speed if v.shape[1] == 3 else np.full(len(v), np.nan)
    if frame == "course":  # speed over ground, course over ground [deg], climb
        course = v[:, 1] * units.DEG
        return dict(
            zip(VELOCITY, (speed * v[:, 0] * np.cos(course), speed * v[:, 0] * np.sin(course), -third))
        )
    if frame not in ("ned", "enu"):
        raise InputError(f"reader.{table.kind}.velocity.frame={frame}: must be ned, enu or course")
    north, east = (v[:, 1], v[:, 0]) if frame == "enu" else (v[:, 0], v[:, 1])
    return dict(zip(VELOCITY, (speed * north, speed * east, -third if frame == "enu" else third)))


def _stds(table: _Table, key: str, known: Mapping[str, float]) -> list[np.ndarray]:
    """North, East, Down from three columns, or from one for all, or from horizontal and vertical."""
    if not table.has(key):
        return [np.full(len(table.frame), np.nan)] * 3
    s = table.vector(key, (1, 2, 3), nan=True) * table.scale(key, known)
    columns = {
        1: [0, 0, 0],
        2: [0, 0, 1],
        3: [1, 0, 2] if table.spec[key].get("frame") == "enu" else [0, 1, 2],
    }
    return [s[:, k] for k in columns[s.shape[1]]]


def _gnss_frame(table: _Table, t: np.ndarray) -> pd.DataFrame:
    frame = {"t": t, **_positions(table), **_velocities(table)}
    stds = _stds(table, "std_position", units.LENGTH) + _stds(table, "std_velocity", units.SPEED)
    frame |= dict(zip(STD, stds))
    fixed = np.all([np.isfinite(frame[c]) for c in POSITION], axis=0)
    return pd.DataFrame({**frame, "quality": np.where(fixed, _quality(table), 0).astype(np.int8)})


def _quality(table: _Table) -> np.ndarray:
    """NMEA GGA codes: through ``map`` where one is given, else the column as it is, else ``default``."""
    spec = table.spec.get("quality") or {}
    name = spec.get("column")
    if name is None:
        return np.full(len(table.frame), int(spec.get("default", 1)))
    if not spec.get("map"):
        return np.nan_to_num(table.column(name, nan=True)).astype(np.int64)
    codes = {str(k): int(v) for k, v in spec["map"].items()}
    if str(name) not in table.frame:
        table.column(name, nan=True)
    values = table.frame[str(name)].map(
        lambda v: str(int(v)) if isinstance(v, float) and v.is_integer() else str(v)
    )
    values = values.str.strip()
    unknown = sorted(set(values) - set(codes))
    if unknown and "default" not in spec:
        raise InputError(f"{table.path}: quality {unknown[0]!r} is not in reader.gnss.quality.map; add it")
    return values.map(codes).fillna(int(spec.get("default") or 0)).to_numpy().astype(np.int64)


def _reference_frame(table: _Table, t: np.ndarray) -> pd.DataFrame:
    frame = {"t": t, **_positions(table), **_velocities(table)}
    frame |= dict.fromkeys(ATTITUDE, np.full(len(t), np.nan))
    if table.has("attitude"):
        rpy = table.vector("attitude", (3,), nan=True) * table.scale("attitude", units.ANGLE | {})
        convention = table.spec["attitude"].get("convention", "ned")
        if convention == "enu":  # Forward-Left-Up in East-North-Up, yaw counter-clockwise from East
            rpy = np.stack((rpy[:, 0], -rpy[:, 1], np.pi / 2 - rpy[:, 2]), -1)
        elif convention != "ned":
            raise InputError(f"reader.reference.attitude.convention={convention}: must be ned or enu")
        rpy[:, 2] = np.mod(rpy[:, 2] + np.pi, 2 * np.pi) - np.pi
        frame |= dict(zip(ATTITUDE, rpy.T))
    valid = np.all([np.isfinite(frame[c]) for c in (*POSITION, *VELOCITY)], axis=0)
    if table.has("valid"):
        marks = table.column(table.spec["valid"]["column"], nan=True)
        good = table.spec["valid"].get("values")
        valid &= np.isin(marks, good) if good else np.nan_to_num(marks) != 0
    return pd.DataFrame({**frame, "valid": valid})
