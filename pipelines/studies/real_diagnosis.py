"""What limits a model-based filter on a real drive, from the drive itself and without any outage.

    python -m pipelines.studies.real_diagnosis ../shared/data/real/rtkx --imu roof_mems --velocity-std 2 --fit

Innovation statistics of ``mbkf15`` (NIS), the clock of the IMU against that of GNSS, the delay of the GNSS
velocity, what alignment is worth, the pitch that gyroscope and accelerometer see against the road's slope,
and the noise under which the innovations are most likely, found on one half and checked on the other.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dlkf.command.composing import imu_preset
from dlkf.data.alignment import align_boundaries
from dlkf.data.drive import Drive
from dlkf.data.segments import whole_drives
from dlkf.data.store import drive_from_tables
from dlkf.data.tables import read_drives
from dlkf.data.validate import DriveTables, read_checked
from dlkf.filters.integration import integrate
from dlkf.filters.model_based import Mbkf
from dlkf.filters.tuning import Tuning
from dlkf.navigation.attitude import prefix_rotations, vector_from_rotation
from dlkf.navigation.imu_errors import ImuSpec
from dlkf.running.start import align

SETTLE = 2  # epochs whose innovations say more of the start than of the filter
GRAVITY = 9.8
METRES_PER_RADIAN = 6.371e6
GROUP_S = 5.0  # length over which a drift of the gyroscope is fitted


def innovations(drive: Drive, imu: ImuSpec, tuning: Tuning) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Innovation z (T, 6), S (T, 6, 6), use (T, 6) and log-likelihood (T,) of a drive with all its GNSS."""
    batch = whole_drives([drive], [align(drive)])
    with torch.inference_mode():
        solution = integrate(batch, Mbkf(imu, tuning), keep_covariances=True)
        assert solution.covariances is not None
        z, S = solution.innovation[0, SETTLE:], solution.covariances.innovation[0, SETTLE:]
        used = (batch.gnss_valid & batch.available.unsqueeze(-1))[0, SETTLE:]
        nis = (z.unsqueeze(-2) @ torch.linalg.solve(S, z.unsqueeze(-1))).flatten()
        return z, S, used, -0.5 * (nis + torch.logdet(S))


def consistency(z: Tensor, S: Tensor, used: Tensor) -> str:
    """NIS per degree of freedom, in all and for each component, and the lag-1 correlation of each."""
    nis = (z.unsqueeze(-2) @ torch.linalg.solve(S, z.unsqueeze(-1))).flatten()
    unit = z / S.diagonal(dim1=-2, dim2=-1).sqrt()
    square = unit.square().sum(0) / used.sum(0).clamp_min(1)
    lag1 = (unit[1:] * unit[:-1]).sum(0) / unit.square().sum(0).clamp_min(1e-12)
    shown = "  ".join(f"{a}: {s:.2f} ({c:+.2f})" for a, s, c in zip(("pN", "pE", "pD", "vN", "vE", "vD"), square, lag1))
    return f"NIS/dof {nis.sum() / used.sum():.2f}; per component (lag-1 correlation)  {shown}"


def shifted(tables: DriveTables, by_s: float, rate_hz: float) -> Drive:
    """The drive with the IMU's stamps moved."""
    imu = {**tables.imu, "t": tables.imu["t"] + by_s}
    return drive_from_tables(replace(tables, imu=imu), "shifted", rate_hz, 1.0, torch.float64)


def clock_offset(tables: DriveTables, imu: ImuSpec, tuning: Tuning, rate_hz: float) -> str:
    """Shift of the IMU's stamps under which the position innovations are most likely (velocity unused)."""
    blind = replace(tuning, velocity_std=1e4)
    shifts = np.arange(-0.16, 0.161, 0.04)
    L = np.array([float(innovations(shifted(tables, s, rate_hz), imu, blind)[3].sum()) for s in shifts])
    k = int(np.clip(L.argmax(), 1, len(L) - 2))
    curve = L[k - 1] - 2 * L[k] + L[k + 1]
    best = shifts[k] + 0.04 * 0.5 * (L[k - 1] - L[k + 1]) / curve
    sigma = 0.04 / math.sqrt(max(-curve, 1e-9))
    return f"IMU stamps shifted by {1e3 * best:+.0f} ± {1e3 * sigma:.0f} ms fit GNSS positions best"


