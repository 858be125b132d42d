"""Tables and matrices: pandas, scipy, h5py, numpy; KITTI's layout by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from tests.cars import Tables
from tests.data.logs.clock import AXES, TOW, UNIX, nanoseconds

STDS = [
    "reader.gnss.std_position.columns=[std_pos_n, std_pos_e, std_pos_d]",
    "reader.gnss.std_velocity.columns=[std_vel_n, std_vel_e, std_vel_d]",
    "reader.gnss.quality.column=quality",
]


def csv(folder: Path, tables: Tables) -> list[str]:
    """pandas."""
    for kind in ("imu", "gnss"):
        tables[kind].to_csv(folder / f"{kind}.csv", index=False)
    return ["reader=csv", *STDS]


def parquet(folder: Path, tables: Tables) -> list[str]:
    """pandas: Parquet with a time type for the IMU, Feather for GNSS."""
    stamp = pd.to_datetime(nanoseconds(tables["imu"]["t"], UNIX), utc=True)
    tables["imu"].drop(columns="t").assign(stamp=stamp).to_parquet(folder / "imu.parquet")
    tables["gnss"].assign(t=UNIX + tables["gnss"]["t"]).to_feather(folder / "gnss.feather")
    time = ["reader.imu.time={column: stamp, unit: ns, clock: unix}", "reader.gnss.time.clock=unix"]
    return ["reader=parquet", *time, *STDS]


def _navego(tables: Tables) -> dict[str, dict[str, np.ndarray]]:
    imu, gnss = tables["imu"], tables["gnss"]
    place = {"lat": np.radians(gnss.lat_deg.to_numpy()), "lon": np.radians(gnss.lon_deg.to_numpy())}
    stds = {"stdm": np.array([0.02] * 3), "stdv": np.array([0.05] * 3), "larm": np.zeros(3), "freq": np.array(1.0)}
    return {
        "imu": {"t": imu.t.to_numpy(), "fb": imu[list(AXES[:3])].to_numpy(), "wb": imu[list(AXES[3:])].to_numpy()},
        "gnss": {"t": gnss.t.to_numpy(), **place, "h": gnss.height_m.to_numpy(), **stds}
        | {"vel": gnss[["vel_n", "vel_e", "vel_d"]].to_numpy()},
    }


def navego(folder: Path, tables: Tables) -> list[str]:
    """scipy.io: NaveGo's structures, version 5."""
    import scipy.io

    scipy.io.savemat(folder / "drive.mat", _navego(tables), oned_as="column")
    return ["reader=navego", "reader.gnss.quality.default=4"]


def navego_73(folder: Path, tables: Tables) -> list[str]:
    """h5py: the same as MATLAB's version 7.3 keeps it, matrices transposed."""
    import h5py

    with h5py.File(folder / "drive.mat", "w", userblock_size=512) as file:
        for name, fields in _navego(tables).items():
            for field, value in fields.items():
                file.create_dataset(f"{name}/{field}", data=np.atleast_2d(value) if value.ndim < 2 else value.T)
    with (folder / "drive.mat").open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    return ["reader=navego", "reader.gnss.quality.default=4"]


def matlab(folder: Path, tables: Tables) -> list[str]:
    """scipy.io: plain matrices."""
    import scipy.io

    imu, gnss = tables["imu"], tables["gnss"]
    names = ["t", "lat_deg", "lon_deg", "height_m", "vel_n", "vel_e", "vel_d", "std_pos_n", "std_vel_n"]
    whole = {"imu_data": imu[["t", *AXES[3:], *AXES[:3]]].to_numpy(), "gps": gnss[names].to_numpy()}
    scipy.io.savemat(folder / "drive.mat", whole)
    own = ["reader.imu.table=imu_data", "reader.gnss.table=gps", "reader.gnss.quality.default=4"]
    return ["reader=matlab", *own, "reader.gnss.std_position.columns=[7]", "reader.gnss.std_velocity.columns=[8]"]


def kitti(folder: Path, tables: Tables) -> list[str]:
    """The layout of KITTI's development kit (dataformat.txt), by hand: nothing writes it any more."""
    imu, state = tables["imu"], tables["fine"]
    (folder / "oxts" / "data").mkdir(parents=True)
    stamps = np.array(nanoseconds(imu["t"], UNIX), "datetime64[ns]").astype(str)
    (folder / "oxts" / "timestamps.txt").write_text("\n".join(s.replace("T", " ") for s in stamps) + "\n")
    flip = np.array([1.0, -1, -1])
    for k, (row, at) in enumerate(zip(imu.to_dict("records"), state.to_dict("records"))):
        f, w = (flip * [row[f"{s}_{a}"] for a in "xyz"] for s in ("accel", "gyro"))
        values = [at["lat_deg"], at["lon_deg"], at["height_m"], 0.0, 0.0, 0.0, at["vel_n"], at["vel_e"], 0.0, 0.0]
        values += [-at["vel_d"], *f, *f, *w, *w, 0.02, 0.05, 4, 10, 4, 4, 0]
        (folder / "oxts" / "data" / f"{k:010d}.txt").write_text(" ".join(f"{x:.12g}" for x in values) + "\n")
    return ["reader=kitti", "reader.reference.file=null", "reader.gnss.quality.default=4"]


def kfgins(folder: Path, tables: Tables) -> list[str]:
    """As KF-GINS' own sample: fixed columns, a blank at the end of a line; s of week, increments, degrees, stds."""
    imu, gnss = tables["imu"], tables["gnss"]
    values = imu[[*AXES[3:], *AXES[:3]]].to_numpy() * 0.01
    np.savetxt(folder / "Leador-A15.txt", np.column_stack((TOW + imu.t, values)), fmt="%14.6f" + " %20.13g" * 6 + " ")
    names = ["lat_deg", "lon_deg", "height_m", "std_pos_n", "std_pos_e", "std_pos_d"]
    form = "%.3f  %15.10f %16.10f %10.3f %8.3f %8.3f %8.3f "
    np.savetxt(folder / "GNSS-RTK.txt", np.column_stack((TOW + gnss.t, gnss[names])), fmt=form)
    return ["reader=kfgins"]
