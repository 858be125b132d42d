"""Speed from the wheels' orders in the vibration that an IMU measures: a wheel sensor without a wheel.

While fixes show the speed, the spectrum over the distance covered (:mod:`dlkf.filters.order_spectrum`) is averaged over
blocks of some 3 s, and a line that stands out shows how often a wheel turns in a metre, κ. In an outage the line of a
block stands at κ v̄/v̂ for the true and the filter's own mean speed, which makes a measurement of the speed (chassis
vibrations: Lindfors et al. 2016),

    z = ln κ_line − ln κ,    H = uᵀ δv̄ / v̂,    δv̄ = δv − L (Cε + [f_n×] δh)ᵀu    u along the velocity, L half a block

What the spectrum says of ln κ_line is no Gaussian but has several peaks. Its mean and variance under the filter's own
1σ, widened by ``SEARCH``, are those of a measurement with variance R that is taken from them; a block that decides
nothing is kept, so that several do together.

A line counts as a wheel's only by what it predicted: whether the next block's likelihood, before the block is learned
from, is large where the fixes put the line, in nats against a guess, at speeds other than those it was learned at.
Tones of a fixed frequency, of other gears or of nothing at all do not pass, and the filter is as without this source.
Training gets no rows: a peak has no gradient.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dlkf.data.drive import Batch
from dlkf.filters.aids.stretch import at_limits, mean_force
from dlkf.filters.branches import chosen, may_branch
from dlkf.filters.integration import Epoch
from dlkf.filters.order_spectrum import (
    LINES,
    NYQUIST,
    ORDERS,
    STEP,
    WAVES,
    demodulate,
    log_levels,
    log_likelihood,
    log_lines,
)
from dlkf.filters.sources import Measurement, Predicted, predicted_variance
from dlkf.filters.tuning import Tuning
from dlkf.navigation.state import ACCEL, ErrorStates

BLOCK_S = 3.0
SLOWEST = 3.0  # m/s in a block: below, the orders lie among the car's own motion
KNOWN = 0.02  # relative 1σ of a speed that teaches
MEMORY = 75.0  # blocks of the averages
APART = 0.1  # in ln v: so far from the mean speed of what was learned a block is full evidence
GUESS, HIT = 0.12, 0.0125  # in ln κ: where a line may lie, and how near to it is a hit
LEAST_DENSITY = 0.05  # of a guess's: so much a single block may contradict
FIRST_BLOCKS = 3  # before anything is predicted
DETECTED, LOST = 4.0, 1.0  # nats of evidence from which a line counts, and below which it does no more
EDGE = 5  # lines at the ends of the range, which may be the flank of something outside
FIRST_STD = 0.015  # of ln κ when a line is first detected
WANDER = 1e-4  # of ln κ, per √block
DRIFT = 0.01  # in ln v, by which a filter's speed may drift from block to block
SEARCH = 0.02  # in ln v, beyond the filter's 1σ
FINEST = 0.005  # in ln κ: a line is no finer
DECIDED, SURE, OUTLIER = 0.8, 0.03, 3.0  # of the search's variance; 1σ in ln κ; σ: what decides a block
LOST_STD = 0.1  # relative 1σ of a speed that no line is looked for at
UNCHECKED_S = 100.0  # s after a fix, from which on what nothing has checked is worth less and less
TOGETHER = 10.0  # measurements that share the error of κ count as so many


class Block(NamedTuple):
    """The present block."""

    spectrum: Tensor  # (B, 6, waves), of the last block until the first samples of the next
    last: Tensor  # (B, 6) the last sample
    distance: Tensor  # (B,) m
    elapsed: Tensor  # (B,) s
    slowest: Tensor  # (B,) m/s
    fixed: Tensor  # (B,) bool: it had a fix

    @classmethod
    def begin(cls, like: Tensor, B: int) -> Block:
        """Nothing in it."""
        zero = like.new_zeros(B)
        return cls(like.new_zeros(B, 6, WAVES), like.new_zeros(B, 6), zero, zero, zero + 1e3, zero > 0)

    def after(self, epoch: Epoch, block_s: float) -> Block:
        """With one more update interval."""
        x, dt = epoch.corrected, epoch.dt
        M = x.shape[1]
        speed = at_limits(epoch.start.v_n, epoch.window.v_n)[..., :2].norm(dim=-1)
        step = 0.5 * dt * (speed[:, 1:] + speed[:, :-1])
        distance = self.distance.unsqueeze(-1) + step.cumsum(1) - 0.5 * step
        time = self.elapsed.unsqueeze(-1) + dt * (torch.arange(M, dtype=x.dtype, device=x.device) + 0.5)
        weight = torch.sin((math.pi / block_s) * time).clamp_min(0.0)
        fresh = self.elapsed <= 0
        begun = self.spectrum
        if not may_branch(fresh) or bool(fresh.any()):
            begun = torch.where(fresh[:, None, None], 0.0, begun)
        known = (self.last != 0).any(-1, keepdim=True)
        before = torch.cat((torch.where(known, self.last, x[:, 0]).unsqueeze(1), x[:, :-1]), 1)
        return Block(
            demodulate((x - before) * weight.unsqueeze(-1), distance, begun), x[:, -1],
            self.distance + step.sum(1), self.elapsed + dt * M,
            torch.minimum(self.slowest, -(-speed).amax(1)), self.fixed | epoch.used.any(-1),
        )  # fmt: skip

    def next(self, done: Bool[Tensor, " B"]) -> Block:
        """This one, or where it is done a new one."""
        return Block(
            self.spectrum, self.last,
            torch.where(done, 0.0, self.distance), torch.where(done, 0.0, self.elapsed),
            torch.where(done, 1e3, self.slowest), self.fixed & ~done,
        )  # fmt: skip


class Wheels(NamedTuple):
    """What is known of this car's wheels."""

    levels: Tensor  # (B, 6, O, K) mean of the log levels
    blocks: Tensor  # (B,) in that mean
    log_speed: Tensor  # (B,) its mean ln v
    evidence: Tensor  # (B,) nats by which the lines predicted the speed better than a guess
    detected: Tensor  # (B,) bool: that is enough
    log_turns: Tensor  # (B,) ln κ
    variance: Tensor  # (B,) its variance

    @classmethod
    def begin(cls, like: Tensor, B: int) -> Wheels:
        """Nothing."""
        zero = like.new_zeros(B)
        return cls(like.new_zeros(B, 6, len(ORDERS), LINES), zero, zero, zero, zero > 0, zero, zero)

    def excess(self, log_turns: Float[Tensor, " B"]) -> Float[Tensor, "B 6 O"]:
        """By what a wheel's lines stand out if it turns so often."""
        kappa = torch.exp(log_turns).unsqueeze(-1)
        near = torch.exp(-0.5 * ((torch.exp(log_lines(kappa)) - kappa) / STEP).square())
        near = near / near.sum(1, keepdim=True).clamp_min(1e-12)
        return (self.levels * near[:, None, None]).sum(-1)

    def strongest(self) -> tuple[Float[Tensor, " B"], Bool[Tensor, " B"]]:
        """ln κ of the strongest line, and whether it is inside the range."""
        total = self.levels.clamp_min(0).sum((1, 2))
        total = torch.cat((total[:, :1], (total[:, :-2] + total[:, 1:-1] + total[:, 2:]) / 3, total[:, -1:]), 1)
        number = torch.arange(LINES, dtype=total.dtype, device=total.device)
        largest = (total >= total.amax(1, keepdim=True)).to(total.dtype)
        at = (largest * number).sum(1) / largest.sum(1)
        lines = log_lines(total)
        chosen = (largest * lines).sum(1) / largest.sum(1)
        return chosen, (at >= EDGE) & (at <= LINES - 1 - EDGE)

    def line(self) -> tuple[Float[Tensor, " B"], Bool[Tensor, " B"]]:
        """ln κ of the line that is detected, else of the strongest, and whether it is one."""
        strongest, inside = self.strongest()
        return torch.where(self.detected, self.log_turns, strongest), self.detected | inside

    def learned(
        self, levels: Tensor, predicted: Float[Tensor, "B K"], speed: Float[Tensor, " B"], knows: Bool[Tensor, " B"]
    ) -> Wheels:
        """After a block whose speed fixes show: ``predicted``, its ln Λ at :meth:`line`, is judged, then it is learned
        from."""
        log_speed = torch.log(speed)
        line, known = self.line()
        gain = _gain(predicted, (log_lines(levels) - line.unsqueeze(-1)).abs())
        weight = ((log_speed - self.log_speed).abs() / APART).clamp_max(1.0)
        judged = knows & known & (self.blocks >= FIRST_BLOCKS)
        evidence = torch.where(judged, (1 - 1 / MEMORY) * self.evidence + weight * gain, self.evidence)
        blocks = torch.where(knows, self.blocks + 1, self.blocks)
        rate = torch.where(knows, 1 / blocks.clamp(1, MEMORY), 0.0)
        new = ~self.detected & judged & (evidence > DETECTED)
        return Wheels(
            self.levels + rate[:, None, None, None] * (levels - self.levels), blocks,
            self.log_speed + rate * (log_speed - self.log_speed), evidence,
            (self.detected & (evidence > LOST)) | new, torch.where(new, line, self.log_turns),
            torch.where(new, FIRST_STD**2, self.variance),
        )  # fmt: skip