def velocity_delay(reference: dict[str, np.ndarray]) -> str:
    """Delay of the reference velocity against the derivative of its position, per axis (rtkx: the receiver itself)."""
    t, p = reference["t"], track(reference)
    out = []
    for axis, name in enumerate(("n", "e", "d")):
        slope, middle = (p[2:, axis] - p[:-2, axis]) / (t[2:] - t[:-2]), t[1:-1]
        steady = (t[2:] - t[:-2]) < 2.2 * np.median(np.diff(t))
        delays = np.arange(0.0, 0.51, 0.025)
        off = [np.std((slope - np.interp(middle + d, t, reference[f"vel_{name}"]))[steady]) for d in delays]
        k = int(np.argmin(off))
        out.append(f"{name} {1e3 * delays[k]:.0f} ms ({off[0]:.3f} → {off[k]:.3f} m/s)")
    return "reference velocity behind the derivative of its position: " + ", ".join(out)


def track(table: dict[str, np.ndarray]) -> np.ndarray:
    """North, east, down [m] from the first row, flat; good to a few mm over a second."""
    lat, lon = np.radians(table["lat_deg"]), np.radians(table["lon_deg"])
    radius = METRES_PER_RADIAN + table["height_m"][0]
    return np.stack(((lat - lat[0]) * radius, (lon - lon[0]) * radius * np.cos(lat[0]), -table["height_m"]), -1)


def alignment_error(drive: Drive) -> str:
    """RMS of GNSS-and-levelling attitude against the reference's, in body axes."""
    aligned = align_boundaries(drive)
    known = aligned.ok & drive.ref_C_eb.isfinite().flatten(1).all(-1)
    if not bool(known.any()):
        return "alignment: the reference has no attitude to compare with"
    off = vector_from_rotation(aligned.C_eb[known].mT @ drive.ref_C_eb[known]).square().mean(0).sqrt()
    roll, pitch, yaw = np.degrees(off.numpy())
    return f"alignment against the reference, RMS: roll {roll:.2f}°, pitch {pitch:.2f}°, yaw {yaw:.2f}°"


