"""Which way a car faces: a bank of headings side by side, and the one under which GNSS comes as foreseen.

A course is no heading where the car reverses, and bad where the receiver's velocity is. So a filter with 15 states is
run from each of several headings, and they are weighed by their innovations z with covariance S = H P Hᵀ + R
(multiple-model estimation, Magill 1965; Bar-Shalom et al. 2001, sect. 11.6):

    ln p(heading | z₁…z_T) = ln p(heading) − ½ Σ (zᵀ S⁻¹ z + ln |S|) + const.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from dlkf.data.alignment import Start, levelled
from dlkf.data.drive import Batch, Drive
from dlkf.data.segments import whole_drives
from dlkf.filters.integration import Covariances, Solution, integrate
from dlkf.filters.model_based import Mbkf
from dlkf.navigation.attitude import prefix_rotations, rotation_from_rpy, vector_from_rotation
from dlkf.navigation.imu_errors import ImuSpec, SensorErrors
from dlkf.navigation.state import ATTITUDE, GYRO, STATES, NavState

RING = 12  # headings all round, beside the course and its reverse
PRIOR = (0.9, 0.05, 0.05)  # of the course, of its reverse, of the ring together
NIS_CAP = 30.0  # what one epoch may say against a heading: an outlier is no proof
DECIDED = 5.0  # ln of the odds against any other heading
OTHER = math.radians(25)  # apart, at the end, to be another
COARSE = math.radians(5)  # a course that is no better than this is given up for a posterior that is
AGAIN_STD = math.radians(6)  # of a heading that a second run begins with
OVERBOUND = 2.0  # on the posterior's 1σ: the errors of the IMU are a guess
PATIENCE = 4  # as many times the search's length while it is undecided
BATCH_EPOCHS = 20_000  # at a time: bounds the memory
# an IMU of which nothing is known: what MEMS on a car's roof have been seen to do
ANY_IMU = ImuSpec(
    "any",
    SensorErrors(noise_density=5e-3, turn_on_bias=0.15, scale_factor=5e-3, misalignment=5e-3),
    SensorErrors(noise_density=5e-4, turn_on_bias=5e-3, scale_factor=5e-3, misalignment=5e-3),
)


@dataclass(frozen=True)
class Case:
    """A drive from the bank's first boundary on, the start there by course, the mean specific force there [m/s²] and
    the error of the gyroscopes [rad/s] as far as known, in b."""

    drive: Drive
    start: Start
    force_b: Float[Tensor, " 3"]
    gyro_error: Float[Tensor, " 3"]

    def towards(self, heading: Heading) -> Case:
        """The same from another heading, no surer than ``AGAIN_STD``."""
        yaw_std = self.start.std.new_tensor([max(AGAIN_STD, heading.std)])
        state = self.start.state._replace(C_nb=heading.C_nb)
        std = torch.cat((self.start.std[: ATTITUDE.stop - 1], yaw_std))
        return replace(self, start=replace(self.start, state=state, std=std))


@dataclass(frozen=True)
class Heading:
    """Attitude at the first boundary in the frame of the start, 1σ of its yaw [rad], where the heading is from
    (``course``, ``reverse`` or ``bank``), and whether the odds against others are beyond doubt."""

    C_nb: Float[Tensor, "3 3"]
    std: float
    origin: str
    decided: bool


def likeliest(cases: Sequence[Case], search_s: float) -> list[Heading]:
    """The likeliest heading of each case after ``search_s``, or up to ``PATIENCE`` times that if it leaves doubt.

    A posterior that agrees with the course or its reverse within 3σ gives that, unless the course is a poor one; it
    is taken itself otherwise.
    """
    found: dict[int, Heading] = {}
    todo, spent = list(range(len(cases))), search_s
    while todo and spent <= PATIENCE * search_s:
        found |= zip(todo, _in_parts([cases[k] for k in todo], spent))
        todo = [k for k in todo if not found[k].decided and spent < cases[k].drive.epochs * cases[k].drive.epoch_s]
        spent *= 2
    # a filter that began far off has learned wrong things on its way: once more from where it came to
    far = [k for k, heading in found.items() if heading.origin == "bank"]
    again = _in_parts([cases[k].towards(found[k]) for k in far], search_s)
    found |= {k: replace(h, origin="bank", decided=found[k].decided) for k, h in zip(far, again)}
    return [found[k] for k in range(len(cases))]


def _in_parts(cases: Sequence[Case], seconds: float) -> list[Heading]:
    """:func:`_weighed` a bounded number at a time."""
    epochs = [min(c.drive.epochs, max(1, round(seconds / c.drive.epoch_s))) for c in cases]
    count = max(1, BATCH_EPOCHS // (max(epochs, default=1) * (RING + 2)))
    parts = range(0, len(cases), count)
    return [h for i in parts for h in _weighed(cases[i : i + count], epochs[i : i + count])]


@torch.inference_mode()
def _weighed(cases: Sequence[Case], epochs: Sequence[int]) -> list[Heading]:
    """The likeliest heading after just so many epochs."""
    bank = _bank(cases, epochs)
    solution = integrate(bank, Mbkf(ANY_IMU), keep_covariances=True)
    prior = torch.tensor([PRIOR[0], PRIOR[1], *[PRIOR[2] / RING] * RING], dtype=torch.float64).log()
    assert solution.covariances is not None  # asked for, and a Kalman filter has them
    scores = _log_likelihood(solution.innovation, solution.covariances).unflatten(0, (len(cases), -1)) + prior
    headings = []
    for k, score in enumerate(scores):
        first, best = k * len(prior), int(score.argmax())
        last = int(bank.present[first].sum()) - 1
        C_end = solution.posterior.C_nb[first : first + len(prior), last]
        apart = vector_from_rotation(C_end @ C_end[best].mT)[:, 2].abs() > OTHER
        decided = bool(score[best] - score[apart].amax() > DECIDED) if bool(apart.any()) else True
        P = solution.covariances.updated[first + best, last]
        headings.append(_smoothed(cases[k], bank, solution, P, first, best, last, decided))
    return headings


def _smoothed(
    case: Case, bank: Batch, solution: Solution, P: Tensor, first: int, best: int, last: int, decided: bool
) -> Heading:
    """The heading at the bank's first boundary that the best one's end speaks for.

    The end is carried back with the estimated error of the gyroscopes: δh₀ = δh + ∫C dt δε, so
    var δh₀ = J P Jᵀ with J = [I, ∫C dt], and what the white noise of the rates adds.
    """
    row, span = first + best, slice(0, last + 1)
    C_nb = solution.posterior.C_nb[row, span]
    earth_b = C_nb.mT @ bank.frame.earth_rate_n[row]
    rates = bank.imu[row, span, :, 3:] - solution.imu_error[row, last, 3:] - earth_b.unsqueeze(1)
    turns = prefix_rotations((rates * bank.dt).permute(2, 0, 1).contiguous())[..., -1].permute(2, 0, 1)
    C = C_nb[-1]
    for turn in turns.flip(0):
        C = C @ turn.mT
    states = [*range(STATES)[ATTITUDE], *range(STATES)[GYRO]]
    P = P[states][:, states]
    J = torch.cat((torch.eye(3, dtype=P.dtype), C_nb.sum(0) * bank.epoch_s), 1)
    noise = ANY_IMU.gyro.noise_psd * (last + 1) * bank.epoch_s
    std = OVERBOUND * math.sqrt(float((J @ P @ J.mT)[2, 2]) + noise)
    for k, origin in enumerate(("course", "reverse")):
        known = bank.start.C_nb[first + k]
        course_std = float(bank.start_std[first + k, ATTITUDE][2])
        apart = float(vector_from_rotation(C @ known.mT)[2])
        if abs(apart) < 3 * math.hypot(std, course_std) and course_std < max(COARSE, std):
            return Heading(known.clone(), course_std, origin, decided)
    force_n = case.start.state.C_nb @ case.force_b
    return Heading(levelled(C, case.force_b, force_n), std, "bank", decided)


def _bank(cases: Sequence[Case], epochs: Sequence[int]) -> Batch:
    """All headings of all cases as one batch, case by case: the course, its reverse, the ring."""
    ring = 2 * math.pi / RING * (torch.arange(RING, dtype=torch.float64) + 0.5)
    turns = torch.cat((torch.tensor([0.0, math.pi], dtype=torch.float64), ring))
    drives = [c.drive.part(0, n) for c, n in zip(cases, epochs)]
    batch = whole_drives(drives, [c.start for c in cases])
    imu = batch.imu.clone()
    imu[..., 3:] -= torch.stack([c.gyro_error for c in cases])[:, None, None]
    bank = replace(batch, imu=imu).select(torch.arange(len(cases)).repeat_interleave(len(turns)))
    turned = rotation_from_rpy(torch.stack((0 * turns, 0 * turns, turns), -1))
    C = torch.stack([levelled(turned @ x, c.force_b, x @ c.force_b) for c in cases for x in [c.start.state.C_nb]])
    less = batch.start.C_nb.unsqueeze(1) - C  # of the lever arm
    swing = torch.linalg.cross(imu[:, 0, : max(1, round(0.1 / batch.dt)), 3:].mean(1), batch.lever_arm_b)
    p = bank.start.p_n + (less @ batch.lever_arm_b[:, None, :, None]).reshape(-1, 3)
    v = bank.start.v_n + (less @ swing[:, None, :, None]).reshape(-1, 3)
    std = bank.start_std.unflatten(0, (len(cases), -1)).clone()
    std[:, 2:, ATTITUDE.stop - 1] = math.pi / RING
    return replace(bank, start=NavState(p, v, C.flatten(0, 1)), start_std=std.flatten(0, 1))


def _log_likelihood(z: Float[Tensor, "B T 6"], covariances: Covariances) -> Float[Tensor, " B"]:
    """−½ Σ (zᵀ S⁻¹ z + ln |S|), zᵀ S⁻¹ z of an epoch capped; components without a fix have z = 0, S = 1."""
    factor = torch.linalg.cholesky(covariances.innovation)
    white = torch.linalg.solve_triangular(factor, z.unsqueeze(-1), upper=False).squeeze(-1)
    nis = white.square().sum(-1).clamp(max=NIS_CAP)
    spread = 2 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    return -0.5 * (nis + spread).sum(-1)
