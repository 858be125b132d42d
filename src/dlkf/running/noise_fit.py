"""Noise of IMU, receiver and car on drives without a reference: the maximum likelihood of their fixes.

A filter predicts every fix, with a covariance S. With noise set too small the innovations z are larger than S
predicts, with noise set too large smaller; the density of z is greatest between the two. A fix a second
shows the short-term noise alone, so the drive is also run with fixes withheld, and those are scored as they would have
come in: they show how fast a drift grows, which is what matters in an outage. The density is Student's t with ν = 8, so
that a few wild fixes do not decide (Lange, Little & Taylor, JASA 84, 1989):

    −ln p(z) = ½ ln|S| + ½ (ν + d) ln(1 + zᵀ S⁻¹ z / ν) + const., d components

averaged over the fixes that were used and over those that were withheld, half and half. A wide log-normal prior about
the preset of the start keeps values that the drives do not determine.

Fixes that are late by τ and an antenna that sits a further forward than stated are two explanations of nearly the same:
the positions are τ v or a from where they should be; only the spread of the speeds and the velocities separate
them. So both are estimated, and one is taken only where it exceeds 3σ with the other free. σ² is the diagonal of the
sandwich H⁻¹ J H⁻¹ (White, Econometrica 50, 1982; H the curvature, J the scatter of the slopes of spans of 30 s), which
holds for neighbouring innovations that hang together.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from dlkf.base.console import ProgressCallback, no_progress
from dlkf.base.errors import InputError
from dlkf.data.aid_tables import AidTable
from dlkf.data.alignment import ALIGN, AlignConfig
from dlkf.data.drive import Batch, Drive
from dlkf.data.masks import withhold_fixes
from dlkf.data.segments import whole_drives
from dlkf.filters.build import FilterName, build_causal, has_prior, is_filter
from dlkf.filters.integration import BatchSolution, Estimator
from dlkf.filters.tuning import Tuning
from dlkf.navigation.imu_errors import ImuSpec
from dlkf.running.batched import run_filter
from dlkf.running.start import align_each

FREEDOM = 8.0  # ν
GAPS_S = ((30.0, 45.0), (30.0, 60.0), (60.0, 90.0))  # s withheld at the end of every so many
Data = TypeVar("Data", Batch, Drive)
Compiler = Callable[[Estimator, float, float], Estimator]  # filter, IMU rate [Hz], update interval [s]
IN_C = 300  # epochs of evidence from which on the search, some 150 trials, pays for a library of its filter
SETTLE_S = 20.0  # whose innovations depend more on the start than on the filter
OF_SENSORS = ("noise_density", "turn_on_bias", "instability")
OF_GNSS = ("position_std", "velocity_std")
OF_CAR = ("lateral_std", "vertical_std")
STEPS = (4.0, 2.0, 1.4)  # factors by which a value is tried up and down, ever finer
LONGEST_DELAY_S = 0.4
DELAY_STEP_S = 0.02  # times STEPS
SLIGHT_S = 0.005  # for slopes and curvature
SPAN_S = 30.0  # of a drive, whose innovations count as one for the scatter
WAYS = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, -1), (-1, 1))  # late, ahead, and one for the other
SURE = 3.0  # σ from which on a delay or a place of the antenna is taken
SURE_GAIN = 1e-3  # of the mean: less is no gain
USUAL, USUAL_OF_CAR = math.log(30.0), math.log(3.0)  # 1σ of ln(value / that at the start): keeps what nothing shows
DOUBTFUL_OF_CAR = 2.0  # m/s, a constraint's noise that no car has
LARGEST = {"accel.turn_on_bias": 1.0, "gyro.turn_on_bias": 0.1}  # m/s², rad/s


class FixOffset(NamedTuple):
    """Delay and lever-arm offset of the fixes against those stored."""

    delay_s: float = 0.0  # by which the fixes are older than their stamps
    ahead_m: float = 0.0  # by which the antenna sits further forward than stated

    def shift(self, by: FixOffset, step: float) -> FixOffset:
        """So many times ``by`` further."""
        return FixOffset(self.delay_s + step * by.delay_s, self.ahead_m + step * by.ahead_m)

    def apply(self, data: Data) -> Data:
        """A batch or a drive with fixes so placed."""
        lag = (data.gnss_lag + self.delay_s).clamp(max=0.99 * data.epoch_s)
        arm = data.lever_arm_b
        return replace(data, gnss_lag=lag, lever_arm_b=arm + arm.new_tensor([self.ahead_m, 0.0, 0.0]))


NO_OFFSET = FixOffset()


class NoiseFit(NamedTuple):
    """What was found, and how likely the fixes were before and after (mean −ln p of a fix, smaller is better)."""

    imu: ImuSpec
    tuning: Tuning
    placing: FixOffset  # zero where it is not sure
    placing_std: FixOffset  # 1σ, also where not significant; NaN where none was estimated
    before: float
    after: float

    def describe(self) -> dict[str, float]:
        """Plain values by name, SI units."""
        sensors = {
            f"{name}.{key}": float(getattr(sensor, key))
            for name, sensor in (("accel", self.imu.accel), ("gyro", self.imu.gyro))
            for key in OF_SENSORS
        }
        factors = {key: getattr(self.tuning, key) for key in (*OF_GNSS, *OF_CAR)}
        return sensors | factors | self.placing._asdict()

    def describe_offset(self) -> str:
        """One line on delay and antenna; empty where nothing was estimated."""
        (late, ahead), (late_std, ahead_std) = self.placing, self.placing_std
        if math.isnan(late_std):
            return ""
        way = "forward" if ahead > 0 else "back"
        far = f"{abs(ahead):.2f} m ± {ahead_std:.2f} m further {way} than lever_arm_m says"
        if not math.isfinite(late_std) or not math.isfinite(ahead_std):
            return "The drives do not show whether the fixes are late, nor where the antenna is"
        when = (
            f"{late:.3f} s ± {late_std:.3f} s late"
            if late
            else f"not significantly late (± {late_std:.3f} s; negative delays are not searched)"
        )
        where = far if ahead else f"where lever_arm_m says (± {ahead_std:.2f} m along the car)"
        return f"The fixes are {when}; the antenna sits {where}"

    def describe_doubt(self) -> str:
        """One line where the fixes contradict the constraints of a car; empty where they do not."""
        widest = max(OF_CAR, key=lambda name: getattr(self.tuning, name))
        if (std := getattr(self.tuning, widest)) < DOUBTFUL_OF_CAR:
            return ""
        return (
            f"The fixes contradict the vehicle constraints ({widest} {std:.2g} m/s): wrong axes of the IMU, or fixes "
            "that are frozen or jump; see dlkf doctor, or take model=plus, which refuses such fixes"
        )


@dataclass(frozen=True)
class Evidence:
    """Drives as one batch: every drive with all its fixes, and once for each type of gap without some."""

    batch: Batch
    offered: Tensor  # (B, T) bool: fixes that a filter might have used before any were withheld
    compiler: Compiler | None = None  # of the filters of the trials

    @staticmethod
    def of(drives: Sequence[Drive], minutes: float = 20.0, align: AlignConfig = ALIGN) -> Evidence:
        """Of the beginnings of some drives, ``minutes`` in all, spread evenly. InputError where none can be aligned."""
        chosen = list(drives)[:: max(1, len(drives) // 20)]
        seconds = max(60.0 * minutes / len(chosen), 120.0)
        parts = [d.part(0, min(d.epochs, math.ceil(seconds / d.epoch_s))) for d in chosen]
        aligned = [(d, s) for d, s in zip(parts, align_each(parts, align)) if not isinstance(s, InputError)]
        if not aligned:
            raise InputError("imu=auto cannot estimate the noise: none of the drives can be aligned")
        kinds = 1 + len(GAPS_S)
        repeated = [both for both in aligned for _ in range(kinds)]
        batch = whole_drives([d for d, _ in repeated], [s for _, s in repeated])
        offered = batch.gnss_valid[..., :3].all(-1) & batch.present
        t = batch.epoch_s * torch.arange(1, batch.size[1] + 1, dtype=torch.float64)
        hidden = torch.zeros_like(batch.available)
        for k, (length, every) in enumerate(GAPS_S, start=1):
            hidden[k::kinds] = (t % every > every - length) & (t > every)
        return Evidence(withhold_fixes(batch, hidden), offered & (t > SETTLE_S))

    @property
    def fixes(self) -> int:
        """How many are scored."""
        return int(self.offered.sum())

    @property
    def pace(self) -> float:
        """Mean speed of the fixes [m/s], 1 at least."""
        speed = self.batch.gnss[..., 3:5].norm(dim=-1)
        seen = speed[self.batch.gnss_valid[..., 3:5].all(-1) & self.batch.present]
        return max(float(seen.mean()), 1.0) if len(seen) else 1.0

    def negative_log_likelihood(self, name: str, imu: ImuSpec, tuning: Tuning, placing: FixOffset = NO_OFFSET) -> float:
        """Mean −ln p of the fixes; infinite where the filter diverges."""
        value = float(self.shares(name, imu, tuning, placing).sum())
        return value if math.isfinite(value) else math.inf

    def shares(self, name: str, imu: ImuSpec, tuning: Tuning, placing: FixOffset) -> Float[Tensor, "B T"]:
        """What every fix adds to that mean; 0 without one."""
        batch = placing.apply(self.batch)
        estimator = build_causal(name, imu, "the search for noise does not", tuning=tuning)
        if self.compiler is not None:
            estimator = self.compiler(estimator, 1 / batch.dt, batch.epoch_s)
        solution = run_filter(batch, estimator, keep_covariances=True)
        scored, kept = self.offered & batch.available, self.offered & ~batch.available
        out = torch.zeros_like(batch.gnss_lag)
        out[scored] = 0.5 * _score_used_fixes(batch, solution)[scored] / scored.sum()
        out[kept] = 0.5 * _score_withheld_fixes(batch, solution, tuning)[kept] / kept.sum()
        return out

    def spans(self, shares: Float[Tensor, "B T"]) -> Float[Tensor, " n"]:
        """Their sums over spans of a drive, the drive's copies together."""
        kinds, long = 1 + len(GAPS_S), max(1, round(SPAN_S / self.batch.epoch_s))
        per_drive = shares.unflatten(0, (-1, kinds)).sum(1)
        return pad(per_drive, (0, -per_drive.shape[1] % long)).unflatten(1, (-1, long)).sum(-1).flatten()