def pitch_witnesses(tables: DriveTables, drive: Drive, bias: Sequence[float], figure: Path | None) -> str:
    """Forward specific force and gyroscope pitch against the slope of the road, where speed > 3 m/s.

    The road's slope from reference positions 1 s apart; f_x − a is g times pitch; gyroscope pitch is the
    integral from the alignment on. Neither witness knows of the other.
    """
    imu, ref = tables.imu, tables.reference
    assert ref is not None
    p = track(ref)
    s = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(p[:, :2], axis=0).T))))
    start = align(drive)
    t0 = drive.t0 + start.first * drive.epoch_s
    t = np.arange(t0 + 0.5, min(imu["t"][-1], ref["t"][-1]) - 0.5, 0.25)
    along = np.stack([np.interp(t + d, ref["t"], s) for d in (-0.5, 0.0, 0.5)])
    rise = np.interp(t + 0.5, ref["t"], -p[:, 2]) - np.interp(t - 0.5, ref["t"], -p[:, 2])
    speed = along[2] - along[0]
    slope = rise / np.maximum(speed, 0.1)
    acceleration = (along[2] - 2 * along[1] + along[0]) / 0.25

    def triangular(x: np.ndarray) -> np.ndarray:  # mean over ±0.5 s as `acceleration` weighs it
        once = np.concatenate(([0.0], np.cumsum(x[1:] * np.diff(imu["t"]))))
        twice = np.concatenate(([0.0], np.cumsum(0.5 * (once[1:] + once[:-1]) * np.diff(imu["t"]))))
        at = [np.interp(t + d, imu["t"], twice) for d in (-0.5, 0.0, 0.5)]
        return (at[2] - 2 * at[1] + at[0]) / 0.25

    first = int(np.searchsorted(imu["t"], t0))
    rates = np.stack([imu[f"gyro_{a}"] for a in "xyz"], -1)[first:] - np.asarray(bias)
    turns = torch.from_numpy(rates * np.diff(imu["t"], prepend=imu["t"][0])[first:, None]).T.unsqueeze(1)
    C = start.state.C_nb @ prefix_rotations(turns)[:, :, 0].permute(2, 0, 1)
    gyro = np.interp(t, imu["t"][first:], -torch.asin(C[:, 2, 0]).numpy())
    yaw_rate = np.abs(triangular(imu["gyro_z"]))
    shake = np.array([imu["gyro_y"][np.abs(imu["t"] - x) < 0.5].std() for x in t])
    level = (triangular(imu["accel_x"]) - acceleration) / GRAVITY
    driving = speed > 3

    drifts = []
    for a in np.arange(t[0], t[-1] - GROUP_S, GROUP_S):
        k = (t >= a) & (t <= a + GROUP_S)
        if driving[k].mean() > 0.8 and yaw_rate[k].max() < 0.15:
            drifts.append((np.polyfit(t[k], (gyro - slope)[k], 1)[0], np.polyfit(t[k], (gyro - level)[k], 1)[0],
                           shake[k].mean()))  # fmt: skip
    if not drifts:
        return f"no {GROUP_S:g} s of driving straight on: nothing to tell the witnesses of pitch apart by"
    a, b, c = np.array(drifts).T
    calm = c < np.median(c)
    density = math.sqrt(5 / 6 * GROUP_S)  # a line through white noise of density √S has slopes of √S / density
    if figure is not None:
        draw(figure, t, driving, speed, slope, level - slope, gyro - slope, shake)
    return (
        f"pitch of f_x − slope of the road: {np.mean((level - slope)[driving]) * 1e3:.1f} ± "
        f"{np.std((level - slope)[driving]) * 1e3:.1f} mrad over the drive; gyroscope pitch − slope: ± "
        f"{np.std((gyro - slope)[driving]) * 1e3:.1f} mrad\n"
        f"gyroscope y drift over {GROUP_S:g} s straight ahead ({len(a)} times, seen by both: r = "
        f"{np.corrcoef(a, b)[0, 1]:.2f}): ± {np.std(a) * 1e3:.2f} mrad/s, as white noise {np.std(a) * density:.1e} "
        f"rad/s/√Hz; calmer half ± {np.std(a[calm]) * 1e3:.2f}, rougher half ± {np.std(a[~calm]) * 1e3:.2f} mrad/s"
    )


