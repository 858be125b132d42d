"""Pictures of a simulated dataset: its first drive as in the paper's figure 4, and how all its drives move.

    python pipelines/paper_drives.py data/paper_mems
    python pipelines/paper_drives.py data/tunnel outputs/tunnel

Into a folder, ``<dataset>/pictures`` where none is named.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import scipy
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from dlkf.base.colours import COLOURS
from dlkf.base.files import folder_name, resolve_place, write_into
from dlkf.data.limits import DEGREE_M
from dlkf.data.schema import ACCEL, GYRO, IMU_ERROR
from dlkf.data.tables import Columns, read_drives
from dlkf.data.validate import CheckedTables, read_drive, read_fixes

Array = NDArray[np.floating]
AXES = tuple(zip("xyz", COLOURS))
INK, GREY, LIMIT = "#222222", "#BBBBBB", COLOURS[3]
PAPER = {"speed": (0.0, 80.0), "along": (0.0, 2.0), "radius": (40.0, 150.0), "lateral": (0.5, 5.0)}  # R085-R088
SMOOTH_S = 0.5  # window of the derivatives
MOVING = 2.0  # m/s above which a course means something
TURNING = 1 / 2000  # 1/m, curvature of what counts as a turn
SHARP = 300.0  # m, radius of the turns whose lateral acceleration is shown
STEADY = 0.02  # rad/s² below which the yaw rate of a turn counts as steady


def main() -> None:
    """Draw a dataset."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    arguments.add_argument("dataset", help="a folder of dlkf simulate")
    arguments.add_argument("out", nargs="?", help="the folder of the pictures")
    given = arguments.parse_args()
    for path in write_pictures(given.dataset, given.out or Path(given.dataset) / "pictures"):
        print(path)


@dataclass(frozen=True)
class Driving:
    """How a drive moves over the ground at the times t (N,), where its reference is valid."""

    t: Array  # s
    north: Array  # m from the start
    east: Array
    speed: Array  # m/s
    along: Array  # m/s²
    yaw_rate: Array  # rad/s, of the course; 0 below 2 m/s
    steady: NDArray[np.bool_]  # in a turn of steady yaw rate

    @property
    def lateral(self) -> Array:
        """Speed times yaw rate [m/s²]."""
        return self.speed * self.yaw_rate

    @property
    def turning(self) -> NDArray[np.bool_]:
        """Where the path is bent to 2000 m or less."""
        return np.abs(self.yaw_rate) > TURNING * np.maximum(self.speed, MOVING)

    def every(self, seconds: float) -> Driving:
        """Decimated to about one row in so many seconds."""
        step = max(1, round(seconds / float(np.median(np.diff(self.t)))))
        return Driving(*(getattr(self, f.name)[::step] for f in fields(self)))


def driving(tables: CheckedTables) -> Driving:
    """Speed, acceleration and yaw rate over the ground; derivatives by a sliding parabola of half a second."""
    source = require_reference(tables)
    known = source["valid"].astype(bool) & np.isfinite(source["vel_n"])
    t, lat, lon, v_n, v_e = (source[c][known] for c in ("t", "lat_deg", "lon_deg", "vel_n", "vel_e"))
    dt = float(np.median(np.diff(t)))
    width = max(3, 2 * round(0.5 * SMOOTH_S / dt) + 1)
    a_n, a_e = (np.asarray(scipy.signal.savgol_filter(v, width, 2, deriv=1, delta=dt)) for v in (v_n, v_e))
    speed = np.hypot(v_n, v_e)
    moving = speed > MOVING
    safe = np.where(moving, speed, 1.0)
    along = np.where(moving, (v_n * a_n + v_e * a_e) / safe, 0.0)
    yaw_rate = np.where(moving, (v_n * a_e - v_e * a_n) / safe**2, 0.0)
    change = np.asarray(scipy.signal.savgol_filter(yaw_rate, width, 2, deriv=1, delta=dt))
    turning = np.abs(yaw_rate) > TURNING * np.maximum(speed, MOVING)
    north = DEGREE_M * (lat - lat[0])
    east = DEGREE_M * (lon - lon[0]) * np.cos(np.radians(lat[0]))
    return Driving(t, north, east, speed, along, yaw_rate, turning & (np.abs(change) < STEADY))


def drive_figure(tables: CheckedTables) -> Figure:
    """One drive: track, speed, specific force, rates, and the IMU's errors (paper, figure 4)."""
    moved = driving(tables)
    reference, rows = require_reference(tables), 5
    figure = Figure(figsize=(11.5, 1.9 * rows + 0.5), layout="constrained")
    grid = figure.add_gridspec(rows, 2, width_ratios=(1, 1.35))
    _track(figure.add_subplot(grid[:, 0]), figure, moved, tables)
    first = figure.add_subplot(grid[0, 1])
    first.plot(moved.t, 3.6 * moved.speed, color=INK, linewidth=0.8)
    first.set_ylabel("speed [km/h]")
    panels = [
        (tables.imu, ACCEL, 1.0, "specific force\n[m/s²]"),
        (tables.imu, GYRO, 180 / np.pi, "rate [°/s]"),
        (reference, IMU_ERROR[:3], 1.0, "accelerometer\nerror [m/s²]"),
        (reference, IMU_ERROR[3:], 180 / np.pi, "gyroscope\nerror [°/s]"),
    ]
    lower = []
    for k, (source, columns, scale, label) in enumerate(panels, start=1):
        lower.append(figure.add_subplot(grid[k, 1], sharex=first))
        for column, (axis, colour) in zip(columns, AXES):
            lower[-1].plot(source["t"], scale * source[column], color=colour, linewidth=0.5, label=axis)
        lower[-1].set_ylabel(label)
    lower[0].legend(loc="lower right", ncols=3, fontsize=8, bbox_to_anchor=(1.0, 1.0), frameon=False, borderpad=0)
    for line in lower[0].get_legend().get_lines():
        line.set_linewidth(2.0)
    for axes in (first, *lower):
        axes.grid(color=GREY, linewidth=0.3)
    for axes in (first, *lower[:-1]):
        axes.tick_params(labelbottom=False)
    last = lower[-1]
    last.set_xlabel("time [s]")
    figure.align_ylabels((first, *lower))
    figure.suptitle(tables.row.name, x=0.01, ha="left")
    return figure


