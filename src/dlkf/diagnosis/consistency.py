"""Consistency of a filter's covariance: normalised errors against their χ² bands (Bar-Shalom et al. 2001, 5.4.2).

    NEES = eᵀ P⁻¹ e,  e = truth − estimate after the update, n states        NIS = zᵀ S⁻¹ z,  S = H P⁻ Hᵀ + R

A consistent filter's NEES is χ² with n, its NIS with m degrees of freedom. The mean over N independent drives at a
time lies within χ²_{nN}(2.5 %, 97.5 %)/N in 95 % of all cases. Above, the filter is
overconfident, below, conservative.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator, ScalarFormatter
from numpy.typing import NDArray
from torch import Tensor

from dlkf.base.console import ProgressCallback, no_progress
from dlkf.base.errors import InputError
from dlkf.base.files import write_into
from dlkf.data.drive import Batch
from dlkf.evaluation.figures import SHADE, plain_axes, png
from dlkf.evaluation.table import ResultTable, as_json, as_markdown, format_number
from dlkf.filters.gating import chi2_quantile
from dlkf.filters.integration import BatchSolution, integrate
from dlkf.filters.model_based import CovarianceEstimator, has_covariance
from dlkf.filters.smoother import Filter
from dlkf.navigation.state import PVA, ErrorStates

Array = NDArray[np.floating]
AT_ONCE = 25  # drives: a covariance of 33 states takes 9 kB per epoch and drive
CONFIDENCE = 0.95
KINDS = ("whole state", "position, velocity, attitude", "innovation")


@dataclass(frozen=True)
class NormalisedSquares:
    """NEES of the whole state and of position, velocity, attitude, and NIS; (drives, epochs), NaN where unknown.

    ``states`` is the number of states, innovations have six components.
    """

    states: int
    epoch_s: float
    whole: Array
    pva: Array
    nis: Array

    def mean(self, values: Array, degrees: int) -> Array:
        """Mean over the drives at each epoch, over its expectation; NaN where there is none."""
        known = ~np.isnan(values)
        return np.where(known.any(0), np.where(known, values, 0).sum(0) / np.maximum(known.sum(0), 1), np.nan) / degrees

    def parts(self) -> tuple[tuple[str, Array, int], ...]:
        """(what, values, degrees of freedom) of each kind."""
        return tuple(zip(KINDS, (self.whole, self.pva, self.nis), (self.states, 9, 6)))


def normalised_square(e: Float[Tensor, "*b n"], P: Float[Tensor, "*b n n"]) -> Float[Tensor, "*b"]:
    """eᵀ P⁻¹ e, by way of the correlations: variances of a state vector span fifteen decades."""
    sigma = P.diagonal(dim1=-2, dim2=-1).clamp_min(1e-300).sqrt()
    correlation = P / (sigma.unsqueeze(-1) * sigma.unsqueeze(-2))
    u = (e / sigma).unsqueeze(-1)
    return (u * torch.linalg.solve(correlation, u)).sum((-2, -1))


def state_error(
    batch: Batch, solution: BatchSolution, states: ErrorStates, matrices: Float[Tensor, "B 2 3 3"]
) -> Float[Tensor, "B T n"]:
    """truth − estimate of a filter's states without those of the car, in their order.

    ``batch.true_imu_error`` is the true bias, ``matrices`` the true M.
    """
    assert solution.error is not None
    parts = [solution.posterior.error_to(batch.truth), batch.true_imu_error - solution.error.bias]
    if states.elements:
        rows, columns = (list(x) for x in zip(*states.elements))
        true = matrices[:, :, rows, columns].unsqueeze(1)  # (B, 1, 2, k)
        found = solution.error.matrix
        if found is None:
            found = torch.zeros_like(true)
        elif states.matrix == "scale":
            found = found.unflatten(-1, (2, 3))
        else:
            found = found[:, :, :, rows, columns]
        parts.append((true - found).expand(*batch.size[:2], -1, -1).flatten(2))
    return torch.cat(parts, -1)


def find_states(name: str, estimator: Filter) -> ErrorStates:
    """The error states of a filter. Raises InputError for one without a covariance."""
    if not has_covariance(estimator):
        raise InputError(f"model {name} has no covariance to compare its errors with; give a Kalman filter")
    return estimator.states


def measure_consistency(
    estimator: CovarianceEstimator,
    batch: Batch,
    matrices: Float[Tensor, "B 2 3 3"],
    progress: ProgressCallback = no_progress,
) -> NormalisedSquares:
    """NEES and NIS of a filter over drives with errors as it models them (``matched_drives``)."""
    n, rows = estimator.states.navigation, []
    for index in torch.arange(batch.size[0]).split(AT_ONCE):
        part = batch.select(index).trim()
        with torch.inference_mode():
            s = integrate(part, estimator, keep_covariances=True)
        assert s.covariances is not None
        P = s.covariances.updated[..., :n, :n]
        e = state_error(part, s, estimator.states, matrices[index])
        nis = normalised_square(s.innovation, s.covariances.innovation)
        rows.append(
            (
                normalised_square(e, P),
                normalised_square(e[..., PVA], P[..., PVA, PVA]),
                torch.where(part.gnss_valid.all(-1) & part.available, nis, torch.nan),
            )
        )
        progress(int(index[-1]) + 1, batch.size[0])
    return NormalisedSquares(n, batch.epoch_s, *(torch.cat(x).numpy() for x in zip(*rows)))


def chi2_band(degrees: int, count: int) -> tuple[float, float]:
    """Band of the mean of ``count`` independent χ² values, over its expectation."""
    tail = (1 - CONFIDENCE) / 2
    low, high = chi2_quantile(np.array([tail, 1 - tail]), degrees * count) / (degrees * count)
    return float(low), float(high)


def consistency_table(results: Mapping[str, NormalisedSquares], settle_s: float, title: str) -> ResultTable:
    """Mean over expectation, and the share of epochs whose mean over the drives lies in the band."""
    rows = []
    for name, result in results.items():
        for what, values, degrees in result.parts():
            over = result.mean(values, degrees)[int(settle_s / result.epoch_s) :]
            over = over[~np.isnan(over)]
            low, high = chi2_band(degrees, len(values))
            share = f"{100 * float(((over >= low) & (over <= high)).mean()):.0f}" if len(over) else "–"
            mean = format_number(float(over.mean()) if len(over) else float("nan"))
            rows.append([name, what, str(degrees), mean, f"{low:.3f} – {high:.3f}", share])
    return ResultTable(
        title=title,
        note="Normalised error squared over its expectation: 1 is consistent, above overconfident, below conservative. "
        f"Band: 95 % of the means over the drives at one time. After {settle_s:g} s.",
        columns=["Filter", "Of", "Degrees\nof freedom", "Mean", "Band", "Epochs in\nthe band [%]"],
        rows=rows,
    )


def draw_consistency(results: Mapping[str, NormalisedSquares], outage: NDArray[np.bool_] | None = None) -> Figure:
    """Means over the drives through time with their bands: a column per filter, a row per type of error. ``outage``:
    the epochs without GNSS."""
    out = Figure(figsize=(1.2 + 3.2 * len(results), 7.2), layout="constrained")
    axes = out.subplots(len(KINDS), len(results), squeeze=False, sharex=True, sharey=True)
    for column, (name, result) in enumerate(results.items()):
        for ax, (what, values, degrees) in zip(axes[:, column], result.parts()):
            t = result.epoch_s * np.arange(1, values.shape[1] + 1)
            low, high = chi2_band(degrees, len(values))
            ax.axhspan(low, high, color="#009E73", alpha=0.18, lw=0)
            hidden = np.flatnonzero([] if outage is None else outage)
            for run in np.split(hidden, np.flatnonzero(np.diff(hidden) > 1) + 1):
                if len(run):
                    ax.axvspan(t[run[0]] - result.epoch_s, t[run[-1]], color=SHADE, alpha=0.6, lw=0, zorder=0)
            ax.axhline(1, color="#777777", lw=0.8)
            ax.semilogy(t, result.mean(values, degrees), color="#0072B2", lw=1.1)
            plain_axes(ax)
            ax.set_title(f"{name}: {what} ({degrees})", fontsize=9, loc="left")
    highest = max(np.nanmax(r.mean(values, degrees)) for r in results.values() for _, values, degrees in r.parts())
    axes[0, 0].set_ylim(0.5, min(max(2.0, 1.1 * highest), 20.0))
    axes[0, 0].yaxis.set_major_locator(FixedLocator([0.5, 0.7, 1, 1.5, 2, 3, 5, 10, 20]))
    axes[0, 0].yaxis.set_major_formatter(ScalarFormatter())
    axes[0, 0].yaxis.set_minor_locator(NullLocator())
    out.supylabel("Normalised error squared over its expectation", fontsize=10)
    out.supxlabel("Time [s]; green: 95 % band, grey: outage", fontsize=10)
    return out


def write_consistency(
    out: str | Path, results: Mapping[str, NormalisedSquares], table: ResultTable, outage: NDArray[np.bool_] | None
) -> None:
    """Write table.md, consistency.png and consistency.json (the means through time) into ``out``, all or none."""
    series = {
        name: {what: r.mean(values, degrees).tolist() for what, values, degrees in r.parts()}
        for name, r in results.items()
    }
    with write_into(out) as folder:
        (folder / "table.md").write_text(as_markdown(table), encoding="utf-8")
        (folder / "consistency.png").write_bytes(png(draw_consistency(results, outage)))
        (folder / "consistency.json").write_text(as_json(series), encoding="utf-8")