def _score_used_fixes(batch: Batch, solution: BatchSolution) -> Float[Tensor, "B T"]:
    """Of the innovations of fixes that the filter was offered; a component without one adds nothing."""
    assert solution.innovation_covariance is not None
    components = (batch.gnss_valid & batch.available.unsqueeze(-1)).sum(-1)
    return _density(solution.innovation, solution.innovation_covariance, components)


def _score_withheld_fixes(batch: Batch, solution: BatchSolution, tuning: Tuning) -> Float[Tensor, "B T"]:
    """Of horizontal positions that the filter did not see, under its own covariance and that of the fix."""
    assert solution.position_covariance is not None
    state = solution.prior
    antenna = state.p_n + (state.C_nb @ batch.lever_arm_b[:, None, :, None]).squeeze(-1)
    z = batch.gnss[..., :3] - (antenna - batch.gnss_lag[..., None] * state.v_n)
    R = (tuning.position_std * batch.gnss_std[..., :2]).clamp_min(tuning.position_floor).square()
    S = solution.position_covariance + torch.diag_embed(R)
    return _density(torch.nan_to_num(z[..., :2]), S, torch.full(z.shape[:2], 2))


def _density(z: Float[Tensor, "*b m"], S: Float[Tensor, "*b m m"], components: Tensor) -> Float[Tensor, "*b"]:
    L = torch.linalg.cholesky_ex(S)[0]
    square = torch.linalg.solve_triangular(L, z.unsqueeze(-1), upper=False).square().sum((-2, -1))
    return L.diagonal(dim1=-2, dim2=-1).log().sum(-1) + 0.5 * (FREEDOM + components) * torch.log1p(square / FREEDOM)


