"""How far filters drift in GNSS outages, as frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import pandas as pd

from dlkf.frames.checks import check_above_zero, check_models, imu_values, prior_values, tuning_values
from dlkf.frames.dataset import drive_folder

if TYPE_CHECKING:
    from dlkf.evaluation.results import Results
    from dlkf.evaluation.scores import Scores
    from dlkf.frames.figures import NotebookFigure


class Evaluation:
    """Errors of filters in GNSS outages.

    Attributes
    ----------
    headline : str
        How far the best filter drifts in the outages, in one sentence.
    warnings : list of str
        A line with the remedy for each filter whose 1σ does not fit its innovations, and a line for each filter for
        which the drive's sample rate is too low.
    table : pandas.DataFrame
        A row per filter: horizontal error at the end of the outages (``end_rms_m``, ``median_m``, ``p95_m``), drift
        per distance (``drift_percent``), the filter's own horizontal 1σ at the end (median, ``own_sigma_m``),
        innovations over their 1σ (RMS, ``innovation_per_sigma``).
    outages : pandas.DataFrame
        A row per outage: t_start [s], length_s, distance_m, and the horizontal error of every filter at its end [m].
    results : Results
        All numbers, as ``metrics.json`` has them (:class:`dlkf.evaluation.results.Results`).
    scores : Scores
        Errors and tracks of every filter over time.
    """

    def __init__(self, results: Results, scores: Scores, notes: Sequence[str] = ()) -> None:
        from dlkf.evaluation.summary import headline, sigma_warnings

        self.results, self.scores, self.headline = results, scores, headline(results)
        self.warnings = [*notes, *sigma_warnings(scores)]
        end = {"end_rms_m": ("horizontal", "rms"), "median_m": ("horizontal", "median"), "p95_m": ("horizontal", "p95")}
        rows = {
            name: {key: results.value(name, "outages", "end", *which) for key, which in end.items()}
            | {"drift_percent": 100 * results.value(name, "outages", "end", "drift", "median")}
            | {"own_sigma_m": results.value(name, "outages", "end", "sigma", "median")}
            | {"innovation_per_sigma": results.value(name, "segments", "with_gnss", "innovation")}
            for name in results.filters
        }
        self.table = pd.DataFrame.from_dict(rows, orient="index").rename_axis("filter")
        kept = ("t_start", "length_s", "distance_m")
        self.outages = pd.DataFrame(
            [
                {k: o[k] for k in kept} | {n: o["end"][n]["horizontal"] for n in results.filters}
                for o in results.per_outage
            ]
        )

    def plot(self) -> NotebookFigure:
        """Error against the time without GNSS, and every outage's error at its end (matplotlib)."""
        from dlkf.frames.figures import draw_evaluation

        return draw_evaluation(self.scores, self.outages)

    def __repr__(self) -> str:
        return "\n\n".join((self.headline, self.table.round(3).to_string(), *self.warnings))

    def _repr_html_(self) -> str:
        from dlkf.frames.figures import as_html

        warnings = "".join(f"<p><b>{line}</b></p>" for line in self.warnings)
        table = self.table.round(3)._repr_html_()  # type: ignore[operator]
        return f"<p>{self.headline}</p>{warnings}{table}{as_html(self.plot())}"


def evaluate(
    imu: pd.DataFrame,
    gnss: pd.DataFrame,
    reference: pd.DataFrame | None = None,
    *,
    models: str | Sequence[str] = ("mbkf21_nhc", "plus"),
    outage_s: float = 30.0,
    imu_type: str | Mapping[str, Any] = "automotive_mems",
    tuning: str | Mapping[str, Any] = "untuned",
    prior: Mapping[str, Sequence[float]] | None = None,
    lever_arm: Sequence[float] = (0.0, 0.0, 0.0),
    speed: pd.DataFrame | None = None,
    heading: pd.DataFrame | None = None,
    baro: pd.DataFrame | None = None,
) -> Evaluation:
    """Withhold GNSS for ``outage_s`` at a time all along a drive and measure how far filters drift.

    Parameters
    ----------
    imu, gnss : pandas.DataFrame
        As in :func:`dlkf.frames.navigation.navigate`.
    reference : pandas.DataFrame, optional
        What errors are measured against: t, lat_deg, lon_deg, height_m, vel_n|e|d and, where known, roll, pitch, yaw
        [rad], valid. Without one: the drive smoothed with all its fixes.
    models : str or sequence of str
        Filters to compare, as ``model`` of :func:`dlkf.frames.navigation.navigate`.
    outage_s : float
        Length of an outage [s]. The first begins after 60 s with GNSS, the next after ``outage_s`` with GNSS; a second
        run is shifted by ``outage_s``, so that the outages cover the drive.
    imu_type, tuning, prior : str or mapping
        As in :func:`dlkf.frames.navigation.navigate`.
    lever_arm : sequence of 3 floats
        IMU → antenna, Forward-Right-Down [m].
    speed, heading, baro : pandas.DataFrame, optional
        As in :func:`dlkf.frames.navigation.navigate`.

    Returns
    -------
    Evaluation
        The answer in a sentence, a table with a row per filter, and a row per outage.

    Raises
    ------
    InputError
        As :func:`dlkf.frames.navigation.navigate`, and where no outage fits into the drive.
    """
    from rich.console import Console

    from dlkf.base.settings import settings_from
    from dlkf.command.composing import compose_command
    from dlkf.command.scored import EvaluateSettings
    from dlkf.evaluate import evaluate_dataset

    names = check_models(models)
    check_above_zero(outage_s=outage_s)
    noise, known = imu_values(imu_type), prior_values(prior)
    aids = {"speed": speed, "heading": heading, "baro": baro}
    with drive_folder(imu, gnss, reference, lever_arm, aids) as folder:
        values = compose_command("evaluate", "model=ins", f"outage.duration_s={float(outage_s)}", resolve=False)
        values |= {"model": names, "dataset": str(folder), "mode": "drives", "out": "", "injected_bias": None}
        values |= {"imu": noise, "reference": "smoothed" if reference is None else "file"}
        values["tuning"] = dict(tuning_values(tuning))
        values["prior"] = {"mean": None, "std": None} if known is None else {"mean": known.mean, "std": known.std}
        values["tracking"] = {"uri": None, "log": False}
        values.pop("hydra", None)
        settings = settings_from(EvaluateSettings, values, "")
        done = evaluate_dataset(settings, Console(quiet=True))
    (results,) = done.results
    return Evaluation(results, done.scores, done.notes)
