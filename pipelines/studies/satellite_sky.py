"""The sky over simulated or semi-real drives: what the fixes are worth, measured, and pictures.

    python -m dlkf.simulate dataset=city receiver=standalone raw=true out=data/city_standalone
    python -m pipelines.studies.satellite_sky data/city_standalone --figures docs/figures/satellites
    python -m pipelines.studies.satellite_sky --world --figures docs/figures/satellites
    python -m pipelines.studies.satellite_sky --accuracy 200000

For a dataset made with a satellite receiver: share of epochs with a fix, satellites, dilution, errors against
their claimed covariance and against noise times dilution; pictures of one drive. ``--world``: satellites in view
and dilution everywhere on the Earth over one day. ``--accuracy``: orbits against closed forms and finite
differences, and that many least-squares solutions at random places and times against their covariance.
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pymap3d
import torch
from matplotlib.figure import Figure
from pipelines.studies.figures import sky_figures
from scipy.stats import chi2

from dlkf.data.schema import ATTITUDE, POSITION, VELOCITY, drive_file
from dlkf.data.tables import read_drives
from dlkf.navigation.attitude import rotation_from_rpy
from dlkf.simulation.gnss.almanac import read_almanac
from dlkf.simulation.gnss.least_squares import Observations, dilution, solve
from dlkf.simulation.gnss.satellites import EARTH_SPIN, GRAVITATION, LIGHT, direction, satellite_state, signals

EPOCHS = 20000  # solved at once
STD = [f"std_{kind}_{axis}" for kind in ("pos", "vel") for axis in "ned"]


def tables(dataset: Path, drive: str) -> tuple[pd.DataFrame, pd.DataFrame, pd.DataFrame | None]:
    """Fixes, reference and raw observations of a drive."""
    fixes, reference = (pd.read_parquet(drive_file(dataset, kind, drive)) for kind in ("gnss", "reference"))
    if "satellites" not in fixes:
        raise SystemExit(f"{dataset}: fixes without satellites; simulate it with receiver=standalone, say")
    raw = drive_file(dataset, "raw", drive)
    return fixes, reference, pd.read_parquet(raw) if raw.exists() else None


def fix_errors(fixes: pd.DataFrame, reference: pd.DataFrame, lever_arm_b: np.ndarray) -> np.ndarray:
    """Position and velocity error (N, 6) of the antenna in NED, NaN where the reference has no row at the fix.

    The velocity of an antenna away from the IMU needs the turn rate, which a reference has not got: NaN as well.
    """
    at = np.minimum(np.searchsorted(reference.t, fixes.t - 1e-6), len(reference) - 1)
    truth = reference.iloc[at].reset_index(drop=True)
    C_nb = rotation_from_rpy(torch.tensor(truth[list(ATTITUDE)].to_numpy())).numpy()
    east, north, up = pymap3d.geodetic2enu(
        fixes.lat_deg, fixes.lon_deg, fixes.height_m, truth.lat_deg, truth.lon_deg, truth.height_m
    )
    position = np.column_stack((north, east, -up)) - C_nb @ lever_arm_b
    velocity = (fixes[list(VELOCITY)] - truth[list(VELOCITY)]).to_numpy()
    error = np.column_stack((position, np.where(lever_arm_b.any(), np.nan, velocity)))
    return np.where((np.abs(truth.t - fixes.t) < 1e-6).to_numpy()[:, None], error, np.nan)


def summary(dataset: Path) -> None:
    """Print what all drives of a dataset say together."""
    parts, wrong = [], []
    for row in read_drives(dataset):
        fixes, reference, _ = tables(dataset, row.name)
        parts.append(fixes)
        wrong.append(fix_errors(fixes, reference, np.array(row.lever_arm_b)))
    fixes, error = pd.concat(parts, ignore_index=True), np.concatenate(wrong)
    fix = (fixes.quality > 0).to_numpy()
    shares = {quality: f"{(fixes.quality == quality).mean():.3f}" for quality in sorted(set(fixes.quality))}
    print(f"{dataset}: {len(parts)} drives, {len(fixes)} epochs; share by quality {shares}")
    few, middle, many = fixes.satellites.quantile((0.05, 0.5, 0.95))
    print(f"satellites 5 % {few:g}, median {middle:g}, 95 % {many:g}, mean {fixes.satellites.mean():.2f}")
    lengths = [len(run) for part in parts for run in re.findall("0+", "".join("01"[q > 0] for q in part.quality))]
    if lengths:
        print(f"without a fix {len(lengths)} times, median {np.median(lengths):g} and at most {max(lengths)} epochs")
    for name in ("gdop", "pdop", "hdop", "vdop"):
        half, most = fixes[name][fix].quantile((0.5, 0.95))
        print(f"{name.upper()} median {half:.2f}, 95 % {most:.2f}")
    std = fixes[STD].to_numpy()
    for name, columns in (("position", slice(0, 3)), ("velocity", slice(3, 6))):
        known = fix & np.isfinite(error[:, columns]).all(1)
        if not known.any():
            print(f"{name} error not known: no row of the reference at a fix, or a lever arm")
            continue
        rms, claimed = (np.sqrt(np.mean(x[known, columns] ** 2, 0)) for x in (error, std))
        ratio = np.sqrt(np.mean((error[known, columns] / std[known, columns]) ** 2, 0))
        print(f"{name} error RMS N, E, D {rms.round(4)}, claimed {claimed.round(4)}, error/σ RMS {ratio.round(3)}")


def above_horizon(raw: pd.DataFrame, reference: pd.DataFrame) -> pd.DataFrame:
    """prn, azimuth and elevation [rad] of everything above the horizon over the drive, with the packaged almanac."""
    almanac, epoch = read_almanac(), raw.iloc[0]
    start = (epoch.gps_week - almanac.week) * 604800 + epoch.tow - almanac.toa
    t = start + np.linspace(0, raw.t.iloc[-1] - epoch.t, 60)
    lat, lon, height = (float(reference[name].median()) for name in POSITION)
    place = pymap3d.geodetic2ecef(lat, lon, height)
    seen = signals(almanac, t, np.tile(place, (len(t), 1)), np.zeros((len(t), 3)))
    row, column = np.nonzero(seen.elevation > 0)
    columns = {"azimuth": seen.azimuth[row, column], "elevation": seen.elevation[row, column]}
    return pd.DataFrame({"prn": almanac.prn[column], **columns})


def save(figure: Figure, folder: Path, name: str) -> None:
    """A PNG of a figure."""
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / f"{name}.png", bbox_inches="tight")
    print(f"wrote {folder / name}.png")


def pictures(dataset: Path, drive: str | None, folder: Path) -> None:
    """Sky, dilution, route and errors of one drive, by default the first."""
    rows = {row.name: row for row in read_drives(dataset)}
    name = drive or next(iter(rows))
    if name not in rows:
        raise SystemExit(f"{dataset}: no drive {name}; there are {', '.join(list(rows)[:5])}, …")
    fixes, reference, raw = tables(dataset, name)
    title, stem = f"{name}", dataset.name
    if raw is not None:
        save(sky_figures.sky_plot(raw, above_horizon(raw, reference), title), folder, f"{stem}_sky")
    save(sky_figures.dilution(fixes, title), folder, f"{stem}_dilution")
    save(sky_figures.route(fixes, reference, title), folder, f"{stem}_route")
    error = fix_errors(fixes, reference, np.array(rows[name].lever_arm_b))
    if np.isfinite(error).any():
        save(sky_figures.errors(fixes, error[:, :3], title), folder, f"{stem}_errors")


def world(mask_deg: float, folder: Path | None) -> None:
    """Satellites in view and PDOP on a grid of 10 degrees, both poles and the date line included, over a day."""
    almanac = read_almanac()
    lat, lon = np.arange(-90.0, 91, 10), np.arange(-180.0, 181, 10)
    places = np.stack(pymap3d.geodetic2ecef(*(x.ravel() for x in np.meshgrid(lat, lon, indexing="ij")), alt=0.0), -1)
    counts, pdops = [], []
    for t in np.arange(0, 86400.0, 600):
        seen = signals(almanac, np.full(len(places), t), places, np.zeros_like(places))
        used = seen.elevation > np.radians(mask_deg)
        counts.append(used.sum(-1))
        pdops.append(dilution(direction(seen.satellite.r_e, places)[1], used, places).pdop)
    count, pdop = np.array(counts), np.array(pdops)
    share = np.mean((count >= 6) & (count <= 12))
    print(
        f"mask {mask_deg:g}°: satellites {count.min()} to {count.max()}, mean {count.mean():.2f}, "
        f"6 to 12 in {share:.4f}; PDOP median {np.median(pdop):.2f}, 95 % {np.quantile(pdop, 0.95):.2f}, "
        f"below 6 in {np.mean(pdop <= 6):.4f}, worst {pdop.max():.1f}"
    )
    if folder is not None:
        shape = len(lat), len(lon)
        title = f"GPS of week {almanac.week}, {len(almanac.prn)} satellites, above {mask_deg:g}°, one day"
        figure = sky_figures.world(
            lat, lon, count.mean(0).reshape(shape), np.quantile(pdop, 0.95, axis=0).reshape(shape), title
        )
        save(figure, folder, "world")


def accuracy(solutions: int) -> None:
    """Orbits, and errors of least squares against covariance (χ² of 3 degrees) and dilution."""
    almanac, rng = read_almanac(), np.random.default_rng(0)
    period = 2 * np.pi * almanac.sqrt_a**3 / np.sqrt(GRAVITATION)
    before, now, after = (satellite_state(almanac, np.linspace(0, 86400, 500) + step) for step in (-1.0, 0.0, 1.0))
    slope = np.abs((after.r_e - before.r_e) / 2 - now.v_e).max()
    radius = np.linalg.norm(now.r_e, axis=-1) / 1e3
    print(f"period {period.min():.1f} to {period.max():.1f} s, half a sidereal day {np.pi / EARTH_SPIN:.1f} s")
    print(f"radius {radius.min():.0f} to {radius.max():.0f} km; velocity off differences by {slope:.1e} m/s")
    squared, ratio, light = [], [], 0.0
    while len(squared) * EPOCHS < solutions:
        lat, lon = np.degrees(np.arcsin(rng.uniform(-1, 1, EPOCHS))), rng.uniform(-180, 180, EPOCHS)
        r_e, t = np.stack(pymap3d.geodetic2ecef(lat, lon, 0.0), -1), rng.uniform(0, 604800, EPOCHS)
        v_e = rng.normal(0, 15.0, (EPOCHS, 3))
        seen = signals(almanac, t, r_e, v_e)
        exact = satellite_state(almanac, t[:, None] - seen.distance / LIGHT, t).r_e
        light = max(light, np.abs(np.linalg.norm(exact - r_e[:, None], axis=-1) - seen.distance).max())
        used = seen.elevation > np.radians(5)
        noise, one = rng.standard_normal((2, *used.shape)), np.ones(used.shape)
        solution = solve(
            Observations(
                seen.satellite, seen.distance + 2 * noise[0], seen.distance_rate + 0.1 * noise[1], used, 4 * one,
                0.01 * one, np.zeros((0, *used.shape)),
            )
        )  # fmt: skip
        pairs = (solution.r_e - r_e, solution.covariance), (solution.v_e - v_e, solution.rate_covariance)
        squared.append([np.einsum("ti,tij,tj->t", e, np.linalg.inv(P[:, :3, :3]), e) for e, P in pairs])
        ratio.append(((pairs[0][0] ** 2).sum(-1) + solution.clock**2) / (2 * solution.dop.gdop) ** 2)
    print(f"light time against the implicit equation: {light:.1e} m")
    for name, values in zip(("position", "velocity"), np.concatenate(squared, 1)):
        tails = [f"{100 * (values > chi2.ppf(level, 3)).mean():.3f} %" for level in (0.95, 0.999)]
        spread = np.sqrt(6 / len(values))
        print(f"χ² of {name}, {len(values)} solutions: {values.mean():.4f} ± {spread:.4f}, above 95 %, 99.9 %: {tails}")
    print(f"error in space and time over σ · GDOP, RMS: {np.sqrt(np.mean(ratio)):.4f}")


def main() -> None:
    """Measure and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("dataset", nargs="?", type=Path, help="made with a satellite receiver")
    parser.add_argument("--drive", help="the one to draw; the first by default")
    parser.add_argument("--world", action="store_true", help="satellites and dilution everywhere on the Earth")
    parser.add_argument("--accuracy", type=int, default=0, metavar="N", help="orbits, and N least-squares solutions")
    parser.add_argument("--mask-deg", type=float, default=5.0, help="lowest elevation for --world")
    parser.add_argument("--figures", type=Path, help="folder for PNGs")
    options = parser.parse_args()
    if not (options.world or options.accuracy or options.dataset):
        parser.error("give a dataset, --world or --accuracy")
    if options.accuracy:
        accuracy(options.accuracy)
    if options.world:
        world(options.mask_deg, options.figures)
    if options.dataset is not None:
        summary(options.dataset)
        if options.figures is not None:
            pictures(options.dataset, options.drive, options.figures)


if __name__ == "__main__":
    main()
