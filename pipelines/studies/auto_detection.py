"""Does ``reader=auto`` find what was hidden, and refuse what it cannot know?

``python -m pipelines.studies.auto_detection docs/results/ingest.md --simulated data/hidden --real REAL``

Every drive is written as two text files with its IMU turned to a random pose, in random units, on a clock of its own
(up to 2 h away), GNSS late by up to 0.3 s; ``reader=auto`` reads them. Right is a pose within 2° (of the IMU's in the
simulated car, of the nominal axes of a real log) and an offset, delay included, within 20 ms. The GNSS of kitti was
made from its reference, so it has no offset; rtkx and comma2k19 have one of their own. ``data/hidden`` is

    python -m dlkf.simulate dataset=lifelike dataset.hours=2.5 dataset.drive_minutes=3 seed=11 out=data/hidden
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from dlkf.data.plausibility import check_clocks, check_gnss_units
from dlkf.data.readers import units
from dlkf.data.readers.auto import AutoReader
from dlkf.data.readers.units import rotation
from dlkf.data.schema import ACCEL, GYRO
from dlkf.data.tables import Columns, read_drives, read_table
from dlkf.errors import InputError
from dlkf.files import staged

UNIX = 1_751_760_000  # where the clocks of the logs stand
WIDE = {"angle_deg": 1e3, "time_s": 1e3}
POSE_DEG, OFFSET_S = 2.0, 0.02
ANGLES = {"deg": 1.0, "rad": np.pi / 180, "1e-7deg": 1e7}
MOTION_S, FAST = 60.0, 2.0
UNIT_SHARE = 0.04  # an accelerometer's bias; mg and cm/s² are 2 % apart


@dataclass(frozen=True)
class Hidden:
    """What a drive's files do not say."""

    turn: np.ndarray  # car → sensor
    units: dict[str, str]
    offset_s: float  # to be added to GNSS stamps
    delay_s: float


@dataclass(frozen=True)
class Outcome:
    """How it went with a drive."""

    drive: str
    motion_s: float
    sure: bool
    pose_deg: float
    offset_ms: float
    units_right: bool
    refused: str
    seconds: float
    drift_ppm: float = 0.0  # found between the clocks
    turn: np.ndarray | None = None  # rotation vector [rad] of the pose found against the nominal one
    lean: np.ndarray | None = None  # that of the sensor against a level car, as the reference has it in the mean

    @property
    def wrong(self) -> bool:
        """Given as sure, and not right."""
        right = self.pose_deg <= POSE_DEG and abs(self.offset_ms) <= 1000 * OFFSET_S and self.units_right
        return self.sure and not right


def hide(rng: np.random.Generator) -> Hidden:
    """A random disguise."""
    known = {"accel": ("m/s2", "g", "mg", "cm/s2"), "gyro": ("rad/s", "deg/s", "mdeg/s"), "time": tuple(units.TIME)}
    known |= {"speed": ("m/s", "km/h", "knots", "cm/s"), "angle": tuple(ANGLES)}
    chosen = {key: str(rng.choice(names)) for key, names in known.items()}
    turn = Rotation.random(rng=rng).as_matrix()
    return Hidden(turn, chosen, float(rng.uniform(-7200, 7200)), float(rng.uniform(0, 0.3)))


