"""Heading search: hypotheses in parallel, each a filter of its own, until one is significantly more likely.

A course is no heading where the car reverses, and a poor one where fixes are coarse. So a filter with 15 states that
moves along its axes (:class:`Sideslip`) is run from each of several headings, and they are weighed by their
innovations z with covariance S = H P Hᵀ + R (multiple-model estimation, Magill 1965; Bar-Shalom et al. 2001,
sect. 11.6):

    ln p(heading | z₁…z_T) = ln p(heading) − ½ Σ (zᵀ S⁻¹ z + ln |S|) + const.

Errors of a receiver last: fixes count as one a second, however many there are, and no fix is better than
:data:`FIX_FLOOR`. Few cars drive far or fast in reverse: a heading under which the car reverses loses
(1 + v²/(2 m/s)²) / :data:`REVERSE_S` a second. Without fixes nothing is weighed, and all headings are carried on.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dlkf.data.alignment import ACCEL_BIAS_STD, SIDESLIP_STD, AlignConfig, Start, level_attitude
from dlkf.data.drive import Drive
from dlkf.data.segments import whole_drives
from dlkf.data.velocity_fit import JOLT_STD, scale_std
from dlkf.filters.constraints import CarConstraints
from dlkf.filters.gating import Gate
from dlkf.filters.gnss_fix import GnssFix
from dlkf.filters.integration import Covariances, Epoch, Fix, Step, advance
from dlkf.filters.model_based import Mbkf
from dlkf.filters.sources import Predicted
from dlkf.filters.stationarity import VibrationLevel
from dlkf.filters.tuning import Tuning
from dlkf.navigation.attitude import rotation_from_rpy, vector_from_rotation
from dlkf.navigation.calibration import ImuError
from dlkf.navigation.earth import STANDARD_GRAVITY, TangentFrame
from dlkf.navigation.error_model import PLAIN, RATE_AVERAGE_S
from dlkf.navigation.imu_errors import ImuSpec, SensorErrors
from dlkf.navigation.state import ATTITUDE, GYRO, STATES, NavState

RING = 12  # headings all round, beside the course and its reverse
COUNT = RING + 2
REVERSE_PRIOR, REVERSE_SPEED = 0.1, 4.0  # probability that a car reverses, and 1σ [m/s] of how fast it then is
REVERSE_S = (5.0, 1.0)  # mean time of reversing: of a slow car, and at most
RING_PRIOR = 0.1  # of all headings of the ring together, where a course is coarse
COARSE = math.radians(10)  # a course with a larger 1σ is
NIS_CAP = 9.0  # the most that one fix may count against a heading: an outlier is no proof
DECIDED = 5.0  # ln of the odds against any other heading
OTHER = math.radians(25)  # apart, to be another
READY_STD = math.radians(6.5)  # of a heading that a filter may begin with before the search is over
BIAS_OVERBOUND, LEAST_BIAS_STD = 2.0, 1e-3  # on the 1σ of its gyroscope bias [rad/s]
OVERBOUND = 1.25  # on the posterior's 1σ: the errors of the IMU are a guess
FIX_FLOOR = (0.3, 0.3, 0.5, 0.05, 0.05, 0.1)  # m, m/s
# an unknown IMU: the most that MEMS on a car's roof have shown
ANY_IMU = ImuSpec(
    "any",
    SensorErrors(noise_density=5e-3, turn_on_bias=0.3, scale_factor=5e-3, misalignment=5e-3),
    SensorErrors(noise_density=5e-4, turn_on_bias=3e-2, scale_factor=5e-3, misalignment=5e-3),
)


class Sideslip(CarConstraints):
    """The constraints across the car alone, without detection of standstills."""

    def detect_rest(
        self, epoch: Epoch, turning: Tensor, prediction: Predicted, memory: Any
    ) -> tuple[Bool[Tensor, " B"], VibrationLevel, Float[Tensor, "B 3"]]:
        """Never."""
        return torch.zeros(len(turning), dtype=torch.bool), memory.liveliness, torch.zeros_like(turning)


@dataclass(frozen=True)
class Case:
    """A drive from the bank's first boundary on, the start there by course, and the mean specific force there [m/s²].

    ``rest_force``: specific force of the last standstill carried to the boundary's axes, and 1σ [rad] of its direction;
    None where the car has not been at rest. ``scatter``: how many times more than claimed positions and velocities
    scatter.
    """

    drive: Drive
    start: Start
    force_b: Float[Tensor, " 3"]
    rest_force: tuple[Float[Tensor, " 3"], float] | None = None
    scatter: tuple[float, float] = (1.0, 1.0)


class Bank(NamedTuple):
    """B cases of K headings, case by case; ``score`` is ln p but for a constant."""

    memory: Any
    state: NavState  # (B K, …)
    error: ImuError
    frame: TangentFrame
    lever_arm_b: Float[Tensor, "BK 3"]
    score: Float[Tensor, "B K"]
    weighed: Bool[Tensor, " B"]  # by a fix of the last epoch
    scatter: Float[Tensor, "BK 2"]  # of positions and velocities, over what they claim
    noise: Float[Tensor, "B 2"] | None = None  # as the starts have it


class HeadingVerdict(NamedTuple):
    """Number of the most probable heading of a case, probability of the others, 1σ [rad] of its yaw."""

    best: int
    doubt: float
    std: float
    weighed: bool

    @property
    def decided(self) -> bool:
        """Whether no other heading is left."""
        return self.doubt < 1 / (1 + math.exp(DECIDED))

    def ready(self, seconds: float, config: AlignConfig) -> bool:
        """Whether a filter may begin after so many seconds of search; one that looks ahead takes all of them."""
        enough = seconds >= config.search_s
        return self.weighed and self.decided and (enough or (self.std <= READY_STD and not config.from_rest))


def begin_bank(cases: Sequence[Case]) -> Bank:
    """All headings of all cases: the course, its reverse, and where the course is coarse a ring.

    An earlier standstill shows which way is up: headings under which the GNSS acceleration of the window needs another
    tilt lose, and all begin with the tilt of the standstill.
    """
    ring = 2 * math.pi / RING * (torch.arange(RING, dtype=torch.float64) + 0.5)
    turns = torch.cat((torch.tensor([0.0, math.pi], dtype=torch.float64), ring))
    turned = rotation_from_rpy(torch.stack((0 * turns, 0 * turns, turns), -1))
    batch = whole_drives([c.drive.part(0, 1) for c in cases], [c.start for c in cases])
    C, std, score = [], [], []
    for case in cases:
        start = case.start
        x = level_attitude(turned @ start.state.C_nb, case.force_b, start.state.C_nb @ case.force_b)
        course_std = float(start.std[8])
        speed = float(start.state.v_n[:2].norm())
        prior = torch.full((COUNT,), -math.inf, dtype=torch.float64)
        prior[0] = math.log(1 - REVERSE_PRIOR)
        prior[1] = math.log(REVERSE_PRIOR) - 0.5 * (speed / REVERSE_SPEED) ** 2
        if course_std > COARSE:
            prior[2:] = math.log(RING_PRIOR / RING) + (ring.cos() < 0) * prior[1]
        tilt = start.std[6:8]
        if case.rest_force is not None:
            rest_b, rest_std = case.rest_force
            apart = torch.linalg.cross(x.mT @ x.new_tensor([0.0, 0.0, -1.0]), (rest_b / rest_b.norm()).expand(COUNT, 3))
            chi2 = apart.square().sum(-1) / (rest_std**2 + float(tilt[0]) ** 2)
            prior = prior - 0.5 * chi2.clamp(max=NIS_CAP)
            up = x.new_tensor([0.0, 0.0, -1.0]) * rest_b.norm()
            x, tilt = (
                level_attitude(x, rest_b, up),
                torch.full_like(tilt, math.hypot(rest_std, ACCEL_BIAS_STD / STANDARD_GRAVITY)),
            )
        yaw = tilt.new_full((COUNT,), math.pi / RING)
        yaw[:2] = course_std
        std.append(torch.cat((start.std[:6].expand(COUNT, 6), tilt.expand(COUNT, 2), yaw[:, None]), -1))
        C.append(x)
        score.append(prior)
    C_nb = torch.cat(C)
    bank = batch.select(torch.arange(len(cases)).repeat_interleave(COUNT))
    # the lever arm as the attitude has it
    after = [c.drive.imu[0, : max(1, round(RATE_AVERAGE_S * c.drive.rate_hz)), 3:] for c in cases]
    rate_b = torch.stack([rates.double().mean(0) for rates in after]).repeat_interleave(COUNT, 0)
    less, arm = bank.start.C_nb - C_nb, bank.lever_arm_b[..., None]
    p = bank.start.p_n + (less @ arm)[..., 0]
    v = bank.start.v_n + (less @ torch.linalg.cross(rate_b, bank.lever_arm_b)[..., None])[..., 0]
    begun = replace(bank, start=NavState(p, v, C_nb), start_std=torch.cat(std))
    memory, error = bank_filter().begin(begun)
    weighed = torch.ones(len(cases), dtype=torch.bool)
    scatter = p.new_tensor([c.scatter for c in cases]).repeat_interleave(COUNT, 0)
    return Bank(
        memory, begun.start, error, bank.frame.prepare(), bank.lever_arm_b, torch.stack(score), weighed, scatter,
        batch.start_noise,
    )  # fmt: skip


class EarthFix(NamedTuple):
    """A fix of each case at the end of an epoch, as the boundaries of a drive hold it."""

    r_e: Float[Tensor, "B 3"]
    v_e: Float[Tensor, "B 3"]
    std: Float[Tensor, "B 6"]
    valid: Bool[Tensor, "B 6"]
    lag: Float[Tensor, " B"]

    @staticmethod
    def of(drives: Sequence[Drive], rows: Sequence[int]) -> EarthFix:
        """Of drives at a boundary each."""
        columns = ("gnss_r_e", "gnss_v_e", "gnss_std", "gnss_valid", "gnss_lag")
        return EarthFix(*(torch.stack([getattr(d, c)[k] for d, k in zip(drives, rows)]) for c in columns))


def advance_bank(bank: Bank, imu: Float[Tensor, "B M 6"], fix: EarthFix, dt: float) -> Bank:
    """The bank one epoch on."""
    epoch_s = imu.shape[1] * dt
    r_e, v_e, std, valid, lag = (x.repeat_interleave(COUNT, 0) for x in fix)
    position, velocity = bank.scatter.split(1, -1)
    std = torch.cat((scale_std(std[:, :3], position), scale_std(std[:, 3:], velocity, JOLT_STD)), -1)
    value = torch.cat((bank.frame.from_ecef(r_e), bank.frame.rotate_from_ecef(v_e)), -1)
    given = Fix(torch.where(valid, value, 0.0), fix_std(std, epoch_s), valid, lag if bool(lag.any()) else None)
    memory, step = advance(
        bank_filter(), bank.memory, bank.state, bank.error, imu.repeat_interleave(COUNT, 0), given,
        dt=dt, frame=bank.frame, lever_arm_b=bank.lever_arm_b,
    )  # fmt: skip
    total = bank.score + weigh_step(step, valid, epoch_s).unflatten(0, (-1, COUNT))
    return bank._replace(memory=memory, state=step.posterior, error=step.error, score=total, weighed=fix.valid.any(-1))


def fix_std(std: Float[Tensor, "B 6"], epoch_s: float) -> Float[Tensor, "B 6"]:
    """1σ of fixes as a bank takes them: none better than :data:`FIX_FLOOR`, and no more than one a second."""
    return torch.maximum(torch.where(std.isnan(), 1.0, std), std.new_tensor(FIX_FLOOR)) * max(1.0, epoch_s**-0.5)


def weigh_step(step: Step, valid: Bool[Tensor, "B 6"], epoch_s: float) -> Float[Tensor, " B"]:
    """What an epoch adds to ln p of the headings: the likelihood of its fix, and that no car reverses for long."""
    covariances = step.answer.covariances
    assert covariances is not None  # a Kalman filter has them
    forward = (step.posterior.C_nb[..., 0] * step.posterior.v_n).sum(-1)
    hazard = ((1 + (forward / 2).square()) / REVERSE_S[0]).clamp(max=1 / REVERSE_S[1])
    return log_likelihood(step.innovation, covariances) - valid.any(-1) * (forward < -0.5) * epoch_s * hazard


def judge_bank(bank: Bank) -> list[HeadingVerdict]:
    """The most probable heading of each case; its 1σ is that of a car whose IMU is not mounted straight."""
    score = torch.where(bank.score.isnan() | bank.score.isinf(), torch.finfo(bank.score.dtype).min, bank.score)
    best = score.argmax(-1)
    C = bank.state.C_nb.unflatten(0, (-1, COUNT))
    chosen = C[torch.arange(len(best)), best]
    other = vector_from_rotation(C @ chosen.mT.unsqueeze(1))[..., 2].abs() > OTHER
    doubt = (score.softmax(-1) * other).sum(-1)
    std = yaw_std(bank, 0.0).unflatten(0, (-1, COUNT))[torch.arange(len(best)), best]
    return [HeadingVerdict(*x) for x in zip(best.tolist(), doubt.tolist(), std.tolist(), bank.weighed.tolist())]


def yaw_std(bank: Bank, seconds: float) -> Float[Tensor, " BK"]:
    """1σ [rad] of the yaw so long before: var(δh + c t δε), c the down row of C_nb, and the rates' white noise."""
    states = [*range(STATES)[ATTITUDE], *range(STATES)[GYRO]]
    P = bank.memory.P[:, states][:, :, states]
    down = bank.state.C_nb[:, 2]
    J = torch.cat((torch.zeros_like(down), down * seconds), -1)
    J[:, 2] += 1.0
    variance = torch.einsum("bi,bij,bj->b", J, P, J) + ANY_IMU.gyro.noise_psd * seconds
    return torch.hypot(OVERBOUND * variance.clamp_min(0).sqrt(), torch.tensor(SIDESLIP_STD))


