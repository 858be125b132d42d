"""Receivers' logs: u-blox by pyubx2, NMEA by pynmeagps, RTKLIB by pyrtklib, NovAtel by its own EDIE."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from tests.cars import Tables
from tests.data.logs.clock import DEG, TOW, UNIX, WEEK, imu_table


def _ubx(path: Path, tables: Tables, sample: Callable[[int, dict[int, int]], Any]) -> None:
    """NAV-PVT, NAV-HPPOSLLH, NAV-COV; ``sample`` makes an IMU message of a time tag (ms of its own clock) and words."""
    from pyubx2 import GET, UBXMessage

    imu, gnss = tables["imu"], tables["gnss"]
    steps = {16: ("accel_x", 2.0**-10), 17: ("accel_y", 2.0**-10), 18: ("accel_z", 2.0**-10)}
    steps |= {14: ("gyro_x", DEG * 2**-12), 13: ("gyro_y", DEG * 2**-12), 5: ("gyro_z", DEG * 2**-12)}
    values = {kind: np.round(imu[name] / step).astype(int).to_numpy() for kind, (name, step) in steps.items()}
    out, at = [], 0
    for _, fix in gnss.iterrows():
        while at < len(imu) and imu["t"].iloc[at] <= fix.t - 1e-9:
            tag = (4_000_000_000 + round(1000 * imu["t"].iloc[at])) % 2**32
            out.append(sample(tag, {kind: int(values[kind][at]) & 0xFFFFFF for kind in steps}))
            at += 1
        itow = round(1000 * (TOW + fix.t))
        date = np.datetime64(UNIX + int(fix.t), "s").astype(object)
        common = {"year": date.year, "month": date.month, "day": date.day, "hour": date.hour, "min": date.minute}
        common |= {"second": date.second, "validDate": 1, "validTime": 1, "fixType": 3, "gnssFixOk": 1, "carrSoln": 2}
        speeds = {f"vel{a.upper()}": round(1000 * fix[f"vel_{a}"]) for a in "ned"}
        place = {"lat": round(fix.lat_deg, 7), "lon": round(fix.lon_deg, 7), "height": round(1000 * fix.height_m)}
        out.append(UBXMessage("NAV", "NAV-PVT", GET, iTOW=itow, **common, **speeds, **place, hAcc=20, vAcc=20, sAcc=50))
        rest = {f"_HP{n}": round((fix[f"{n}_deg"] - place[n]) * 1e9) * 1e-9 for n in ("lat", "lon")}
        fine = {**place, **rest}
        out.append(UBXMessage("NAV", "NAV-HPPOSLLH", GET, iTOW=itow, **fine))
        spread = {f"posCov{a}{a}": fix[f"std_pos_{a.lower()}"] ** 2 for a in "NED"}
        spread |= {f"velCov{a}{a}": fix[f"std_vel_{a.lower()}"] ** 2 for a in "NED"}
        out.append(UBXMessage("NAV", "NAV-COV", GET, iTOW=itow, posCovValid=1, velCovValid=1, **spread))
    path.write_bytes(b"".join(m.serialize() for m in out))


def ubx(folder: Path, tables: Tables) -> list[str]:
    """pyubx2, the IMU in ESF-RAW."""
    from pyubx2 import GET, UBXMessage

    def sample(tag: int, words: dict[int, int]) -> Any:
        groups = ((word | kind << 24).to_bytes(4, "little") + tag.to_bytes(4, "little") for kind, word in words.items())
        return UBXMessage("ESF", "ESF-RAW", GET, payload=bytes(4) + b"".join(groups))

    _ubx(folder / "drive.ubx", tables, sample)
    return ["reader=ubx"]


def ubx_fixes(path: Path, tables: Tables) -> None:
    """pyubx2, no IMU in it."""
    _ubx(path, {**tables, "imu": tables["imu"][:0]}, lambda tag, words: None)


def ubx_meas(folder: Path, tables: Tables) -> list[str]:
    """pyubx2, the IMU in ESF-MEAS."""
    from pyubx2 import GET, UBXMessage

    def sample(tag: int, words: dict[int, int]) -> Any:
        head = tag.to_bytes(4, "little") + (len(words) << 11).to_bytes(2, "little") + bytes(2)
        groups = ((word | kind << 24).to_bytes(4, "little") for kind, word in words.items())
        return UBXMessage("ESF", "ESF-MEAS", GET, payload=head + b"".join(groups))

    _ubx(folder / "drive.ubx", tables, sample)
    return ["reader=ubx"]


def sentences(tables: Tables) -> list[tuple[float, Any]]:
    """pynmeagps: RMC, GGA and GST of every fix, with its time."""
    from pynmeagps import GET, NMEAMessage

    out = []
    for _, fix in tables["gnss"].iterrows():
        date = np.datetime64(UNIX + int(fix.t), "s").astype(object)
        time, day = date.time(), date.date()
        speed, course = np.hypot(fix.vel_n, fix.vel_e) * 3600 / 1852, np.degrees(np.arctan2(fix.vel_e, fix.vel_n)) % 360
        place = {"lat": fix.lat_deg, "lon": fix.lon_deg}
        stds = {"stdLat": fix.std_pos_n, "stdLong": fix.std_pos_e, "stdAlt": fix.std_pos_d}
        extra = {"quality": 4, "numSV": 20, "HDOP": 0.6, "altUnit": "M", "sep": 47.1, "sepUnit": "M"}
        height = round(fix.height_m - 47.1, 3)
        rmc = {"status": "A", "date": day, "spd": round(speed, 4), "cog": round(course, 4)}
        out.append((fix.t, NMEAMessage("GN", "RMC", GET, hpnmeamode=True, time=time, **rmc, **place)))
        out.append((fix.t, NMEAMessage("GN", "GGA", GET, hpnmeamode=True, time=time, alt=height, **place, **extra)))
        out.append((fix.t, NMEAMessage("GN", "GST", GET, time=time, **stds)))
    return out


def nmea(folder: Path, tables: Tables) -> list[str]:
    """pynmeagps; the IMU in Unix milliseconds."""
    whole = b"".join(m.serialize() for _, m in sentences(tables))
    (folder / "drive.nmea").write_bytes(b"noise\r\n" + whole)
    imu_table(folder, tables["imu"], UNIX * 1000 + (1000 * tables["imu"]["t"]).round(6))
    return ["reader=nmea", "reader.imu.time.unit=ms"]


def _pos(path: Path, gnss: pd.DataFrame, **options: int) -> None:
    """RTKLIB's own outsolhead and outsol, by pyrtklib; ``options`` of its solopt_t."""
    import pyrtklib as rtk

    chosen, usual = rtk.solopt_t(), rtk.solopt_default
    numbers = "datum degf geoid height maxsolstd outhead outopt outvel posf solstatic sstat timef times timeu trace"
    for name in numbers.split():
        setattr(chosen, name, options.get(name, 1 if name == "outvel" else getattr(usual, name)))
    chosen.sep.set(usual.sep)

    def three(values: Any) -> Any:
        out = rtk.Arr1Ddouble(3)
        for k, value in enumerate(values):
            out[k] = float(value)
        return out

    file = rtk.FileWrapper(str(path), "w")  # closes itself when it goes
    rtk.outsolhead(file, chosen)
    for r in gnss.to_dict("records"):
        place, ecef, speed = three((*np.radians((r["lat_deg"], r["lon_deg"])), r["height_m"])), three(()), three(())
        rtk.pos2ecef(place, ecef)
        rtk.enu2ecef(place, three((r["vel_e"], r["vel_n"], -r["vel_d"])), speed)
        solution = rtk.sol_t()
        solution.time = rtk.gpst2time(WEEK, TOW + r["t"])
        solution.stat, solution.ns, solution.age, solution.ratio = 1, 20, 0.5, 99.9
        for k in range(3):
            solution.rr[k], solution.rr[3 + k], solution.qr[k], solution.qv[k] = ecef[k], speed[k], 0.02**2, 0.05**2
        rtk.outsol(file, solution, three((0, 0, 0)), chosen)