def find_noise(
    evidence: Evidence,
    name: str,
    imu: ImuSpec,
    tuning: Tuning,
    *,
    delay: bool = True,
    called: str = "found",
    progress: ProgressCallback = no_progress,
    compiler: Compiler | None = None,
) -> NoiseFit:
    """The noise under which the fixes are most likely, for the Kalman filter of this name.

    A search along one value after the other, from ``imu`` and ``tuning`` on, in ever finer steps. It begins with noise
    and biases of both sensors together, for a preset is as a rule wrong in all of them. ``delay``: the age of the fixes
    and the antenna's place along the car too. From five minutes of evidence on trials run through
    ``compiler`` (:func:`dlkf.onboard.compiled_filter.compile_or_keep`). Raises InputError where the drives have no fix
    to score.
    """
    if compiler is not None and int(evidence.batch.present.sum()) >= IN_C:
        first = build_causal(name, imu, "the search for noise does not", tuning=tuning)
        if compiler(first, 1 / evidence.batch.dt, evidence.batch.epoch_s) is not first:
            evidence = replace(evidence, compiler=compiler)
    sensors = [(s, k) for s in ("accel", "gyro") for k in OF_SENSORS]
    x = {f"{s}.{k}": max(float(getattr(getattr(imu, s), k)), 1e-7) for s, k in sensors}
    car = FilterName.parse(name).knows_car
    x |= {k: float(getattr(tuning, k)) for k in (*OF_GNSS, *(OF_CAR if car else ()))}
    start, usual = dict(x), {k: USUAL_OF_CAR if k in OF_CAR else USUAL for k in x}
    directions = [tuple(k for k in x if k.startswith(s)) for s in ("accel", "gyro")] + [(k,) for k in x]
    pace = evidence.pace
    shifts = [FixOffset(DELAY_STEP_S * late, DELAY_STEP_S * pace * ahead) for late, ahead in WAYS]
    done, tried_before = 0, dict[tuple[float, ...], float]()

    def score(values: Mapping[str, float], placing: FixOffset) -> float:
        nonlocal done
        done += 1
        progress(done, None)  # how many it takes is known at the end alone
        if any(values[k] > limit for k, limit in LARGEST.items()) or not 0 <= placing.delay_s <= LONGEST_DELAY_S:
            return math.inf
        place = (*(round(math.log(v), 9) for v in values.values()), *(round(x, 9) for x in placing))
        if place not in tried_before:  # a step back, or one that failed before another value moved
            away = sum(0.5 * (math.log(v / start[k]) / usual[k]) ** 2 for k, v in values.items())
            found = evidence.negative_log_likelihood(name, *_build(values, imu, tuning, called), placing)
            tried_before[place] = found + away / evidence.fixes
        return tried_before[place]

    def search(
        x: Mapping[str, float], placing: FixOffset, best: float, steps: Sequence[float], shifts: Sequence[FixOffset]
    ) -> tuple[Mapping[str, float], FixOffset, float]:
        for step in steps:
            moved = True
            for _ in range(4):
                if not moved:
                    break
                moved = False
                for direction in directions:
                    for factor in (step, 1 / step):
                        tried = {k: factor * v if k in direction else v for k, v in x.items()}
                        while (value := score(tried, placing)) < best - SURE_GAIN:
                            best, x, moved = value, tried, True
                            tried = {k: factor * v if k in direction else v for k, v in x.items()}
                for shift in shifts:
                    while (value := score(x, there := placing.shift(shift, step))) < best - SURE_GAIN:
                        best, placing, moved = value, there, True
        return x, placing, best

    before = score(x, NO_OFFSET) if evidence.fixes else math.inf
    if not math.isfinite(before):
        need = "two minutes with fixes, and a filter that does not diverge"
        raise InputError(f"imu=auto cannot estimate the noise: it needs {need}")
    x, placing, best = search(x, NO_OFFSET, before, STEPS, shifts if delay else ())
    unknown = FixOffset(math.nan, math.nan)
    if not delay:
        return NoiseFit(*_build(x, imu, tuning, called), placing, unknown, before, best)
    coarse = placing
    placing, std = search_fix_offset(evidence, name, *_build(x, imu, tuning, called), coarse)
    if placing != coarse:
        best = score(x, placing)
        x, placing, best = search(x, placing, best, STEPS[1:], ())
    return NoiseFit(*_build(x, imu, tuning, called), placing, std, before, best)


