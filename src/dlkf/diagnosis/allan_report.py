"""A static log's Allan deviation as preset, picture, page and tables: what ``dlkf.allan`` leaves behind."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from dlkf.base.colours import COLOURS
from dlkf.base.errors import InputError
from dlkf.base.files import write_into
from dlkf.base.provenance import describe_provenance
from dlkf.data.schema import stack_columns
from dlkf.diagnosis.allan import AllanFit, Array, allan_variance, check_static, cluster_sizes, fit_noise, preset_yaml
from dlkf.evaluation.figures import plain_axes, png
from dlkf.evaluation.table import ResultTable, as_json, as_markdown, format_number
from dlkf.navigation.imu_errors import DEG, MILLIGAL, ImuSpec
from dlkf.report.page import Page, embed_png

AXES = tuple(f"{sensor}_{axis}" for sensor in ("accel", "gyro") for axis in "xyz")
TRIADS = ("accel", "gyro")
NAMES = {"accel": "Accelerometers", "gyro": "Gyroscopes"}
UNITS = {"accel": "m/s²", "gyro": "rad/s"}


@dataclass(frozen=True)
class StaticLog:
    """Allan deviation of six axes (accelerometers, gyroscopes) and the noise fitted to each and to each triad."""

    drive: str
    duration_s: float
    rate_hz: float
    tau: Array  # (K,) s
    deviation: Array  # (K, 6)
    fits: dict[str, AllanFit]  # by axis, and by triad: "accel", "gyro"


def analyse(drive: str, imu: Array, rate_hz: float, base: ImuSpec) -> StaticLog:
    """Allan deviation and noise of the samples (N, 6) of an IMU at rest.

    A triad's noise is that of the mean variance of its axes. Raises InputError if the log is not static, or too
    short for the white noise. ``base`` gives the correlation time where the log is too short for it.
    """
    check_static(imu, rate_hz, f"drive {drive}")
    sizes = cluster_sizes(len(imu))
    tau, duration = sizes / rate_hz, len(imu) / rate_hz
    variance = np.stack([allan_variance(x, 1 / rate_hz, sizes) for x in imu.T], -1)
    times = {"accel": base.accel.correlation_time, "gyro": base.gyro.correlation_time}
    fits = {axis: fit_noise(tau, variance[:, k], duration, times[axis.split("_")[0]]) for k, axis in enumerate(AXES)}
    for k, triad in enumerate(TRIADS):
        fits[triad] = fit_noise(tau, variance[:, 3 * k : 3 * k + 3].mean(-1), duration, times[triad])
    return StaticLog(drive, duration, rate_hz, tau, np.sqrt(variance), fits)


def noise_table(log: StaticLog) -> ResultTable:
    """N, B, K and the Gauss-Markov bias, by axis and by triad, in the units that data sheets use."""
    rows = []
    for name in (*AXES[:3], "accel", *AXES[3:], "gyro"):
        fit = log.fits[name]
        accel = name.startswith("accel")
        walk, bias = (60.0, 1 / MILLIGAL) if accel else (60 / DEG, 3600 / DEG)
        time = format_number(fit.time) + ("" if fit.resolved else "*")
        row = [format_number(x) for x in (fit.density * walk, fit.floor * bias, fit.floor_s, fit.walk * bias * 60)]
        row += [format_number(fit.sigma * bias), time] if fit.rises else ["–", "–"]
        rows.append([f"{NAMES[name]}, all axes" if name in TRIADS else name.replace("_", " "), *row])
    return ResultTable(
        title=f"{log.drive}: {log.duration_s / 3600:.3g} h at rest, {log.rate_hz:g} Hz",
        note=(
            "Accelerometers: N in m/s/√h, B and bias in mGal, K in mGal/√h. Gyroscopes: N in °/√h, B and bias in °/h, "
            "K in °/h/√h. τ*: too long for this log, taken from the preset; – the log is too short."
        ),
        columns=["Axis", "N", "B", "at [s]", "K", "In-run bias, 1σ", "τ [s]"],
        rows=rows,
    )


def figure(log: StaticLog) -> Figure:
    """Allan deviation of the six axes, the fits of the triads, and where N, B and K are read."""
    out = Figure(figsize=(11, 4.8), layout="constrained")
    for ax, k, triad in zip(out.subplots(1, 2), (0, 3), TRIADS):
        fit = log.fits[triad]
        for axis, colour in zip(range(3), COLOURS):
            ax.loglog(log.tau, log.deviation[:, k + axis], color=colour, lw=1.3, label="xyz"[axis])
        ax.loglog(log.tau, fit.curve(log.tau), "--", color="black", lw=1.6, label="fit, all axes")
        low = log.deviation[:, k : k + 3].min()
        ax.loglog(log.tau, fit.density / np.sqrt(log.tau), ":", color="#777777", lw=1.1, label="N/√τ")
        if fit.rises:
            ax.loglog(log.tau, fit.walk * np.sqrt(log.tau / 3), "-.", color="#777777", lw=1.1, label="K √(τ/3)")
        ax.set_ylim(0.6 * low, 1.5 * log.deviation[:, k : k + 3].max())
        ax.plot([1], [fit.density], "o", mfc="white", mec="black", zorder=5, label="N, at 1 s")
        ax.plot([fit.floor_s], [fit.floor * 0.664], "s", mfc="white", mec="black", zorder=5, label="floor, 0.664 B")
        ax.set(title=NAMES[triad], xlabel="Cluster time τ [s]", ylabel=f"Allan deviation [{UNITS[triad]}]")
        plain_axes(ax)
        ax.grid(True, which="minor", color="#EEEEEE", lw=0.8)
        ax.legend(frameon=False, fontsize=8, ncols=2)
    return out


def _page(log: StaticLog, table: ResultTable, picture: bytes, settings: dict[str, str]) -> str:
    page = Page(f"Allan deviation of {log.drive}", [table.title])
    page.table(table.columns, table.rows)
    page.note(table.note)
    page.picture("Overlapping Allan deviation (IEEE Std 952)", embed_png(picture))
    page.protocol(settings | describe_provenance())
    return page.html()


def write_allan(out: str | Path, log: StaticLog, spec: ImuSpec) -> None:
    """Write imu/<name>.yaml, allan.png, allan.html, allan.csv and allan.json into ``out``, all or none."""
    picture, table = png(figure(log)), noise_table(log)
    settings = {
        "drive": log.drive, "duration": f"{log.duration_s:g} s", "rate": f"{log.rate_hz:g} Hz", "preset": spec.name
    }  # fmt: skip
    files = {
        f"imu/{spec.name}.yaml": preset_yaml(spec).encode(),
        "allan.png": picture,
        "allan.html": _page(log, table, picture, settings).encode(),
        "allan.md": as_markdown(table).encode(),
        "allan.csv": _csv(log).encode(),
        "allan.json": as_json(settings | {name: asdict(fit) for name, fit in log.fits.items()}).encode(),
    }
    with write_into(out) as folder:
        (folder / "imu").mkdir()
        for name, data in files.items():
            (folder / name).write_bytes(data)


def _csv(log: StaticLog) -> str:
    columns = [f"{axis}_{unit}" for axis, unit in zip(AXES, ["m_s2"] * 3 + ["rad_s"] * 3)]
    table = pd.DataFrame(log.deviation, log.tau, columns).rename_axis("tau_s").reset_index()
    return table.to_csv(index=False, float_format="%.6g", lineterminator="\n")


def part(imu: dict[str, Array], from_s: float | None, to_s: float | None) -> tuple[Array, float]:
    """Samples (N, 6) between two times after the start of a table's IMU, and their rate [Hz]."""
    t = imu["t"]
    if from_s is not None and to_s is not None and to_s <= from_s:
        raise InputError(f"to_s={to_s:g} is not after from_s={from_s:g}")
    kept = (t >= t[0] + (from_s or 0.0)) & (t <= t[0] + (math.inf if to_s is None else to_s))
    return stack_columns(imu, AXES)[kept], float((len(t) - 1) / (t[-1] - t[0]))


def choose_drive(names: Sequence[str], drive: str | None) -> str:
    """The drive to look at. Raises InputError where there are several and none is named, or it does not exist."""
    if drive is None and len(names) == 1:
        return names[0]
    if drive is None or drive not in names:
        shown = ", ".join(names[:8]) + (", …" if len(names) > 8 else "")
        raise InputError(f"drive={drive}: give the drive at rest, one of {shown}")
    return drive