def gyro_bias(bank: Bank, k: int) -> Float[Tensor, " 6"]:
    """Gyroscope bias [rad/s] that a heading has found, and its 1σ."""
    std = bank.memory.P[k].diagonal()[GYRO].sqrt()
    return torch.cat((bank.error.bias[k, 3:], (BIAS_OVERBOUND * std).clamp_min(LEAST_BIAS_STD)))


def log_likelihood(z: Float[Tensor, "B 6"], covariances: Covariances) -> Float[Tensor, " B"]:
    """−½ (zᵀ S⁻¹ z + ln |S|), zᵀ S⁻¹ z capped; components without a fix have z = 0, S = 1."""
    factor = torch.linalg.cholesky_ex(covariances.innovation).L
    white = torch.linalg.solve_triangular(factor, z.unsqueeze(-1), upper=False).squeeze(-1)
    spread = 2 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    return -0.5 * (white.square().sum(-1).clamp(max=NIS_CAP) + spread)


class BankFilter(Mbkf):
    """The filter of a bank, with a gate that is strict from the first fix on: its headings are to differ."""

    @cached_property
    def fix(self) -> GnssFix:
        """Where GNSS comes in."""
        return GnssFix(self.tuning, self.states, Gate(self.tuning.gate, usual=0.0))


def bank_filter() -> Mbkf:
    """The filter of a bank."""
    tuning = Tuning(lateral_std=0.5, vertical_std=0.5)
    return BankFilter(ANY_IMU, tuning, gated=True, sources=(Sideslip(tuning, PLAIN),))