def check_finds_noise(name: str) -> None:
    """InputError for ``imu=auto`` with a filter that takes no noise, or more than noise."""
    if not is_filter(name) or name == "ins" or has_prior(name):
        what = f"imu=auto estimates the noise of Kalman filters, and model={name} has no such noise"
        raise InputError(f"{what}: leave imu out, give a preset, or use model=mbkf21_nhc")


def generic_filter(
    drives: Sequence[Drive], name: str, imu: ImuSpec, tuning: Tuning, align: AlignConfig,
    aids: Sequence[AidTable] = (), **given: Any,
) -> tuple[Estimator, list[Drive], NoiseFit]:  # fmt: skip
    """A Kalman filter that finds its noise on the drives themselves, and the drives with their fixes so placed.

    One with vehicle constraints also takes ``aids``, sensors that the drives have, while the noise is found. InputError
    as :func:`check_finds_noise`.
    """
    check_finds_noise(name)
    name = FilterName.parse(name).add(table.name for table in aids)
    found = find_noise(Evidence.of(drives, align=align), name, imu, tuning, **given)
    placed = [found.placing.apply(d) for d in drives]
    return build_causal(name, found.imu, "imu=auto does not", tuning=found.tuning), placed, found


def search_fix_offset(
    evidence: Evidence, name: str, imu: ImuSpec, tuning: Tuning, placing: FixOffset
) -> tuple[FixOffset, FixOffset]:
    """Delay and place to a fraction of their 1σ, zero where they are not sure beside each other, and their 1σ."""
    unit = torch.tensor([1.0, evidence.pace], dtype=torch.float64)  # so that both are in seconds
    at, std = torch.tensor(placing, dtype=torch.float64) / unit, torch.zeros(2, dtype=torch.float64)
    free = [0, 1]

    def spans(of: Tensor) -> Tensor:
        return evidence.spans(evidence.shares(name, imu, tuning, FixOffset(*(of * unit).tolist())))

    def differentiate(of: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """A point whose neighbours are no future fixes, slopes of the spans there (n, k) and curvature (k, k)."""
        of = torch.stack((of[0].clamp_min(SLIGHT_S), of[1]))
        e = SLIGHT_S * torch.eye(2, dtype=of.dtype)[free]
        middle, up, down = spans(of), [spans(of + d) for d in e], [spans(of - d) for d in e]
        slopes = torch.stack([(u - d) / (2 * SLIGHT_S) for u, d in zip(up, down)], -1)
        H = torch.diag(torch.stack([(u - 2 * middle + d).sum() / SLIGHT_S**2 for u, d in zip(up, down)]))
        if len(free) == 2:
            same, other = spans(of + e.sum(0)) + spans(of - e.sum(0)), spans(of + e[0] - e[1]) + spans(of - e[0] + e[1])
            H[0, 1] = H[1, 0] = (same - other).sum() / (4 * SLIGHT_S**2)
        return of, slopes, H

    value = float(spans(at).sum())
    for step in (8 * SLIGHT_S, 4 * SLIGHT_S, 2 * SLIGHT_S):  # far off the density's curvature is not usable
        for way in WAYS:
            there = at + step * torch.tensor(way, dtype=at.dtype)
            while 0 <= there[0] <= LONGEST_DELAY_S and (tried := float(spans(there).sum())) < value:
                at, value = there, tried
                there = at + step * torch.tensor(way, dtype=at.dtype)
    while free:
        value, (around, slopes, H) = float(spans(at).sum()), differentiate(at)
        for _ in range(4):
            if not bool((torch.linalg.eigvalsh(H) > 0).all()):
                break
            there = at.clone()
            there[free] = (around[free] - torch.linalg.solve(H, slopes.sum(0))).clamp(-1.0, 1.0)
            there[0] = there[0].clamp(0.0, LONGEST_DELAY_S)
            if not (tried := float(spans(there).sum())) < value:
                break
            at, value, (around, slopes, H) = there, tried, differentiate(there)
        back = torch.linalg.pinv(H)
        convex = bool((torch.linalg.eigvalsh(H) > 0).all())
        std[free] = (back @ (slopes.T @ slopes) @ back).diagonal().sqrt() if convex else math.inf
        sure = [k for k in free if abs(at[k]) > SURE * std[k]]
        at[[k for k in free if k not in sure]] = 0.0
        if sure == free:
            break
        free = sure
    return FixOffset(*(at * unit).tolist()), FixOffset(*(std * unit).tolist())


def _build(values: Mapping[str, float], imu: ImuSpec, tuning: Tuning, called: str) -> tuple[ImuSpec, Tuning]:
    """IMU and factors with these values."""
    of = {s: {k: values[f"{s}.{k}"] for k in OF_SENSORS} for s in ("accel", "gyro")}
    source = f"found on drives without a reference, beginning with {imu.name}"
    accel, gyro = replace(imu.accel, **of["accel"]), replace(imu.gyro, **of["gyro"])
    spec = replace(imu, name=called, source=source, accel=accel, gyro=gyro)
    return spec, replace(tuning, **{k: v for k, v in values.items() if k in (*OF_GNSS, *OF_CAR)})