def draw(path: Path, t, driving, speed, slope, level, gyro, shake) -> None:
    """The witnesses over time."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 6.4), layout="constrained")
    top, middle, low = figure.subplots(3, 1, sharex=True)
    top.plot(t, speed, "k", lw=1.2)
    top.set_ylabel("Speed [m/s]")
    road = top.twinx()
    road.plot(t[driving], 100 * slope[driving], ".", ms=2, color="#0072B2")
    road.set_ylabel("Slope [%]", color="#0072B2")
    middle.plot(t[driving], 1e3 * gyro[driving], ".", ms=3, color="#D55E00", label="gyroscope, integrated")
    middle.plot(t[driving], 1e3 * level[driving], ".", ms=3, color="#009E73", label="accelerometer")
    middle.set_ylabel("Pitch − slope [mrad]")
    middle.legend(frameon=False)
    low.plot(t, shake, color="#D55E00", lw=1.0)
    low.set_ylabel("Gyro y, 1 s std [rad/s]")
    low.set_xlabel("Time [s]")
    for ax in (top, middle, low):
        ax.grid(alpha=0.25)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)


def likely_noise(drive: Drive, imu: ImuSpec, tuning: Tuning, part: slice) -> tuple[ImuSpec, Tuning]:
    """Noise, turn-on biases and velocity std that maximise the innovations' likelihood over some epochs."""

    def built(x: np.ndarray) -> tuple[ImuSpec, Tuning]:
        a, g, ab, gb, v = np.exp(x)
        accel = replace(imu.accel, noise_density=a, turn_on_bias=ab)
        gyro = replace(imu.gyro, noise_density=g, turn_on_bias=gb)
        return replace(imu, accel=accel, gyro=gyro), replace(tuning, velocity_std=v)

    def value(x: np.ndarray) -> float:
        return float(innovations(drive, *built(x))[3][part].sum())

    x = np.log([imu.accel.noise_density, imu.gyro.noise_density, imu.accel.turn_on_bias, imu.gyro.turn_on_bias,
                tuning.velocity_std])  # fmt: skip
    best, step = value(x), np.full(5, math.log(1.6))
    while step.max() > math.log(1.12):
        for k in range(5):
            tried = [(value(y), y) for y in (x + step[k] * np.eye(5)[k], x - step[k] * np.eye(5)[k])]
            top = max(tried, key=lambda pair: pair[0])
            if top[0] > best + 0.1:
                best, x = top
            else:
                step[k] *= 0.5
    return built(x)


def main() -> None:
    """Load, measure, print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--drive", help="name (default: the longest)")
    parser.add_argument("--imu", default="automotive_mems", help="preset of conf/imu")
    parser.add_argument("--velocity-std", type=float, default=1.0, help="factor on the GNSS velocity std")
    parser.add_argument("--rate-hz", type=float, default=50.0)
    parser.add_argument("--fit", action="store_true", help="also look for the noise (minutes)")
    parser.add_argument("--figure", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    imu = imu_preset(options.imu)
    rows = read_drives(options.dataset)
    loaded = [read_checked(options.dataset, r, reference=True) for r in rows if options.drive in (None, r.name)]
    tables = max(loaded, key=lambda x: x.imu["t"][-1] - x.imu["t"][0])
    drive = drive_from_tables(tables, options.dataset.name, options.rate_hz, 1.0, torch.float64)
    tuning = Tuning(velocity_std=options.velocity_std)
    z, S, used, L = innovations(drive, imu, tuning)
    print(f"{drive.name}, {options.imu}, {options.rate_hz:g} Hz: {consistency(z, S, used)}")
    print(alignment_error(drive))
    assert tables.reference is not None
    print(velocity_delay(tables.reference))
    print(clock_offset(tables, imu, tuning, options.rate_hz))
    with torch.inference_mode():
        end = integrate(whole_drives([drive], [align(drive)]), Mbkf(imu, tuning)).imu_error[0, -1, 3:]
    print(pitch_witnesses(tables, drive, end.tolist(), options.figure))
    if options.fit:
        half = len(L) // 2
        for name, part in (("all", slice(None)), ("first half", slice(half))):
            found, tuned = likely_noise(drive, imu, tuning, part)
            z, S, used, _ = innovations(drive, found, tuned)
            a, g = found.accel, found.gyro
            print(f"fitted on {name}: noise and turn-on bias accel {a.noise_density:.2g}, {a.turn_on_bias:.2g}; gyro "
                  f"{g.noise_density:.2g}, {g.turn_on_bias:.2g}; velocity_std {tuned.velocity_std:.2f}")  # fmt: skip
            print(f"  first half {consistency(z[:half], S[:half], used[:half])}")
            print(f"  second half {consistency(z[half:], S[half:], used[half:])}")


if __name__ == "__main__":
    main()