def motion_figure(drives: Sequence[Driving], title: str) -> Figure:
    """Histograms of speed, accelerations and radii over drives, with the bounds of the paper (R085-R088).

    Radius and lateral acceleration are those of turns below 2000 m and below 300 m radius; filled where the yaw
    rate is steady, which is where the bounds apply: on the way into a turn and out of it the path is a clothoid.
    """
    joined = Driving(*(np.concatenate([getattr(d, f.name) for d in drives]) for f in fields(Driving)))
    figure = Figure(figsize=(11.5, 3.2), layout="constrained")
    speed, along, radius, lateral = figure.subplots(1, 4)
    _histogram(speed, 3.6 * joined.speed, None, PAPER["speed"], "speed [km/h]")
    braking = np.abs(joined.along[np.abs(joined.along) > 0.05])
    _histogram(along, braking, None, PAPER["along"], "|longitudinal| [m/s²]")
    turning, steady = joined.turning, joined.steady[joined.turning]
    radii = joined.speed[turning] / np.abs(joined.yaw_rate[turning])
    _histogram(radius, radii, steady, PAPER["radius"], "radius of turns [m]", np.geomspace(3, 2000, 50))
    radius.set_xscale("log")
    sharp = radii < SHARP
    sideways = np.abs(joined.lateral[turning][sharp])
    _histogram(lateral, sideways, steady[sharp], PAPER["lateral"], f"|lateral| below {SHARP:g} m [m/s²]")
    speed.set_ylabel("share of time")
    radius.legend(frameon=False, fontsize=8)
    figure.suptitle(f"{title}: {len(drives)} drives; dashed: the bounds R085-R088", x=0.01, ha="left")
    return figure


def write_pictures(dataset: str | Path, out: str | Path) -> list[Path]:
    """The first drive of a dataset, and the motion of all, drawn into ``out``."""
    rows = read_drives(dataset)
    files, moved = [f"{rows[0].name}.png", "motion.png"], []
    with write_into(out) as folder:
        for row in rows:
            tables = read_drive(dataset, row)
            moved.append(driving(tables).every(0.5))
            if row is rows[0]:
                drive_figure(tables).savefig(folder / files[0], dpi=90)
        motion_figure(moved, folder_name(dataset)).savefig(folder / files[1], dpi=90)
    return [resolve_place(out) / file for file in files]


def require_reference(tables: CheckedTables) -> Columns:
    """Of a simulated drive, which has one."""
    assert tables.reference is not None
    return tables.reference


def _track(axes: Axes, figure: Figure, moved: Driving, tables: CheckedTables) -> None:
    drawn = axes.scatter(moved.east, moved.north, c=3.6 * moved.speed, s=2, cmap="viridis", linewidths=0)
    axes.plot(moved.east[0], moved.north[0], "o", color=INK, markersize=5, label="start")
    fixes = read_fixes(tables.gnss)["t"]
    edges = np.concatenate(((moved.t[0],), fixes, (moved.t[-1],)))
    before = np.searchsorted(edges, moved.t, side="right").clip(1, len(edges) - 1)
    usual = float(np.median(np.diff(fixes))) if len(fixes) > 1 else np.inf
    dark = edges[before] - edges[before - 1] > max(2.5 * usual, 2.0)
    if dark.any():
        axes.scatter(moved.east[dark], moved.north[dark], s=14, color=LIMIT, linewidths=0, zorder=0.4, label="no GNSS")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("east [m]")
    axes.set_ylabel("north [m]")
    axes.grid(color=GREY, linewidth=0.3)
    axes.legend(frameon=False, fontsize=8)
    bar = {"location": "bottom", "shrink": 0.7, "aspect": 40, "fraction": 0.05, "pad": 0.02}
    figure.colorbar(drawn, ax=axes, label="speed [km/h]", **bar)


def _histogram(
    axes: Axes,
    x: Array,
    steady: NDArray[np.bool_] | None,
    bounds: tuple[float, float],
    label: str,
    edges: Array | None = None,
) -> None:
    if len(x):
        if edges is None:
            edges = np.linspace(0.0, 1.05 * max(float(np.percentile(x, 99.9)), bounds[1]), 50)
        bins = edges.tolist()
        share = np.full(len(x), 1 / len(x))
        if steady is None:
            axes.hist(x, bins, weights=share, color=AXES[0][1])
        else:
            axes.hist(x, bins, weights=share, histtype="step", color=INK, label="whole turn")
            axes.hist(x[steady], bins, weights=share[steady], color=AXES[0][1], label="steady")
    for bound in bounds:
        axes.axvline(bound, color=LIMIT, linestyle="--", linewidth=1)
    axes.set_xlabel(label)


if __name__ == "__main__":
    main()
