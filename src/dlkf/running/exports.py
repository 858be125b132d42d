"""A solution in the formats of other programs: maps (GeoJSON, KML, GPX), receivers (NMEA, RTKLIB .pos), evo, CSV.

All functions take the rows of ``solution.parquet`` and write one file. ``when`` is the UTC time of every row
(:func:`utc_times`); None where the date is unknown: then tracks have no times, and NMEA and ``.pos``, which cannot do
without, count seconds from midnight of 6 January 1980 (GPS week 0). These two also take the ``quality`` of
every row (:func:`find_row_qualities`).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from datetime import UTC, datetime, timedelta
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pymap3d
from numpy.typing import NDArray

from dlkf.base.errors import InputError
from dlkf.data.readers.units import GPS_EPOCH_UNIX, SPEED, WEEK_S, clock_by_size, gps_seconds, leap_seconds
from dlkf.data.resampling import ON_BOUNDARY_S
from dlkf.data.tables import DriveClock
from dlkf.running.bag_exports import write_bag

Times = list[datetime] | None
DEAD_RECKONING = 6  # NMEA GGA quality
GGA = {9: 2}  # quality as the standard has it, which counts SBAS as differential
RMC = {1: "A", 2: "D", 3: "P", 4: "R", 5: "F", 6: "E", 9: "D"}  # mode of a quality
RTKLIB_CODES = (
    "% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,3:sbas,4:dgps,5:single,6:ppp,7:dr,ns=# of satellites)"
)
RTKLIB = {1: 5, 2: 4, 3: 6, 4: 1, 5: 2, 6: 7, 9: 3}  # Q of a quality: single, DGPS, PPP, fix, float, DR, SBAS
NED_ENU = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])  # and Forward-Right-Down → Forward-Left-Up is diag(1, −1, −1)


def utc_times(table: pd.DataFrame, clock: DriveClock | None, counts: str = "auto") -> Times:
    """UTC of every row. ``counts``: auto, by the receiver's own stamps where these have the date, else by the clock of
    the log files, whose size separates unix from gps; unix or gps forces one, receiver or not."""
    if counts not in ("auto", "unix", "gps", "none"):
        raise InputError(f"export_clock={counts} is none of auto, unix, gps, none")
    if counts == "none" or clock is None:
        return None
    t = table["t"].to_numpy()
    if counts == "auto" and np.isfinite(clock.gps_s):
        counts, seconds = "gps", clock.gps_s + clock.gps_rate * t
    else:
        seconds = clock.file_s + t
        known = clock_by_size(seconds[0]) if counts == "auto" else counts
        if known is None or not np.isfinite(clock.file_s):
            return None
        counts = known
    if counts == "gps":
        seconds = seconds + GPS_EPOCH_UNIX
        seconds = seconds - leap_seconds(seconds - leap_seconds(seconds))
    start = datetime(1970, 1, 1, tzinfo=UTC)
    return [start + timedelta(microseconds=round(s * 1e6)) for s in seconds]


def find_row_qualities(
    table: pd.DataFrame, t: NDArray[np.floating], quality: NDArray[np.integer]
) -> NDArray[np.integer]:
    """NMEA GGA quality of every row: of the last of the fixes at ``t`` where one was used, else dead reckoning."""
    last = np.searchsorted(t, table["t"].to_numpy() + ON_BOUNDARY_S, side="right") - 1
    return np.where(table["gnss_used"], quality[last.clip(0)], DEAD_RECKONING)


def write_geojson(path: Path, table: pd.DataFrame, when: Times, name: str) -> None:
    """RFC 7946: the track as a line, and a point a row with time, speed, heading and horizontal 1σ."""
    place = table[["lon_deg", "lat_deg", "height_m"]].to_numpy()
    speed, course = _speed(table), np.degrees(table["yaw"].to_numpy()) % 360
    sigma = np.hypot(table["std_pos_n"].to_numpy(), table["std_pos_e"].to_numpy())
    line = {"type": "LineString", "coordinates": _round(place)}
    features = [{"type": "Feature", "properties": {"name": name}, "geometry": line}]
    for k, point in enumerate(_round(place)):
        properties: dict[str, Any] = {"t": float(table["t"].iloc[k]), "speed_mps": round(float(speed[k]), 3)}
        properties |= {"heading_deg": round(float(course[k]), 2), "gnss_used": bool(table["gnss_used"].iloc[k])}
        if np.isfinite(sigma[k]):
            properties["std_horizontal_m"] = round(float(sigma[k]), 4)
        if when is not None:
            properties["time"] = _iso(when[k])
        features.append(
            {"type": "Feature", "properties": properties, "geometry": {"type": "Point", "coordinates": point}}
        )
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}), encoding="utf-8")


def write_kml(path: Path, table: pd.DataFrame, when: Times, name: str) -> None:
    """For Google Earth: a track with times where the date is known, else a line."""
    import simplekml

    kml = simplekml.Kml(name=name)
    places = [tuple(p) for p in table[["lon_deg", "lat_deg", "height_m"]].to_numpy()]
    if when is not None:
        track = kml.newgxtrack(name=name)
        track.newwhen(list(map(_iso, when)))
        track.newgxcoord(places)
    else:
        track = kml.newlinestring(name=name, coords=places)
    track.altitudemode = simplekml.AltitudeMode.clamptoground  # heights are above the ellipsoid, not above the sea
    track.style.linestyle.width, track.style.linestyle.color = 4, simplekml.Color.rgb(0, 114, 178)
    kml.save(str(path))


def write_gpx(path: Path, table: pd.DataFrame, when: Times, name: str) -> None:
    """GPX 1.1 track; its elevation is the ellipsoidal height."""
    import gpxpy.gpx as gpx

    segment = gpx.GPXTrackSegment()
    for k, (lat, lon, height) in enumerate(table[["lat_deg", "lon_deg", "height_m"]].to_numpy()):
        at = when[k] if when else None
        segment.points.append(gpx.GPXTrackPoint(round(lat, 9), round(lon, 9), round(height, 3), at))
    track = gpx.GPXTrack(name=name)
    track.segments.append(segment)
    content = gpx.GPX()
    content.creator = "dlkf"
    content.tracks.append(track)
    path.write_text(content.to_xml(version="1.1"), encoding="utf-8")


def write_nmea(path: Path, table: pd.DataFrame, when: Times, name: str, quality: NDArray[np.integer]) -> None:
    """GGA, RMC and GST a row, to the millisecond; the height is the ellipsoid's."""
    from pynmeagps import GET, NMEAMessage

    start = datetime(1980, 1, 6, tzinfo=UTC)
    lines = []
    course = np.degrees(np.arctan2(table["vel_e"].to_numpy(), table["vel_n"].to_numpy())) % 360
    speed = _speed(table) / SPEED["knots"]
    rows: Iterator[Any] = iter(table.itertuples())
    for k, row in enumerate(rows):
        at = when[k] if when is not None else start + timedelta(seconds=float(row.t))
        at += timedelta(microseconds=500)
        clock = f"{at:%H%M%S}.{at.microsecond // 1000:03d}"
        place = (*_dm(row.lat_deg, "NS", 2), *_dm(row.lon_deg, "EW", 3))
        code = int(quality[k])
        gga = [clock, *place, str(GGA.get(code, code)), "00", "", f"{row.height_m:.3f}", "M", "0.000", "M", "", ""]
        rmc = [clock, "A", *place, f"{speed[k]:.3f}", f"{course[k]:.2f}", f"{at:%d%m%y}", "", "", RMC[code]]
        sentences = [("GGA", gga), ("RMC", rmc)]
        if np.isfinite(row.std_pos_n):
            std = [f"{x:.4f}" for x in (row.std_pos_n, row.std_pos_e, row.std_pos_d)]
            sentences.append(("GST", [clock, "", "", "", "", *std]))
        for kind, payload in sentences:
            lines.append(str(NMEAMessage("GN", kind, GET, payload=payload).serialize(), "ascii"))
    path.write_text("".join(lines), encoding="ascii", newline="")


