"""A reference for drives that have none: their own smoothed solution with all fixes, or their own good fixes.

Outages are withheld from the filters that are scored, not from the reference, so what is compared is the filter
without a fix against the fixes of the same seconds. The reference is as good as they are: its 1σ is given
beside the errors, and errors of that size mean nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dlkf.base.console import ProgressCallback, no_progress
from dlkf.base.errors import InputError
from dlkf.data.alignment import AlignConfig
from dlkf.data.drive import Drive
from dlkf.data.segments import whole_drives
from dlkf.filters.model_based import Mbkf
from dlkf.filters.smoother import SmoothedSolution
from dlkf.navigation.error_model import RATE_AVERAGE_S
from dlkf.navigation.state import POSITION
from dlkf.running.batched import run_filter
from dlkf.running.start import align_each

KINDS = ("file", "smoothed", "gnss")
WORTH = (4, 5, 9, 3, 2, 1)  # NMEA GGA qualities, the best first
ENOUGH = 0.2  # of the fixes: so many make a quality the one to use
UNSURE = 5.0  # times the usual 1σ: where the smoothed solution is no reference
LATE_S = 0.2  # a fix that waits longer for its epoch's end is not carried there


class ReferencedDrives(NamedTuple):
    """Drives with another reference, and its 1σ (n, 3) [m] in NED wherever it may be scored."""

    drives: list[Drive]
    sigma: Tensor
    skipped: dict[str, str]


def median_std(sigma: Tensor) -> tuple[float, float]:
    """Median horizontal and vertical 1σ [m] of a reference."""
    middle = sigma.median(0).values
    return float(middle[:2].norm()), float(middle[2])


def describe_reference(kind: str, sigma: Tensor) -> str:
    """What errors against it are errors against."""
    what = "smoothed solution with all fixes" if kind == "smoothed" else "good fixes"
    horizontal, vertical = median_std(sigma)
    return f"{what}, 1σ {horizontal:.2g} m horizontal, {vertical:.2g} m vertical (median, its own)"


def check_reference(kind: str) -> None:
    """InputError for an unknown reference."""
    if kind not in KINDS:
        raise InputError(f"reference={kind} is none of {', '.join(KINDS)}")


def make_reference(
    drives: Sequence[Drive], kind: str, estimator: Mbkf, align: AlignConfig, progress: ProgressCallback = no_progress
) -> ReferencedDrives:
    """The drives with their smoothed solution (``smoothed``) or their good fixes (``gnss``) as reference.

    ``smoothed``: position, velocity and attitude of ``estimator`` with all fixes, smoothed backwards
    (:mod:`dlkf.filters.smoother`), where its 1σ is not far above the usual. ``gnss``: the fixes of the best quality
    that is frequent, of those that the filter uses, brought to the IMU by the smoothed attitude; no attitude. Drives
    that cannot be aligned are left out and the reason reported, unless none is left (InputError).
    """
    check_reference(kind)
    made, sigmas, skipped = [], [], {}
    for k, (drive, start) in enumerate(zip(drives, align_each(drives, replace(align, from_rest=True)))):
        if isinstance(start, InputError):
            skipped[drive.name] = str(start)
            continue
        batch = whole_drives([drive], [start])
        solution = run_filter(batch, SmoothedSolution(estimator))
        n, row = int(batch.present[0].sum()), start.first + 1
        state, std = solution.posterior, solution.std
        assert std is not None  # a smoothed filter has a covariance
        frame = batch.frame
        r_e = frame.to_ecef(state.p_n)[0, :n]
        v_e = torch.einsum("ij,tj->ti", frame.C_en[0], state.v_n[0, :n])
        C_eb = frame.C_en[0] @ state.C_nb[0, :n]
        rows = slice(row, row + n)
        found = blank_reference(len(drive.gnss_r_e))
        if kind == "smoothed":
            sigma = std[0, :n, POSITION]
            sure = sigma.norm(dim=-1) <= UNSURE * sigma.norm(dim=-1).median()
            found["ref_C_eb"][rows] = C_eb
        else:
            r_e, v_e, good = _carry_to_imu(drive, rows, C_eb, v_e)
            sure = good & solution.used[0, :n]
            sigma = drive.gnss_std[rows, :3]
        found["ref_r_e"][rows], found["ref_v_e"][rows], found["ref_valid"][rows] = r_e, v_e, sure
        sigmas.append(sigma[sure])
        made.append(replace(drive, **found))
        progress(k + 1, len(drives))
    if not made:
        raise InputError(f"reference={kind}: {next(iter(skipped.values()), 'no drives')}")
    sigma = torch.cat(sigmas)
    if not len(sigma):
        raise InputError(f"reference={kind}: no fix is good enough to be one")
    return ReferencedDrives(made, sigma, skipped)


def blank_reference(rows: int) -> dict[str, Any]:
    """No reference at all, as fields of a drive with so many boundaries."""
    shapes = {"ref_r_e": (3,), "ref_v_e": (3,), "ref_C_eb": (3, 3), "ref_imu_error": (6,)}
    blank = {name: torch.full((rows, *shape), torch.nan, dtype=torch.float64) for name, shape in shapes.items()}
    return blank | {"ref_valid": torch.zeros(rows, dtype=torch.bool)}


def _carry_to_imu(drive: Drive, rows: slice, C_eb: Tensor, v_e: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Good fixes brought from the antenna to the IMU and from their time to the boundary: r_e, v_e, good.

    The velocity is the fix's where it has one, else the smoothed; the lever-arm velocity ω × l is taken off.
    """
    quality, seen = drive.quality[rows], drive.gnss_valid[rows, :3].all(-1)
    share = {q: float((quality[seen] == q).double().mean()) if bool(seen.any()) else 0.0 for q in WORTH}
    worst = next((k for k, q in enumerate(WORTH) if share[q] >= ENOUGH), len(WORTH) - 1)
    lag = drive.gnss_lag[rows, None]
    good = seen & torch.isin(quality, torch.tensor(WORTH[: worst + 1])) & (lag[:, 0] <= LATE_S)
    tail = max(1, round(RATE_AVERAGE_S * drive.rate_hz))
    rate_b = drive.imu[rows.start - 1 : rows.stop - 1, -tail:, 3:].double().mean(1)
    arm = drive.lever_arm_b.expand_as(rate_b)
    known = drive.gnss_valid[rows, 3:].all(-1, keepdim=True)
    arm_velocity = torch.einsum("tij,tj->ti", C_eb, torch.linalg.cross(rate_b, arm))
    velocity = torch.where(known, drive.gnss_v_e[rows] - arm_velocity, v_e)
    place = drive.gnss_r_e[rows] - torch.einsum("tij,tj->ti", C_eb, arm) + lag * v_e
    return place, velocity, good