class OrdersMemory(NamedTuple):
    """Memory of the source; nothing of it has axes in n."""

    block: Block
    wheels: Wheels
    undecided: Tensor  # (B, K) ln Λ of blocks that decided nothing
    age: Tensor  # (B,) s since the last fix


@dataclass(frozen=True)
class WheelOrders:
    """One row: ln of the true over the filter's mean speed in a block."""

    imu: object
    tuning: Tuning
    states: ErrorStates

    @property
    def code(self) -> WheelOrders:
        """It has no settings of its own."""
        return WheelOrders(None, Tuning(), self.states)

    def begin(self, batch: Batch) -> OrdersMemory:
        """Nothing detected."""
        B = batch.size[0]
        return OrdersMemory(
            Block.begin(batch.imu, B), Wheels.begin(batch.imu, B), batch.imu.new_zeros(B, LINES), batch.imu.new_zeros(B)
        )  # fmt: skip

    def rows(
        self, epoch: Epoch, memory: OrdersMemory, prediction: Predicted
    ) -> tuple[Measurement | None, OrdersMemory]:
        """A row at the end of a block whose lines decide something."""
        if torch.is_grad_enabled():
            return None, memory
        span = epoch.dt * epoch.imu.shape[1]
        block_s = max(1, round(BLOCK_S / span)) * span
        block = memory.block.after(epoch, block_s)
        done = block.elapsed > block_s - 0.5 * span
        memory = memory._replace(age=torch.where(epoch.used.any(-1), 0.0, memory.age + span))
        if may_branch(done) and not bool(done.any()):
            return None, memory._replace(block=block)
        row, wheels, undecided = self._judged(epoch, memory, prediction, block, done)
        kept = torch.where(epoch.used.any(-1, keepdim=True) | row.used, 0.0, undecided)
        nothing = Measurement(*map(torch.zeros_like, row))
        return chosen(done, row, nothing), OrdersMemory(
            block.next(done), chosen(done, wheels, memory.wheels), chosen(done, kept, memory.undecided), memory.age
        )  # fmt: skip

    def _judged(
        self, epoch: Epoch, memory: OrdersMemory, prediction: Predicted, block: Block, done: Bool[Tensor, " B"]
    ) -> tuple[Measurement, Wheels, Float[Tensor, "B K"]]:
        """The row of a block that is done, what is known after it, and what the blocks since the last row say."""
        levels = log_levels(block.spectrum)
        lines = log_lines(levels)
        speed = (block.distance / block.elapsed).clamp_min(0.1)
        moving = done & (block.slowest > SLOWEST)
        highest = 0.55 * speed.unsqueeze(-1) * speed.new_tensor(ORDERS)
        seen = (highest < NYQUIST / epoch.dt).to(levels.dtype)

        H = self._matrix(epoch, 0.5 * block.elapsed, speed)
        of_speed = predicted_variance(prediction.P, H)[:, 0]
        before = memory.wheels
        likelihood = log_likelihood(levels, before.excess(before.line()[0]) * seen.unsqueeze(1))
        undecided = _diffused(memory.undecided)
        undecided = undecided + torch.where((moving & before.detected).unsqueeze(-1), likelihood, 0.0)

        knows = moving & block.fixed & (of_speed < KNOWN**2)
        wheels = before.learned(levels * seen[:, None, :, None], likelihood, speed, knows)

        off = lines - before.log_turns.unsqueeze(-1)
        searched = of_speed + before.variance + SEARCH**2
        z, R, decided = _gaussian(undecided - 0.5 * off.square() / searched.unsqueeze(-1), off, searched)
        used = moving & before.detected & wheels.detected & decided & (of_speed + before.variance < LOST_STD**2)
        if prediction.rolling is not None:  # a wheel that agrees says more
            used = used & ~prediction.rolling
        gain = torch.where(knows & used, wheels.variance / (wheels.variance + of_speed + R), 0.0)
        wheels = wheels._replace(
            log_turns=wheels.log_turns + gain * z,
            variance=(1 - gain) * wheels.variance + torch.where(done, WANDER**2, 0.0),
        )
        R = (R + TOGETHER * before.variance) * (1 + (memory.age / UNCHECKED_S).square())
        R = R * (z.square() / (of_speed + R) / OUTLIER**2).clamp_min(1.0)
        return Measurement(z.unsqueeze(-1), H, R.unsqueeze(-1), used.unsqueeze(-1)), wheels, undecided

    def _matrix(self, epoch: Epoch, middle: Float[Tensor, " B"], speed: Float[Tensor, " B"]) -> Float[Tensor, "B 1 n"]:
        """H of ln of the true over the filter's mean speed of a block, whose middle is so many seconds ago."""
        end = epoch.window.end
        along = end.v_n / end.v_n.norm(dim=-1, keepdim=True).clamp_min(0.5)
        H = along.new_zeros(len(along), self.states.count)
        H[:, self.states.velocity] = along
        H[:, self.states.attitude] = middle.unsqueeze(-1) * torch.linalg.cross(along, mean_force(epoch))
        H[:, ACCEL] = middle.unsqueeze(-1) * torch.bmm(end.C_nb.mT, along.unsqueeze(-1)).squeeze(-1)
        return (H / speed.unsqueeze(-1)).unsqueeze(1)


