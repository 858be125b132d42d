"""A filter over one drive of frames, or fed sample by sample."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from dlkf.base.errors import count_calls
from dlkf.frames.checks import (
    check_above_zero,
    check_aids,
    check_lever_arm,
    check_model,
    check_options,
    check_switch,
    imu_values,
    prior_values,
    tuning_values,
)
from dlkf.frames.dataset import DRIVE, drive_folder, in_python
from dlkf.frames.solution import Solution

if TYPE_CHECKING:
    from dlkf.filters.smoother import Filter
    from dlkf.running.streaming import StreamingFilter

DEFAULT_NOISE = {"imu_type": "automotive_mems", "tuning": "untuned"}


def navigate(
    imu: pd.DataFrame,
    gnss: pd.DataFrame,
    *,
    speed: pd.DataFrame | None = None,
    heading: pd.DataFrame | None = None,
    baro: pd.DataFrame | None = None,
    model: str | Path = "plus",
    imu_type: str | Mapping[str, Any] = "automotive_mems",
    tuning: str | Mapping[str, Any] = "untuned",
    prior: Mapping[str, Sequence[float]] | None = None,
    lever_arm: Sequence[float] = (0.0, 0.0, 0.0),
    smoothed: bool = False,
    rate_hz: float | None = None,
    epoch_s: float | None = None,
) -> Solution:
    """Run a filter over one drive from IMU and GNSS.

    Parameters
    ----------
    imu : pandas.DataFrame
        A row per sample: t [s], gyro_x|y|z [rad/s], accel_x|y|z [m/s², specific force: −9.8 on z at rest], body axes
        Forward-Right-Down; the means over the interval that ends at t, which increases.
    gnss : pandas.DataFrame
        A row per fix: t [s, the clock of ``imu``], lat_deg, lon_deg, height_m (above the ellipsoid); where known,
        vel_n|e|d [m/s], std_pos_n|e|d [m], std_vel_n|e|d [m/s], quality (NMEA GGA code). NaN where unknown.
    speed, heading, baro : pandas.DataFrame, optional
        Further sensors: t, speed [m/s]; t, heading [rad]; t, pressure [Pa] or height_m; each with ``std`` where known.
    model : str or Path
        A filter's name (``plus``, ``mbkf15``, ``mbkf21_car``, …), a folder with weights, an MLflow run id,
        ``models:/name@alias``, or ``module:Class``.
    imu_type : str or mapping
        Error model of the IMU for a Kalman filter: a preset of ``conf/imu`` or such a preset's content. ``plus`` and
        trained filters need none; ``plus_imu`` is ``plus`` with its biases, scale factors and misalignments.
    tuning : str or mapping
        Factors on a Kalman filter's noise: a preset of ``conf/tuning`` (``any_car`` for a car of which nothing is
        known) or such factors by name, as ``dlkf tune`` finds them.
    prior : mapping, optional
        Of a filter with ``_prior``: ``mean`` and ``std`` of the IMU error before the drive, 3 biases of accelerometers
        [m/s²] and 3 of gyroscopes [rad/s], of ``mbkf33`` then 18 elements of both sensor matrices.
    lever_arm : sequence of 3 floats
        IMU → antenna, Forward-Right-Down [m].
    smoothed : bool
        Also run the Rauch-Tung-Striebel smoother backwards over the drive: all its fixes in every row. For a filter
        with a covariance, a Kalman filter or ``plus``.
    rate_hz, epoch_s : float, optional
        IMU rate the filter runs at [Hz] and its update interval [s]; default: the filter's own.

    Returns
    -------
    Solution
        A row per update interval from the first moment at which attitude is known.

    Raises
    ------
    InputError
        For frames with wrong columns or values, a filter that does not exist, or a drive that cannot be aligned.

    Warns
    -----
    UserWarning
        Where the filter's 1σ is too small for its innovations, with the remedy (also ``solution.warning``), for a
        sensor that the filter does not use, and for a sample rate that is too low for it.
    """
    import torch

    from dlkf.data.alignment import read_align
    from dlkf.data.store import load_dataset
    from dlkf.filters.aids.attach import describe_aids
    from dlkf.filters.card import describe_slow_drives
    from dlkf.filters.smoother import run_smoother
    from dlkf.running.grid import RunPlan
    from dlkf.running.innovations import OF_NETWORK, REMEDY
    from dlkf.running.offline import navigate_drives
    from dlkf.tracking.models import short_name, takes_tuning

    given = {"rate_hz": rate_hz, "epoch_s": epoch_s}
    check_above_zero(**{name: value for name, value in given.items() if value is not None})
    check_switch("smoothed", smoothed)
    model = check_model(model)
    imu_values(imu_type)  # a wrong one is refused before any work
    aids = {"speed": speed, "heading": heading, "baro": baro}
    with drive_folder(imu, gnss, None, lever_arm, aids) as folder:
        estimator = load(model, imu_type=imu_type, tuning=tuning, prior=prior)
        plan = RunPlan.of(folder, estimator, short_name(model), rate_hz=rate_hz, epoch_s=epoch_s)
        estimator = plan.estimator
        named = {short_name(model): estimator}
        unused = describe_aids(named, [t for t in plan.aids if t not in plan.grid["aids"]])
        slow = describe_slow_drives(named, [*plan.rates.values()], "this drive has")
        if smoothed:
            estimator = run_smoother(estimator, "rts")
        drives = load_dataset(folder, dtype=torch.float64, reference=False, **plan.grid)
        (navigated,) = navigate_drives(drives, estimator, align=read_align())
    remedy = REMEDY if takes_tuning(model) else OF_NETWORK
    solution = Solution.of(navigated, plan.fixes[DRIVE], short_name(model), remedy)
    unfit = [navigated.sensors()[name] for name in navigated.unfit_sensors]
    for line in (*unused, *slow, *unfit, *([solution.warning] if solution.warning else [])):
        warnings.warn(line, UserWarning, stacklevel=count_calls())
    return solution


def load(
    model: str | Path = "plus",
    *,
    imu_type: str | Mapping[str, Any] = "automotive_mems",
    tuning: str | Mapping[str, Any] = "untuned",
    prior: Mapping[str, Sequence[float]] | None = None,
) -> Filter:
    """A filter by name, from a folder with ``weights.safetensors`` and ``config.yaml``, or from MLflow.

    Parameters
    ----------
    model : str or Path
        As in :func:`navigate`.
    imu_type, tuning : str or mapping
        As in :func:`navigate`; where a trained filter does not take them they change nothing, with a warning.
    prior : mapping, optional
        As in :func:`navigate`; refused where the filter does not take it.

    Returns
    -------
    Filter
        For :func:`dlkf.filters.integration.integrate` and :class:`~dlkf.running.streaming.StreamingFilter`.

    Raises
    ------
    InputError
        For anything else, listing what is known.
    """
    from dlkf.base.settings import settings_from
    from dlkf.filters.build import check_prior_taken
    from dlkf.filters.tuning import Tuning
    from dlkf.navigation.imu_errors import imu_spec
    from dlkf.tracking.models import resolve_model, unused_settings

    factors = settings_from(Tuning, tuning_values(tuning), "tuning")
    model = check_model(model)
    noise = imu_values(imu_type)
    known = prior_values(prior)
    if known is not None:
        check_prior_taken([model])
    with in_python():
        resolved = resolve_model(model, imu_spec(noise), tuning=factors, prior=known)
    given = {"imu_type": imu_type, "tuning": tuning}
    if line := unused_settings(model, [name for name, value in given.items() if value != DEFAULT_NOISE[name]]):
        warnings.warn(line, UserWarning, stacklevel=count_calls())
    return resolved


def Stream(
    model: str | Path = "plus", *, rate_hz: float | None = None, imu_type: str | Mapping[str, Any] = "automotive_mems",
    tuning: str | Mapping[str, Any] = "untuned", prior: Mapping[str, Sequence[float]] | None = None,
    lever_arm: Sequence[float] = (0.0, 0.0, 0.0), aids: str | Sequence[str] | None = None, **options: Any,
) -> StreamingFilter:  # fmt: skip
    """A filter fed sample by sample and fix by fix, as in a vehicle.

    Parameters
    ----------
    model : str or Path
        As in :func:`navigate`; a filter that is smoothed looks ahead and is refused.
    rate_hz : float, optional
        Rate the filter runs at [Hz], default its own; samples may come at any rate and jitter.
    imu_type, tuning, prior : str or mapping
        As in :func:`navigate`.
    lever_arm : sequence of 3 floats
        IMU → antenna, Forward-Right-Down [m].
    aids : str or sequence of str, optional
        Further sensors that the filter takes, of ``speed``, ``heading`` and ``baro``; a filter with vehicle constraints
        (``_nhc``, ``_car``, ``plus``) does. Their samples go to the methods of these names.
    **options
        Of :class:`~dlkf.running.streaming.StreamingFilter`: ``epoch_s`` [s], ``history_s`` (how late a fix may be), ….

    Returns
    -------
    StreamingFilter
        Its methods ``imu(t, accel, gyro)`` with accel, gyro (3) [m/s², rad/s], and ``gnss(t, lat_deg, lon_deg,
        height_m, velocity_ned, std)`` with velocity (3) [m/s] and std (6) return receipts, which hold the estimates of
        epochs that ended; ``now()`` is the estimate at the latest sample. A wrong sample is refused, not raised.

    Raises
    ------
    InputError
        For options that do not exist, sensors that the filter does not take, and a filter that cannot work on such a
        grid.
    """
    from dlkf.filters.aids.attach import add_chosen_aids
    from dlkf.filters.saved import choose_grid
    from dlkf.running.streaming import StreamingFilter
    from dlkf.tracking.models import short_name

    check_options("Stream", options, StreamingFilter, apart=("estimator", "rate_hz"))
    epoch_s = options.pop("epoch_s", None)
    given = {"rate_hz": rate_hz, "epoch_s": epoch_s}
    check_above_zero(**{name: value for name, value in given.items() if value is not None})
    arm = check_lever_arm(options.pop("lever_arm_b", lever_arm))
    estimator = load(model, imu_type=imu_type, tuning=tuning, prior=prior)
    if aids is not None:
        estimator = add_chosen_aids(short_name(check_model(model)), estimator, check_aids(aids))
    grid = choose_grid([estimator], rate_hz, epoch_s, 1.0)
    return StreamingFilter(estimator, **grid, lever_arm_b=arm, **options)