def write(folder: Path, imu: pd.DataFrame, gnss: pd.DataFrame, hidden: Hidden) -> None:
    """The two files of a drive in disguise."""
    ticks = units.TIME[hidden.units["time"]]
    stamps = [UNIX + imu["t"].to_numpy(), UNIX + gnss["t"].to_numpy() + hidden.delay_s - hidden.offset_s]
    whole = [np.round(t * ticks).astype(np.int64) if ticks > 1 else t for t in stamps]
    out = {"time": [repr(x) for x in whole[0].tolist()]}
    for name, columns, table in (("acc", ACCEL, units.ACCELERATION), ("gyr", GYRO, units.RATE)):
        factor = table[hidden.units["accel" if name == "acc" else "gyro"]]
        out |= {f"{name}_{a}": v for a, v in zip("xyz", (imu[list(columns)].to_numpy() @ hidden.turn.T / factor).T)}
    pd.DataFrame(out).to_csv(folder / "sensor.csv", index=False, float_format="%.9g")
    angle, speed = ANGLES[hidden.units["angle"]], units.SPEED[hidden.units["speed"]]
    fixes = {
        "time": [repr(x) for x in whole[1].tolist()],
        "latitude": gnss["lat_deg"] * angle,
        "longitude": gnss["lon_deg"] * angle,
    }
    fixes |= {"altitude": gnss["height_m"], **{f"v{a}": gnss[f"vel_{a}"] / speed for a in "ned"}}
    pd.DataFrame(fixes).to_csv(folder / "receiver.csv", index=False, float_format="%.13g")


PLAIN = Hidden(np.eye(3), {"accel": "m/s2", "gyro": "rad/s", "time": "ns", "speed": "m/s", "angle": "deg"}, 0.0, 0.0)


def tried(
    name: str, imu: pd.DataFrame, gnss: pd.DataFrame, mounting: np.ndarray, hidden: Hidden, own_ms: float = 0.0
) -> Outcome:
    """Hide a drive, read it, compare. ``mounting`` takes the IMU's axes before the disguise to the car's.

    ``own_ms`` is the offset that a log has without any disguise.
    """
    good = gnss[gnss["quality"] > 0]
    speed = np.hypot(good["vel_n"].to_numpy(), good["vel_e"].to_numpy())
    motion = float(np.sum(np.diff(good["t"])[speed[1:] > FAST]))
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        write(folder, imu, good, hidden)
        begin, refused = time.perf_counter(), ""
        try:
            (drive,) = AutoReader(lever_arm_m=[0, 0, 0]).read(folder)
        except InputError as error:
            refused = str(error)
        seconds = time.perf_counter() - begin
        if refused:
            try:
                (drive,) = AutoReader(lever_arm_m=[0, 0, 0], sure=WIDE).read(folder)
            except InputError:
                return Outcome(name, motion, False, np.nan, np.nan, False, refused, seconds)
    found = drive.mapping
    pose = rotation(found["imu"]["accel"]["axes"], "") @ hidden.turn @ mounting.T
    offset = found["gnss"]["time"]["offset_s"] - (hidden.offset_s - hidden.delay_s)
    said = found["imu"]["accel"]["unit"], found["imu"]["gyro"]["unit"], found["gnss"]["velocity"]["unit"]
    tables = units.ACCELERATION, units.RATE, units.SPEED
    factors = [units.factor(unit, table, "") for unit, table in zip(said, tables)]
    real = [table[hidden.units[key]] for key, table in zip(("accel", "gyro", "speed"), tables)]
    right = bool(np.allclose(factors, real, rtol=UNIT_SHARE))
    turn = Rotation.from_matrix(pose).as_rotvec()
    degrees = float(np.degrees(np.linalg.norm(turn)))
    drift = float(found["gnss"]["time"].get("drift_ppm") or 0.0)
    return Outcome(name, motion, not refused, degrees, 1000 * offset - own_ms, right, refused, seconds, drift, turn)