def _gain(predicted: Float[Tensor, "B K"], off: Float[Tensor, "B K"]) -> Float[Tensor, " B"]:
    """ln of the probability density at the line over that of a guess, ``off`` in ln κ from it."""
    likely = torch.where(off < GUESS, predicted, -1e3)
    p = torch.exp(likely - likely.amax(1, keepdim=True)) * (off < GUESS)
    hit, guessed = (off < HIT).to(p.dtype), (off < GUESS).to(p.dtype).sum(1)
    share = (p * hit).sum(1) / p.sum(1).clamp_min(1e-12)
    return torch.log((share * guessed / hit.sum(1).clamp_min(1.0)).clamp_min(LEAST_DENSITY))


def _gaussian(
    log_density: Float[Tensor, "B K"], off: Float[Tensor, "B K"], searched: Float[Tensor, " B"]
) -> tuple[Float[Tensor, " B"], Float[Tensor, " B"], Bool[Tensor, " B"]]:
    """Innovation and variance that make the mean and variance of a density from a Gaussian of variance ``searched``,
    and whether they say anything that can be trusted."""
    p = torch.exp(log_density - log_density.amax(1, keepdim=True))
    p = p / p.sum(1, keepdim=True)
    mean = (p * off).sum(1)
    variance = (p * (off - mean.unsqueeze(-1)).square()).sum(1) + FINEST**2
    variance = torch.minimum(variance, 0.999 * searched)
    R = 1 / (1 / variance - 1 / searched)
    z = mean * R / variance
    plain = z.square() < OUTLIER**2 * (searched + R)
    return z, R, (variance < DECIDED * searched) & (variance < SURE**2) & plain


def _diffused(log_likelihood: Float[Tensor, "B K"]) -> Float[Tensor, "B K"]:
    """What is left of a likelihood a block later, when the filter's speed has drifted."""
    likelihood = torch.exp(log_likelihood - log_likelihood.amax(1, keepdim=True))
    return torch.log((likelihood @ _drift(likelihood.dtype, likelihood.device)).clamp_min(1e-12))


@lru_cache
@torch.inference_mode(False)
def _drift(dtype: torch.dtype, device: torch.device) -> Float[Tensor, "K K"]:
    lines = log_lines(torch.empty(0, dtype=dtype, device=device))
    near = torch.exp(-0.5 * ((lines[:, None] - lines) / DRIFT).square())
    return near / near.sum(1, keepdim=True)