def write_pos(path: Path, table: pd.DataFrame, when: Times, name: str, quality: NDArray[np.integer]) -> None:
    """RTKLIB's solution file in GPS week and time of week, with its codes of quality."""
    gps = table["t"].to_numpy() if when is None else gps_seconds(np.array([w.timestamp() for w in when]))
    week = np.floor(gps / WEEK_S)
    std = [table[f"std_pos_{a}"].fillna(0).to_numpy() for a in "ned"]
    head = "%  GPST               latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)"
    head += "  sdne(m)  sdeu(m)  sdun(m) age(s)  ratio    vn(m/s)    ve(m/s)    vu(m/s)"
    lines = [f"% program   : dlkf, {name}", RTKLIB_CODES, head]
    rows: Iterator[Any] = iter(table.itertuples())
    for k, row in enumerate(rows):
        text = f"{week[k]:4.0f} {gps[k] - week[k] * WEEK_S:10.3f} {row.lat_deg:14.9f} {row.lon_deg:14.9f} "
        text += f"{row.height_m:10.4f} {RTKLIB[int(quality[k])]:3d}   0"
        text += f" {std[0][k]:8.4f} {std[1][k]:8.4f} {std[2][k]:8.4f}"
        text += "   0.0000   0.0000   0.0000   0.00    0.0 "
        lines.append(text + f"{row.vel_n:10.5f} {row.vel_e:10.5f} {-row.vel_d:10.5f}")
    path.write_text("\n".join(lines) + "\n", encoding="ascii", errors="replace")