def run(
    dataset: Path, rng: np.random.Generator, own: bool = False, drift_ppm: float = 0.0, first: int | None = None
) -> list[Outcome]:
    """All drives of a dataset, or the first; with ``own`` the offset that a log is found to have as it is, is no error.

    The clock of the IMU is made to run faster by ``drift_ppm``, from the first fix on.
    """
    out = []
    for row in pd.read_parquet(dataset / "drives.parquet").to_dict("records")[:first]:
        name = str(row["drive"])
        imu, gnss = (pd.read_parquet(dataset / kind / f"drive={name}" / "part-0.parquet") for kind in ("imu", "gnss"))
        imu["t"] += 1e-6 * drift_ppm * (imu["t"] - gnss["t"].iloc[0])
        turns = [float(row.get(f"mounting_{axis}_deg") or 0.0) for axis in ("yaw", "pitch", "roll")]
        mounting = Rotation.from_euler("ZYX", turns, degrees=True).as_matrix()
        plain = tried(name, imu, gnss, mounting, PLAIN).offset_ms if own else 0.0
        found = tried(name, imu, gnss, mounting, hide(rng), plain)
        out.append(replace(found, lean=mean_lean(read_table(dataset, "reference", name))))
        if own:
            print(f"{name}: as it is {plain:+.1f} ms")
        one = out[-1]
        told = f"{one.pose_deg:.2f}°, {one.offset_ms:+.1f} ms, drift {one.drift_ppm:.0f} ppm {one.refused[:160]}"
        print(f"{name}: sure {one.sure}, {told}", flush=True)
    return out


def mean_lean(reference: Columns | None) -> np.ndarray | None:
    """Rotation vector from the sensor's axes to those of a level car, of the mean roll and pitch of a reference."""
    if reference is None or not np.isfinite(reference["roll"]).any():
        return None
    roll, pitch = (float(np.nanmean(reference[angle])) for angle in ("roll", "pitch"))
    return Rotation.from_euler("YX", [pitch, roll]).as_rotvec()


def summary(title: str, all_of_them: list[Outcome]) -> str:
    """A row of the table."""
    moved = [o for o in all_of_them if o.motion_s >= MOTION_S]
    sure = [o for o in moved if o.sure]
    known = [o for o in moved if np.isfinite(o.pose_deg)]
    pose, offset = np.array([o.pose_deg for o in known]), np.abs([o.offset_ms for o in known])
    right = int(np.sum(pose <= POSE_DEG)), int(np.sum(offset <= 1000 * OFFSET_S))
    cells = [title, len(all_of_them), len(moved), len(sure), f"{right[0]} / {right[1]}"]
    cells += [f"{np.median(x):.2f} / {np.max(x):.2f}" if len(x) else "–" for x in (pose, offset)]
    cells += [sum(o.wrong for o in all_of_them), f"{np.median([o.seconds for o in all_of_them]):.1f}"]
    return "| " + " | ".join(str(c) for c in cells) + " |"


def leaning(title: str, all_of_them: list[Outcome]) -> str:
    """How far the poses lie from the reference's own mean roll and pitch: nominal axes need not be a level car's.

    Gravity tells how a sensor sits in the horizon, the mean slope and camber of the roads included.
    """
    known = [o for o in all_of_them if o.motion_s >= MOTION_S and o.turn is not None and o.lean is not None]
    if len(known) < 3:
        return ""
    lean = Rotation.from_rotvec(np.array([o.lean for o in known]))
    apart = np.degrees((Rotation.from_rotvec(np.array([o.turn for o in known])) * lean.inv()).magnitude())
    roll, pitch, _ = np.degrees(lean.mean().as_rotvec())
    return (
        f"{title}: the reference itself leans by {np.degrees(lean.magnitude()).max():.2f}° at most in the mean of a "
        f"drive, by roll {roll:+.2f}° and pitch {pitch:+.2f}° in that of all; of {len(known)} poses "
        f"{int(np.sum(apart <= POSE_DEG))} lie within 2° of it, {np.median(apart):.2f}° in the median, "
        f"{apart.max():.2f}° at most"
    )


def mistakes(title: str, dataset: Path) -> str:
    """A row of the second table: drives in which a check tells each of four mistakes, and drives as they are."""
    told = dict.fromkeys(("as they are", *SPOILT), 0)
    drives = read_drives(dataset)
    count = 0
    for row in drives:
        imu, gnss = read_table(dataset, "imu", row.name), read_table(dataset, "gnss", row.name)
        assert imu is not None and gnss is not None
        if imu["t"][-1] - imu["t"][0] < MOTION_S:
            continue
        count += 1
        good = {name: values[gnss["quality"] > 0] for name, values in gnss.items()}
        for name in told:
            spoilt = SPOILT[name](dict(imu), dict(good)) if name in SPOILT else (imu, good)
            try:
                check_gnss_units(spoilt[1], row.name)
                check_clocks(*spoilt, row.name)
            except InputError:
                told[name] += 1
    return f"| {title} | {count} | " + " | ".join(str(n) for n in told.values()) + " |"


