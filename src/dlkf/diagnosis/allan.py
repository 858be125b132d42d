"""Allan deviation of a static log, the noise model of an IMU preset fitted to it (R015, R109; IEEE Std 952), and what
``dlkf allan`` leaves of both: preset, picture, page and tables.

With θ the integral of the samples over time, the overlapping Allan variance at cluster time τ = m dt is

    σ²(τ) = 1 / (2 τ² (N − 2m)) · Σ_k (θ_{k+2m} − 2 θ_{k+m} + θ_k)²,

and of independent noise sources it is the sum (IEEE Std 952-1997, annex C; quantisation, white noise of density N,
first-order Gauss-Markov bias of 1σ s and correlation time T):

    σ²(τ) = 3 Q²/τ² + N²/τ + (2 s² T/τ) [1 − T/(2τ) (3 − 4 e^{−τ/T} + e^{−2τ/T})].

For τ ≪ T the last term is K² τ/3, a rate random walk with K = s √(2/T): the walk that drives a filter's biases.
The bias instability is B = min σ / √(2 ln 2/π), read at the curve's lowest point.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
import yaml
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.optimize import nnls

from dlkf.base.colours import COLOURS
from dlkf.base.errors import InputError, list_some
from dlkf.base.files import write_into
from dlkf.base.provenance import describe_provenance
from dlkf.data.schema import stack_columns
from dlkf.evaluation.figures import plain_axes, png
from dlkf.evaluation.table import ResultTable, as_json, as_markdown, format_number
from dlkf.navigation.imu_errors import DEG, MILLIGAL, ImuSpec
from dlkf.report.page import Page, embed_png

Array = NDArray[np.floating]
FLICKER = math.sqrt(2 * math.log(2) / math.pi)  # the floor of a curve over B
CLUSTERS = 10  # at least so many at the longest cluster time: below, the curve is chance
PER_DECADE = 15  # cluster times
WHITE_S = 100.0  # a log must be so long for the white noise
RISE = 1.5  # the curve must end so far above its white part for the bias instability to be resolved
RESOLVED = 20.0  # correlation times that a log must hold for one to be used
STILL_RATE, STILL_FORCE = math.radians(1.0), 0.3  # rad/s, m/s²: a second's mean away from the log's median
AXES = tuple(f"{sensor}_{axis}" for sensor in ("accel", "gyro") for axis in "xyz")
TRIADS = ("accel", "gyro")
NAMES = {"accel": "Accelerometers", "gyro": "Gyroscopes"}
UNITS = {"accel": "m/s²", "gyro": "rad/s"}
SHEET_UNITS = {"accel": ("mGal", MILLIGAL), "gyro": ("°/h", DEG / 3600)}  # of data sheets, and their size
UNITS_LINE = (
    "# accelerometers in m/s², gyroscopes in rad/s; noise_density per √Hz, correlation_time in s\n"
    "# instability: 1σ of the in-run bias, a Gauss-Markov process; not the bias instability B of the Allan deviation\n"
)


@dataclass(frozen=True)
class AllanFit:
    """Noise of a sensor [unit: m/s² or rad/s]: ``density`` N [unit/√Hz], ``floor`` B [unit] at ``floor_s`` [s],
    ``walk`` K [unit/√s], Gauss-Markov ``sigma`` s [unit] and ``time`` T [s], ``quantisation`` Q [unit·s].

    ``rises``: the log is long enough to resolve the bias instability, ``resolved`` whether T is the log's own.
    """

    density: float
    floor: float
    floor_s: float
    walk: float
    sigma: float
    time: float
    quantisation: float
    rises: bool
    resolved: bool

    def curve(self, tau: Array) -> Array:
        """The fitted Allan deviation at cluster times ``tau`` [s]."""
        parts = np.array([self.quantisation, self.density, self.sigma]) ** 2
        return np.sqrt(_shapes(tau, self.time) @ parts)


def cluster_sizes(samples: int) -> NDArray[np.int64]:
    """Numbers of samples m of the cluster times, evenly spaced on a logarithmic scale."""
    decades = math.log10(max(samples // CLUSTERS, 1))
    return np.unique(np.round(10 ** np.arange(0, decades + 1e-9, 1 / PER_DECADE)).astype(np.int64))


def allan_variance(samples: Array, dt: float, sizes: Sequence[int] | NDArray[np.int64]) -> Array:
    """Overlapping Allan variance [unit²] of samples (N,) at cluster times ``sizes`` · ``dt``."""
    theta = np.concatenate(((0.0,), np.cumsum(samples - samples.mean()))) * dt
    out = np.empty(len(sizes))
    for k, m in enumerate(sizes):
        steps = theta[2 * m :] - 2 * theta[m:-m] + theta[: -2 * m]
        out[k] = steps @ steps / (2 * (m * dt) ** 2 * len(steps))
    return out


def fit_noise(tau: Array, variance: Array, duration_s: float, correlation_time: float) -> AllanFit:
    """The noise model whose Allan variance is nearest to a measured one, in relative terms.

    Least squares over non-negative Q², N², s² for every T of a logarithmic grid; a point weighs as much as its
    number of independent clusters. A log cannot resolve correlation times above a twentieth of its length:
    there T is ``correlation_time`` [s], and s follows, so that K is the log's all the same.
    """
    weight = np.sqrt(np.maximum(duration_s / tau - 1, 0.1))

    def fit(T: float) -> tuple[float, Array]:
        shapes, scale = _shapes(tau, T), variance
        for _ in range(3):  # relative to the fit itself: relative to the data would favour what is low by chance
            rows = weight / scale
            parts, rest = nnls(shapes * rows[:, None], variance * rows)
            scale = np.maximum(shapes @ parts, 1e-3 * variance)
        return rest, parts

    grid = np.geomspace(10 * tau[0], 100 * duration_s, 60)
    T = min((float(x) for x in grid), key=lambda T: fit(T)[0])
    resolved = duration_s / RESOLVED >= T
    T = T if resolved else correlation_time
    parts = fit(T)[1]
    Q, N, s = np.sqrt(parts)
    low = int(variance.argmin())
    rises = variance[-3:].mean() > RISE * N**2 / tau[-3:].mean()
    return AllanFit(
        float(N), math.sqrt(variance[low]) / FLICKER, float(tau[low]), float(s * math.sqrt(2 / T)), float(s), T,
        float(Q), bool(rises and s > 0), bool(resolved),
    )  # fmt: skip


def check_static(imu: Array, rate_hz: float, where: str) -> None:
    """Raises InputError unless accelerometers and gyroscopes (N, 6) are those of an IMU at rest, long enough."""
    n = max(1, round(rate_hz))
    if len(imu) < WHITE_S * rate_hz:
        raise InputError(
            f"{where}: {len(imu) / rate_hz:.0f} s are too short for the noise density; give at least "
            f"{WHITE_S:g} s at rest, and hours for the in-run bias"
        )
    seconds = imu[: len(imu) // n * n].reshape(-1, n, 6).mean(1)
    off = np.abs(seconds - np.median(seconds, axis=0)).reshape(-1, 2, 3).max(-1) / (STILL_FORCE, STILL_RATE)
    moved = np.flatnonzero((off > 1).any(-1))
    if len(moved):
        k = int(moved[0])
        raise InputError(
            f"{where}: is not static: {len(moved)} of its {len(seconds)} seconds are more than {STILL_FORCE:g} m/s² "
            f"or {math.degrees(STILL_RATE):g} °/s off its median, the first {k} s after its start; choose a part at "
            "rest with from_s= and to_s=, or give another log"
        )


def noise_preset(name: str, triads: Sequence[AllanFit], base: ImuSpec, source: str, *, in_run: str = "fit") -> ImuSpec:
    """An IMU preset of the fits of accelerometers and gyroscopes.

    A log at rest does not show turn-on bias, scale factor and misalignment: those are ``base``'s, and with
    ``in_run="keep"`` the in-run bias is so too. Raises InputError where the log is too short to see it.
    """
    sensors = []
    for kind, fit, sensor in zip(("accelerometers", "gyroscopes"), triads, (base.accel, base.gyro)):
        if in_run == "fit" and not fit.rises:
            raise InputError(
                f"the log is too short for the in-run bias of the {kind}: at its longest cluster time their Allan "
                f"deviation still falls like white noise; give a longer log, or in_run=keep for that of imu={base.name}"
            )
        values = {"noise_density": _round(fit.density)}
        if in_run == "fit":
            values |= {"instability": _round(fit.sigma), "correlation_time": _round(fit.time), "random_walk": 0.0}
        sensors.append(replace(sensor, **values))
    return ImuSpec(name, *sensors, source=source)


def preset_yaml(spec: ImuSpec) -> str:
    """The text of ``imu/<name>.yaml``: what ``imu=`` takes with ``--config-dir``."""
    return UNITS_LINE + yaml.safe_dump(spec.as_preset(), sort_keys=False, allow_unicode=True)


def _shapes(tau: Array, T: float) -> Array:
    """Allan variance of Q = 1, N = 1 and a Gauss-Markov process of s = 1, (len(tau), 3)."""
    x = tau / T
    # the bracket is x²/3 − x³/4 + … where differences of ones would lose it
    bracket = np.where(x < 1e-3, x * x * (1 / 3 - x / 4), 1 - (3 - 4 * np.exp(-x) + np.exp(-2 * x)) / (2 * x))
    return np.stack((3 / tau**2, 1 / tau, 2 / x * bracket), -1)


def _round(x: float) -> float:
    return float(f"{x:.4g}")


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
    note = (
        "Accelerometers: N in m/s/√h, B and bias in mGal, K in mGal/√h. Gyroscopes: N in °/√h, B and bias in °/h, "
        "K in °/h/√h."
    )
    note += " τ*: too long for this log, taken from the preset." if any(row[-1].endswith("*") for row in rows) else ""
    note += " –: the log is too short for it." if any("–" in row for row in rows) else ""
    return ResultTable(
        title=f"{log.drive}: {log.duration_s / 3600:.3g} h at rest, {log.rate_hz:g} Hz",
        note=note,
        columns=["Axis", "N", "B", "at [s]", "K", "In-run bias, 1σ", "τ [s]"],
        rows=rows,
    )


def describe_noise(log: StaticLog) -> list[str]:
    """A line for each triad: white noise and in-run bias."""
    lines = []
    for triad, walk, of_walk in zip(TRIADS, (60.0, 60 / DEG), ("m/s/√h", "°/√h")):
        fit, (unit, size) = log.fits[triad], SHEET_UNITS[triad]
        text = f"{NAMES[triad]}: white noise N = {format_number(fit.density * walk)} {of_walk}"
        if fit.rises:
            text += f", bias instability B = {format_number(fit.floor / size)} {unit}, in-run bias (1σ) "
            text += f"{format_number(fit.sigma / size)} {unit} over {format_number(fit.time)} s"
        lines.append(f"{text}.")
    return lines


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
        unit, size = SHEET_UNITS[triad]
        both = (lambda x, u=size: x / u, lambda x, u=size: x * u)
        ax.secondary_yaxis("right", functions=both).set_ylabel(f"[{unit}]")
        ax.grid(True, which="minor", color="#EEEEEE", lw=0.8)
        ax.legend(frameon=False, fontsize=8, ncols=2)
    return out


def _page(log: StaticLog, table: ResultTable, picture: bytes, settings: dict[str, str]) -> str:
    page = Page(f"Allan deviation of {log.drive}", [table.title, *describe_noise(log)])
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
        raise InputError(f"drive={drive}: give the drive at rest, one of {list_some(names)}")
    return drive