def write_tum(path: Path, table: pd.DataFrame, when: Times, name: str) -> None:
    """For evo: t x y z qx qy qz qw; East-North-Up from the first row, attitude of Forward-Left-Up axes in it."""
    from scipy.spatial.transform import Rotation

    position, rotation = poses(table)
    q = Rotation.from_matrix(rotation).as_quat()
    t = table["t"].to_numpy() if when is None else np.array([w.timestamp() for w in when])
    rows = np.column_stack((t, position, q))
    np.savetxt(path, rows, fmt=["%.6f"] + ["%.5f"] * 3 + ["%.9f"] * 4)


def write_kitti(path: Path, table: pd.DataFrame, when: Times, name: str) -> None:
    """For evo: the upper three rows of the pose matrix a line, in the axes of :func:`write_tum`."""
    position, rotation = poses(table)
    np.savetxt(path, np.concatenate((rotation, position[..., None]), -1).reshape(-1, 12), fmt="%.9e")


def write_csv(path: Path, table: pd.DataFrame, when: Times, name: str) -> None:
    """All columns of ``solution.parquet``, and the UTC time first where the date is known."""
    if when is not None:
        table = table.set_axis([_iso(t) for t in when]).rename_axis("utc")
    table.to_csv(path, index=when is not None, float_format="%.12g", lineterminator="\n", encoding="utf-8")


def write_ros(path: Path, table: pd.DataFrame, when: Times, name: str) -> None:
    """MCAP for Foxglove and ROS 2, or a bag of ROS 1: NavSatFix and Odometry (extra ``readers``)."""
    write_bag(path, table, when, poses(table))


def poses(table: pd.DataFrame) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Positions (T, 3) East-North-Up [m] from the first row, and rotations (T, 3, 3) of Forward-Left-Up into it."""
    from scipy.spatial.transform import Rotation

    lat, lon, height = (table[c].to_numpy() for c in ("lat_deg", "lon_deg", "height_m"))
    position = np.stack(pymap3d.geodetic2enu(lat, lon, height, lat[0], lon[0], height[0]), -1)
    rpy = table[["yaw", "pitch", "roll"]].to_numpy()
    C_nb = Rotation.from_euler("ZYX", rpy).as_matrix()
    return position, NED_ENU @ C_nb @ np.diag([1.0, -1.0, -1.0])


FORMATS: Mapping[str, tuple[str, Callable[..., None]]] = {
    "geojson": ("solution.geojson", write_geojson),
    "kml": ("solution.kml", write_kml),
    "gpx": ("solution.gpx", write_gpx),
    "nmea": ("solution.nmea", write_nmea),
    "pos": ("solution.pos", write_pos),
    "tum": ("solution.tum", write_tum),
    "kitti": ("solution.kitti", write_kitti),
    "csv": ("solution.csv", write_csv),
    "mcap": ("solution.mcap", write_ros),
    "bag": ("solution.bag", write_ros),
}
OF_RECEIVERS = ("nmea", "pos")  # formats that have the quality of a fix
OF_EXTRA = ("mcap", "bag")  # formats that need the extra ``readers``


def choose_formats(export: str | list[str] | None, key: str = "export") -> list[str]:
    """Names of formats; ``all`` for every one. InputError for an unknown one, by the ``key`` that gave it."""
    if export is not None and not isinstance(export, (str, list, tuple)):
        raise InputError(f"{key}={export}: must be a format or a list of formats; known: {', '.join(FORMATS)}, all")
    names = [] if export is None else [export] if isinstance(export, str) else list(export)
    if names == ["all"]:
        if find_spec("rosbags") is not None:
            return list(FORMATS)
        print(
            f"{key}=all: without {' and '.join(OF_EXTRA)}, which need the extra readers (pip install -e '.[readers]')"
        )
        return [n for n in FORMATS if n not in OF_EXTRA]
    if unknown := [n for n in names if n not in FORMATS]:
        raise InputError(f"{key}={unknown[0]}: unknown format; known: {', '.join(FORMATS)}, all")
    return names


def export(
    folder: Path, table: pd.DataFrame, names: list[str], when: Times, drive: str, quality: NDArray[np.integer]
) -> None:
    """One file a format beside ``solution.parquet``."""
    for name in names:
        file, write = FORMATS[name]
        write(folder / file, table, when, drive, *([quality] if name in OF_RECEIVERS else []))


def _iso(when: datetime) -> str:
    return when.isoformat().replace("+00:00", "Z")


def _speed(table: pd.DataFrame) -> NDArray[np.floating]:
    return np.hypot(table["vel_n"].to_numpy(), table["vel_e"].to_numpy())


def _round(place: NDArray[np.floating]) -> list[list[float]]:
    return [[round(lon, 9), round(lat, 9), round(height, 3)] for lon, lat, height in place.tolist()]


def _dm(degrees: float, signs: str, digits: int) -> tuple[str, str]:
    """Degrees and minutes as NMEA writes them: ``4807.0380000``, ``N``."""
    size = round(abs(degrees) * 60, 7)
    whole = int(size // 60)
    return f"{whole:0{digits}d}{size - 60 * whole:010.7f}", signs[degrees < 0]