def _early(imu: Columns, gnss: Columns) -> tuple[Columns, Columns]:
    return imu, gnss | {"t": gnss["t"] - 18.0}


def _quarter(imu: Columns, gnss: Columns) -> tuple[Columns, Columns]:
    turned = {f"{s}_x": imu[f"{s}_y"] for s in ("gyro", "accel")}
    return imu | turned | {f"{s}_y": -imu[f"{s}_x"] for s in ("gyro", "accel")}, gnss


def _slow(imu: Columns, gnss: Columns) -> tuple[Columns, Columns]:
    return imu, gnss | {f"vel_{a}": gnss[f"vel_{a}"] / 3.6 for a in "ned"}


def _nowhere(imu: Columns, gnss: Columns) -> tuple[Columns, Columns]:
    first = np.arange(len(gnss["t"])) < 3
    return imu, gnss | {name: np.where(first, 0.0, gnss[name]) for name in ("lat_deg", "lon_deg")}


SPOILT = {"18 s": _early, "turned 90°": _quarter, "velocities ÷ 3.6": _slow, "three fixes at 0°/0°": _nowhere}
COLUMNS = (
    *("drives", "in all", "with 60 s of motion", "of these: given as sure"),
    *("pose within 2° / offset within 20 ms, sure or not", "pose error [°], median / largest"),
    *("offset error [ms], median / largest", "wrong and given as sure, of all", "seconds each"),
)
HEAD = "| " + " | ".join(COLUMNS) + " |\n|:--|" + "--:|" * (len(COLUMNS) - 1)


def main() -> None:
    """Run, print, write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("page", type=Path)
    parser.add_argument("--simulated", type=Path)
    parser.add_argument("--real", type=Path, help="folder of real datasets")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--drift", type=float, default=0.0, help="ppm by which the clock of the IMU runs faster")
    parser.add_argument("--first", type=int, help="so many drives of each dataset")
    given = parser.parse_args()
    more = {"drift_ppm": given.drift, "first": given.first}
    groups: dict[str, list[Outcome]] = {}
    if given.simulated:
        groups["simulated (lifelike)"] = run(given.simulated, np.random.default_rng(given.seed), **more)
    for name in ("rtkx", "kitti", "comma2k19") if given.real else ():
        if (given.real / name).is_dir():
            groups[name] = run(given.real / name, np.random.default_rng(given.seed), own=name != "kitti", **more)
    rows = [summary(title, outcomes) for title, outcomes in groups.items()]
    sets = {"simulated (lifelike)": given.simulated} if given.simulated else {}
    sets |= {n: given.real / n for n in ("rtkx", "kitti") if given.real and (given.real / n).is_dir()}
    names = ("drives of a minute or more, and in how many a check speaks up", "in all", "as they are", *SPOILT)
    head = f"| {' | '.join(names)} |"
    line = "|:--|" + "--:|" * (len(SPOILT) + 2)
    checks = [mistakes(title, dataset) for title, dataset in sets.items()]
    lean = leaning("kitti", groups.get("kitti", []))
    table = "\n".join((HEAD, *rows, "", lean, "", head, line, *checks))
    print(table)
    with staged(given.page.parent) as folder:
        old = given.page.read_text() if given.page.exists() else "<!-- table -->\n<!-- end -->\n"
        before, _, rest = old.partition("<!-- table -->")
        after = rest.partition("<!-- end -->")[2]
        (folder / given.page.name).write_text(f"{before}<!-- table -->\n{table}\n<!-- end -->{after}")


if __name__ == "__main__":
    main()