def rtklib(folder: Path, tables: Tables) -> list[str]:
    """RTKLIB 2.4.3 by pyrtklib: calendar time (GPST), degrees, with velocities."""
    _pos(folder / "drive.pos", tables["gnss"])
    imu_table(folder, tables["imu"].assign(week=WEEK), TOW + tables["imu"]["t"])
    return ["reader=rtklib", "reader.imu.time.week=week"]


def rtklib_ecef(folder: Path, tables: Tables) -> list[str]:
    """The same in ECEF, GPS weeks and seconds."""
    _pos(folder / "drive.pos", tables["gnss"], posf=1, timef=0)
    imu_table(folder, tables["imu"].assign(week=WEEK), TOW + tables["imu"]["t"])
    return ["reader=rtklib", "reader.imu.time.week=week"]


def rtklib_dms(folder: Path, tables: Tables) -> list[str]:
    """The same in degrees, minutes and seconds, and UTC; no velocities."""
    _pos(folder / "drive.pos", tables["gnss"], degf=1, times=1, outvel=0)
    imu_table(folder, tables["imu"].assign(week=WEEK), TOW + tables["imu"]["t"])
    return ["reader=rtklib", "reader.imu.time.week=week"]


def _novatel(path: Path, tables: Tables, imu: Callable[[str, str], str]) -> list[str]:
    """BESTPOSA with undulation, BESTVELA, and the IMU's log in counts, taken in and written out by NovAtel's EDIE."""
    import novatel_edie
    from novatel_edie import oem

    parser, accel, gyro = oem.Parser(), 2.0**-26, 2.0**-30
    out: list[bytes] = []

    def add(text: str) -> None:
        sum_of = novatel_edie.calculate_crc(text[1:].encode())
        parser.write(f"{text}*{sum_of:08x}\r\n".encode())
        out.append(parser.read().to_ascii().message)

    for r in tables["imu"].to_dict("records"):
        tow = TOW + r["t"]
        f, w = ([round(0.01 * r[f"{s}_{a}"] / c) for a in "xyz"] for s, c in (("accel", accel), ("gyro", gyro)))
        add(imu(f"{tow:.3f}", f"{f[2]},{-f[1]},{f[0]},{w[2]},{-w[1]},{w[0]}"))
    for r in tables["gnss"].to_dict("records"):
        tow = f"{TOW + r['t']:.3f}"
        speed, course = np.hypot(r["vel_n"], r["vel_e"]), np.degrees(np.arctan2(r["vel_e"], r["vel_n"])) % 360
        head = f"COM1,0,60.5,FINESTEERING,{WEEK},{tow},02000000,cdba,16809"
        place = f"{r['lat_deg']:.11f},{r['lon_deg']:.11f},{r['height_m'] - 47.1:.4f},47.1000,WGS84,0.02,0.02,0.02"
        add(f'#BESTPOSA,{head};SOL_COMPUTED,NARROW_INT,{place},"",0,0,20,20,20,20,00,06,39,33')
        add(f"#BESTVELA,{head};SOL_COMPUTED,NARROW_INT,0.0,0.0,{speed:.6f},{course:.6f},{-r['vel_d']:.6f},0.0")
    path.write_bytes(b"".join(out))
    return ["reader=novatel", f"reader.imu.accel.unit={accel!r}", f"reader.imu.gyro.unit={gyro!r}"]


