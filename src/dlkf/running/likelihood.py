"""Noise of an IMU, of its receiver and of the car, found on drives without a reference: what makes their fixes likely.

A filter predicts every fix, with a covariance S. With noise that is told too small the innovations z are larger than S
says, with noise told too large S is larger than they are; the density of z is greatest between the two. A fix a second
shows the short-term noise alone, so the drive is also run with fixes withheld, and those are scored as they would have
come in: they show how fast a drift grows, which is what matters in an outage. The density is Student's t with ν = 8, so
that a few wild fixes do not decide (Lange, Little & Taylor, JASA 84, 1989):

    −ln p(z) = ½ ln|S| + ½ (ν + d) ln(1 + zᵀ S⁻¹ z / ν) + const., d components

averaged over the fixes that were used and over those that were withheld, half and half. A wide log-normal prior about
the preset of the start keeps values that the drives say nothing of.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from dlkf.data.alignment import ALIGN, AlignConfig
from dlkf.data.drive import Batch, Drive
from dlkf.data.masks import withhold
from dlkf.data.segments import whole_drives
from dlkf.errors import InputError
from dlkf.filters.build import build_causal, is_filter
from dlkf.filters.integration import Estimator, Solution
from dlkf.filters.tuning import Tuning
from dlkf.navigation.imu_errors import ImuSpec
from dlkf.running.batched import run_filter
from dlkf.running.start import align_each

FREEDOM = 8.0  # ν
GAPS_S = ((30.0, 45.0), (30.0, 60.0), (60.0, 90.0))  # s withheld at the end of every so many
SETTLE_S = 20.0  # whose innovations say more of the start than of the filter
OF_SENSORS = ("noise_density", "turn_on_bias", "instability")
OF_GNSS = ("position_std", "velocity_std")
OF_CAR = ("lateral_std", "vertical_std")
STEPS = (4.0, 2.0, 1.4)  # factors by which a value is tried up and down, ever finer
LONGEST_DELAY_S = 0.4
SURE_GAIN = 1e-3  # of the mean: less is no gain
USUAL, USUAL_OF_CAR = math.log(30.0), math.log(3.0)  # 1σ of ln(value / that at the start): keeps what nothing shows
LARGEST = {"accel.turn_on_bias": 1.0, "gyro.turn_on_bias": 0.1}  # m/s², rad/s


class Found(NamedTuple):
    """What was found, and how likely the fixes were before and after (mean −ln p of a fix, smaller is better)."""

    imu: ImuSpec
    tuning: Tuning
    delay_s: float  # by which the fixes are older than their stamps
    before: float
    after: float

    def described(self) -> dict[str, float]:
        """Plain values by name, SI units."""
        sensors = {
            f"{name}.{key}": float(getattr(sensor, key))
            for name, sensor in (("accel", self.imu.accel), ("gyro", self.imu.gyro))
            for key in OF_SENSORS
        }
        return sensors | {key: getattr(self.tuning, key) for key in (*OF_GNSS, *OF_CAR)} | {"delay_s": self.delay_s}


@dataclass(frozen=True)
class Evidence:
    """Drives as one batch: every drive with all its fixes, and once for each kind of gap without some."""

    batch: Batch
    offered: Tensor  # (B, T) bool: fixes that a filter might have used before any were withheld

    @staticmethod
    def of(drives: Sequence[Drive], minutes: float = 20.0, align: AlignConfig = ALIGN) -> Evidence:
        """Of the beginnings of some drives, ``minutes`` in all, spread evenly. InputError where none can be aligned."""
        chosen = list(drives)[:: max(1, len(drives) // 20)]
        seconds = max(60.0 * minutes / len(chosen), 120.0)
        parts = [d.part(0, min(d.epochs, math.ceil(seconds / d.epoch_s))) for d in chosen]
        aligned = [(d, s) for d, s in zip(parts, align_each(parts, align)) if not isinstance(s, InputError)]
        if not aligned:
            raise InputError("no noise can be found: none of the drives can be aligned")
        kinds = 1 + len(GAPS_S)
        repeated = [both for both in aligned for _ in range(kinds)]
        batch = whole_drives([d for d, _ in repeated], [s for _, s in repeated])
        offered = batch.gnss_valid[..., :3].all(-1) & batch.present
        t = batch.epoch_s * torch.arange(1, batch.size[1] + 1, dtype=torch.float64)
        hidden = torch.zeros_like(batch.available)
        for k, (length, every) in enumerate(GAPS_S, start=1):
            hidden[k::kinds] = (t % every > every - length) & (t > every)
        return Evidence(withhold(batch, hidden), offered & (t > SETTLE_S))

    @property
    def fixes(self) -> int:
        """How many are scored."""
        return int(self.offered.sum())

    def surprise(self, name: str, imu: ImuSpec, tuning: Tuning, delay_s: float = 0.0) -> float:
        """Mean −ln p of the fixes; infinite where the filter diverges."""
        batch = self.batch
        if delay_s:
            batch = replace(batch, gnss_lag=(batch.gnss_lag + delay_s).clamp(max=0.99 * batch.epoch_s))
        solution = run_filter(batch, build_causal(name, imu, "this does not", tuning=tuning), keep_covariances=True)
        used, withheld = _used(solution), _withheld(batch, solution, tuning)
        told = self.offered & batch.available
        value = 0.5 * (used[told].mean() + withheld[self.offered & ~batch.available].mean())
        return float(value) if bool(value.isfinite()) else math.inf


def _used(solution: Solution) -> Float[Tensor, "B T"]:
    """Of the innovations of fixes that the filter was offered; a component without one adds nothing."""
    assert solution.covariances is not None
    S = solution.covariances.innovation
    components = (solution.covariances.H != 0).any(-1).sum(-1)
    return _density(solution.innovation, S, components)


def _withheld(batch: Batch, solution: Solution, tuning: Tuning) -> Float[Tensor, "B T"]:
    """Of horizontal positions that the filter did not see, under its own covariance and that of the fix."""
    assert solution.covariances is not None
    state = solution.prior
    antenna = state.p_n + (state.C_nb @ batch.lever_arm_b[:, None, :, None]).squeeze(-1)
    z = batch.gnss[..., :3] - (antenna - batch.gnss_lag[..., None] * state.v_n)
    R = (tuning.position_std * batch.gnss_std[..., :2]).clamp_min(tuning.position_floor).square()
    S = solution.covariances.predicted[..., :2, :2] + torch.diag_embed(R)
    return _density(torch.nan_to_num(z[..., :2]), S, torch.full(z.shape[:2], 2))


def _density(z: Float[Tensor, "*b m"], S: Float[Tensor, "*b m m"], components: Tensor) -> Float[Tensor, "*b"]:
    square = (z * torch.linalg.solve(S, z.unsqueeze(-1)).squeeze(-1)).sum(-1)
    return 0.5 * torch.logdet(S) + 0.5 * (FREEDOM + components) * torch.log1p(square / FREEDOM)


def find_noise(
    evidence: Evidence,
    name: str,
    imu: ImuSpec,
    tuning: Tuning,
    *,
    delay: bool = True,
    called: str = "found",
    progress: Callable[[int, int], None] | None = None,
) -> Found:
    """The noise under which the fixes are most likely, for the Kalman filter of this name.

    A search along one value after the other, from ``imu`` and ``tuning`` on, in ever finer steps. It begins with noise
    and biases of both sensors together, for a preset is as a rule wrong in all of them. ``delay``: the age of the fixes
    too. Raises InputError where the drives have no fix to score.
    """
    sensors = [(s, k) for s in ("accel", "gyro") for k in OF_SENSORS]
    x = {f"{s}.{k}": max(float(getattr(getattr(imu, s), k)), 1e-7) for s, k in sensors}
    car = {"nhc", "car"} & set(name.partition("+")[0].split("_"))
    x |= {k: float(getattr(tuning, k)) for k in (*OF_GNSS, *(OF_CAR if car else ()))}
    start, usual = dict(x), {k: USUAL_OF_CAR if k in OF_CAR else USUAL for k in x}
    directions = [tuple(k for k in x if k.startswith(s)) for s in ("accel", "gyro")] + [(k,) for k in x]
    done, most = 0, 4 * len(STEPS) * len(directions)

    def judged(values: Mapping[str, float], late: float) -> float:
        nonlocal done
        done += 1
        if progress is not None:
            progress(min(done, most), most)
        if any(values[k] > limit for k, limit in LARGEST.items()):
            return math.inf
        away = sum(0.5 * (math.log(v / start[k]) / usual[k]) ** 2 for k, v in values.items())
        return evidence.surprise(name, *_built(values, imu, tuning, called), late) + away / evidence.fixes

    before = best = judged(x, 0.0) if evidence.fixes else math.inf
    if not math.isfinite(best):
        raise InputError("no noise can be found: it takes two minutes with fixes, and a filter that does not diverge")
    late = 0.0
    for step in STEPS:
        moved = True
        for _ in range(4):
            if not moved:
                break
            moved = False
            for direction in directions:
                for factor in (step, 1 / step):
                    tried = x | {k: factor * x[k] for k in direction}
                    while (value := judged(tried, late)) < best - SURE_GAIN:
                        best, x, moved = value, tried, True
                        tried = x | {k: factor * x[k] for k in direction}
            if delay:
                for shift in (0.02 * step, -0.02 * step):
                    while 0 <= late + shift <= LONGEST_DELAY_S and judged(x, late + shift) < best - SURE_GAIN:
                        late, moved = late + shift, True
                        best = judged(x, late)
    return Found(*_built(x, imu, tuning, called), late, before, best)


def untold(
    drives: Sequence[Drive], name: str, imu: ImuSpec, tuning: Tuning, align: AlignConfig, **given: Any
) -> tuple[Estimator, list[Drive], Found]:
    """A Kalman filter that finds its noise on the drives themselves, and the drives with the age of their fixes.

    InputError for a filter that is told nothing anyway, or told more than noise.
    """
    if not is_filter(name) or name == "ins" or "prior" in name.split("_"):
        raise InputError(f"imu=auto finds the noise of a Kalman filter, model={name} takes none; leave imu out")
    found = find_noise(Evidence.of(drives, align=align), name, imu, tuning, **given)
    late = [replace(d, gnss_lag=(d.gnss_lag + found.delay_s).clamp(max=0.99 * d.epoch_s)) for d in drives]
    return build_causal(name, found.imu, "imu=auto does not", tuning=found.tuning), late, found


def _built(values: Mapping[str, float], imu: ImuSpec, tuning: Tuning, called: str) -> tuple[ImuSpec, Tuning]:
    """IMU and factors with these values."""
    of = {s: {k: values[f"{s}.{k}"] for k in OF_SENSORS} for s in ("accel", "gyro")}
    source = f"found on drives without a reference, beginning with {imu.name}"
    accel, gyro = replace(imu.accel, **of["accel"]), replace(imu.gyro, **of["gyro"])
    spec = replace(imu, name=called, source=source, accel=accel, gyro=gyro)
    return spec, replace(tuning, **{k: v for k, v in values.items() if k in (*OF_GNSS, *OF_CAR)})