def novatel(folder: Path, tables: Tables) -> list[str]:
    """EDIE, RAWIMUSA."""
    return _novatel(
        folder / "drive.asc", tables, lambda tow, counts: f"%RAWIMUSA,{WEEK},{tow};{WEEK},{tow}000000,00000077,{counts}"
    )


def novatel_x(folder: Path, tables: Tables) -> list[str]:
    """EDIE, RAWIMUSXA."""
    return _novatel(
        folder / "drive.asc",
        tables,
        lambda tow, counts: f"%RAWIMUSXA,{WEEK},{tow};00,11,{WEEK},{tow}000000,00000077,{counts}",
    )


def inertial_explorer(folder: Path, tables: Tables) -> list[str]:
    """An export in the layout of Inertial Explorer 8 (header, names, units), degrees-minutes-seconds, by hand."""
    head = "Project:     town\nProgram:     Inertial Explorer Version 8.90.2428\nDatum:       WGS84\n\n"
    names = "Week GPSTime Latitude Longitude H-Ell VEast VNorth VUp SDEast SDNorth SDHeight VESD VNSD VUSD Q"
    marks = "(weeks) (sec) (+/-D M S) (+/-D M S) (m) (m/s) (m/s) (m/s) (m) (m) (m) (m/s) (m/s) (m/s) (1-6)"

    def dms(x: float) -> str:
        size = abs(x)
        minutes = (size % 1) * 60
        return f"{'-' if x < 0 else ''}{int(size)} {int(minutes):02d} {(minutes % 1) * 60:.7f}"

    lines = [
        f" {WEEK} {TOW + r['t']:.3f} {dms(r['lat_deg'])} {dms(r['lon_deg'])} {r['height_m']:.4f} {r['vel_e']:.5f} "
        f"{r['vel_n']:.5f} {-r['vel_d']:.5f} 0.020 0.020 0.020 0.050 0.050 0.050 1"
        for r in tables["gnss"].to_dict("records")
    ]
    (folder / "drive.txt").write_text(head + names + "\n" + marks + "\n" + "\n".join(lines) + "\n")
    imu = tables["imu"].assign(week=WEEK)
    imu_table(folder, imu, TOW + imu["t"])
    own = ["reader.imu.time.week=week", "reader.gnss.std_velocity.columns=[VESD, VNSD, VUSD]"]
    return ["reader=inertial_explorer", *own, "reader.gnss.std_velocity.frame=enu"]
