"""Speed from the vibration that an IMU measures: its spectrum over distance has the same shape at any speed.

The shape is that of the car and its roads (:mod:`dlkf.filters.vibration_spectrum`; chassis vibrations: Lindfors et al.
2016). While fixes show the speed it is learned, as the mean over blocks of some 3 s; in an outage the shift by which a
block fits it makes a measurement of the speed,

    z = δ = ln(v̄/v̂),    H δx = uᵀδv̄ / v̂,    δv̄ = δv + L C ε + S × δh

with u the course at the middle of the block, L ago, and S = v − v̂ u − L g the impulse of the specific force since; mean
and variance are those that the likelihood of δ has under the filter's own 1σ, widened by ``SEARCH``. A block with a
fix updates the shape and is no measurement: a shape learned at the filter's own speed must not confirm that speed.

On another road, or in another gear, the shape may not hold. So ln Λ of a block counts with its best value over the one
that the shape has on average, at most 1, and not at all where no shift fits better than no shape. An innovation beyond
``OUTLIER`` σ has a 1σ that grows with it, as in :mod:`dlkf.filters.constraints`.

Resonances and tones of a fixed frequency do not follow the speed. So two means are learned that add up, one over
frequencies in distance and one over frequencies in time, each of what the other leaves, and only the first is shifted.

How far the shape can be trusted is learned too: ln Λ counts with a share from 0 to 1. While fixes show the speed, each
of :data:`SHARES` predicts δ from a block, and its evidence is the density that it gives to the known δ; the mean share
under the evidence is in force. A car that shows nothing, or whose vibration misleads, gets 0, and the filter is as
without this source. Training gets no rows.
"""

from __future__ import annotations

import math
from typing import ClassVar, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dlkf.data.drive import Batch
from dlkf.filters.aids.stretch import stack_limits
from dlkf.filters.branches import may_branch, select_branch
from dlkf.filters.integration import Epoch
from dlkf.filters.sources import Measurement, Predicted, SensorSource, describe_row, predicted_variance
from dlkf.filters.vibration_spectrum import (
    LINES,
    PARTS,
    SHIFT,
    TONES,
    WAVES,
    demodulate,
    describe_block,
    expected_log_likelihood,
    line_weights,
    log_likelihood,
    shifts,
    tone_shares,
)
from dlkf.navigation.state import ACCEL

BLOCK_S = 3.0
SLOWEST = 3.0  # m/s: below, most lines lie among the car's own motion
KNOWN = 0.03  # relative 1σ of a speed that teaches
MEMORY = 200.0  # blocks over which the means forget
FEW = 5.0  # blocks' worth of no shape, with which a mean begins
FIRST_BLOCKS = 2.0  # before a shape is used
SHARES = (0.0, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0)
DOUBT = 1.0  # nats for a share of 0 at the start
TRIED = 100.0  # blocks over which the evidence for the shares forgets
WRONG = 0.06  # 1σ of δ, from which the shares have to find the known one
LEAST_SHARE = 0.03  # that is used
SEARCH = 0.02  # in ln v, beyond the filter's 1σ
FINEST = 0.004  # 1σ of δ at best
SAYS = 0.97  # of the search's variance, below which a block is informative
OUTLIER = 3.0  # σ of an innovation, from which on its 1σ grows with it
LOST_STD = 0.1  # relative 1σ of a speed at which no shape is looked for
TOGETHER = 10.0  # measurements that share the error of the mean
UNCHECKED_S = 100.0  # s after a fix over which R grows


class Block(NamedTuple):
    """Samples of some update intervals."""

    spectrum: Tensor  # (B, 6, waves)
    distance: Tensor  # (B,) m
    elapsed: Tensor  # (B,) s
    slowest: Tensor  # (B,) m/s
    fixed: Tensor  # (B,) bool: it had a fix
    turned: Tensor  # (B,) rad: course since the beginning
    turned_s: Tensor  # (B,) its integral over time

    @classmethod
    def begin(cls, like: Tensor, B: int) -> Block:
        """Nothing in it."""
        zero = like.new_zeros(B)
        return cls(like.new_zeros(B, 6, WAVES), zero, zero, zero + 1e3, zero > 0, zero, zero)

    @property
    def speed(self) -> Float[Tensor, " B"]:
        """Mean speed [m/s]."""
        return (self.distance / self.elapsed.clamp_min(1e-3)).clamp_min(0.1)

    @property
    def course_lag(self) -> Float[Tensor, " B"]:
        """By what the course at the end is ahead of the mean course [rad]."""
        return self.turned - self.turned_s / self.elapsed.clamp_min(1e-3)

    def update(self, epoch: Epoch, block_s: float, last: Float[Tensor, "B 6"]) -> Block:
        """With one more update interval; ``last`` is the sample before it."""
        x, dt = epoch.corrected, epoch.dt
        M = x.shape[1]
        speed = stack_limits(epoch.start.v_n, epoch.window.v_n)[..., :2].norm(dim=-1)
        step = 0.5 * dt * (speed[:, 1:] + speed[:, :-1])
        distance = self.distance.unsqueeze(-1) + step.cumsum(1) - 0.5 * step
        sample = torch.arange(M, dtype=x.dtype, device=x.device)
        time = self.elapsed.unsqueeze(-1) + dt * (sample + 0.5)
        window = torch.sin((math.pi / block_s) * time).clamp_min(0.0)
        known = (last != 0).any(-1, keepdim=True)
        turn = dt * x[..., 5].sum(1)
        before = torch.cat((torch.where(known, last, x[:, 0]).unsqueeze(1), x[:, :-1]), 1)
        return Block(
            demodulate((x - before) * window.unsqueeze(-1), distance, self.spectrum),
            self.distance + step.sum(1), self.elapsed + dt * M,
            torch.minimum(self.slowest, -(-speed).amax(1)), self.fixed | epoch.used.any(-1),
            self.turned + turn, self.turned_s + dt * M * (self.turned + 0.5 * turn),
        )  # fmt: skip


class Mean(NamedTuple):
    """A mean of y over blocks, at frequencies in distance or in time."""

    total: Tensor  # (B, 18, n)
    weight: Tensor  # (B, n)

    @classmethod
    def begin(cls, like: Tensor, B: int, n: int) -> Mean:
        """Of nothing."""
        return cls(like.new_zeros(B, PARTS, n), like.new_zeros(B, n))

    @property
    def value(self) -> Float[Tensor, "B 18 n"]:
        """Drawn towards 0, where it is of few blocks."""
        return self.total / (self.weight + FEW).unsqueeze(1)

    def update(
        self, y: Float[Tensor, "B 18 n"], weight: Float[Tensor, "B n"], learns: Float[Tensor, " B"]
    ) -> Mean:  # fmt: skip
        """With a block, where it ``learns`` (1, else 0)."""
        keep, weight = (1 - learns / MEMORY).unsqueeze(-1), learns.unsqueeze(-1) * weight
        return Mean(keep.unsqueeze(1) * self.total + weight.unsqueeze(1) * y, keep * self.weight + weight)


class VibrationMemory(NamedTuple):
    """Memory of the source; nothing of it has axes in n."""

    block: Block
    last_sample: Tensor  # (B, 6)
    by_distance: Mean
    by_time: Mean
    blocks: Tensor  # (B,) in these means
    evidence: Tensor  # (B, S) nats for each of SHARES
    age: Tensor  # (B,) s since the last fix

    @property
    def share(self) -> Float[Tensor, " B"]:
        """Of ln Λ, that is in force."""
        return (_probability(self.evidence) * self.evidence.new_tensor(SHARES)).sum(-1)


class VibrationSpeed(SensorSource):
    """One row: ln of the true over the filter's mean speed in a block."""

    columns: ClassVar[tuple[str, ...]] = (
        "vibration_speed_innovation", "vibration_speed_innovation_std", "vibration_speed_used", "vibration_speed_share",
    )  # fmt: skip

    def begin(self, batch: Batch) -> VibrationMemory:
        """Nothing learned."""
        like, B = batch.imu, batch.size[0]
        evidence = like.new_tensor([DOUBT, *(0.0 for _ in SHARES[1:])]).expand(B, -1).clone()
        return VibrationMemory(
            Block.begin(like, B), like.new_zeros(B, 6), Mean.begin(like, B, LINES), Mean.begin(like, B, TONES),
            like.new_zeros(B), evidence, like.new_zeros(B),
        )  # fmt: skip

    def rows(
        self, epoch: Epoch, memory: VibrationMemory, prediction: Predicted
    ) -> tuple[Measurement | None, VibrationMemory]:
        """A row at the end of a block."""
        if torch.is_grad_enabled():
            return None, memory
        span = epoch.dt * epoch.imu.shape[1]
        block_s = max(1, round(BLOCK_S / span)) * span
        block = memory.block.update(epoch, block_s, memory.last_sample)
        age = torch.where(epoch.used.any(-1), 0.0, memory.age + span)
        memory = memory._replace(block=block, last_sample=epoch.corrected[:, -1], age=age)
        done = block.elapsed > block_s - 0.5 * span
        if may_branch(done) and not bool(done.any()):
            return None, memory
        row, by_distance, by_time, blocks, evidence = self._judge_block(epoch, memory, prediction, done)
        zeros, B = epoch.z.new_zeros, len(epoch.z)  # zeros like the row's would need the row, in C at any time
        nothing = Measurement(
            zeros(B, 1), zeros(B, 1, self.states.count), zeros(B, 1), zeros(B, 1, dtype=torch.bool)
        )  # fmt: skip
        return select_branch(done, row, nothing), memory._replace(
            block=_reset_block(block, done), by_distance=select_branch(done, by_distance, memory.by_distance),
            by_time=select_branch(done, by_time, memory.by_time), blocks=select_branch(done, blocks, memory.blocks),
            evidence=select_branch(done, evidence, memory.evidence),
        )  # fmt: skip

    def describe(
        self, epoch: Epoch, memory: VibrationMemory, rows: Measurement | None, P: Float[Tensor, "B n n"]
    ) -> Float[Tensor, "B 4"]:
        """What is to be said of an update interval: :attr:`columns`; NaN where nothing was measured."""
        said = describe_row(epoch, rows, P, None if rows is None else rows.R[:, 0] > 0)
        return torch.cat((said, memory.share.unsqueeze(-1)), -1)

    def _judge_block(
        self, epoch: Epoch, memory: VibrationMemory, prediction: Predicted, done: Bool[Tensor, " B"]
    ) -> tuple[Measurement, Mean, Mean, Tensor, Tensor]:
        """The row of a block that is done; means, their blocks, and evidence after it."""
        block, speed = memory.block, memory.block.speed
        moving = done & (block.slowest > SLOWEST)
        H = self._matrix(epoch, block)
        of_speed = predicted_variance(prediction.P, H)[:, 0]
        weight, tones = line_weights(speed, epoch.dt), tone_shares(speed)
        y = describe_block(block.spectrum, weight)
        of_distance, of_time = memory.by_distance.value, torch.bmm(memory.by_time.value, tones.mT)
        likelihood = log_likelihood(y - of_time, of_distance, weight, block.distance)
        expected = expected_log_likelihood(of_distance, weight, block.distance).clamp_min(1e-3)
        holds = (likelihood.amax(-1, keepdim=True) / expected).clamp(0.0, 1.0)
        row = self._row(memory, holds * likelihood, H, of_speed, moving)
        if prediction.rolling is not None:  # a wheel that agrees says more
            row = row._replace(used=row.used & ~prediction.rolling.unsqueeze(-1))

        knows = moving & block.fixed & (of_speed < KNOWN**2)
        tried = (knows & (memory.blocks >= FIRST_BLOCKS)).to(y.dtype).unsqueeze(-1)
        evidence = memory.evidence + tried * (_predictive(likelihood, of_speed) - memory.evidence / TRIED)
        learns = knows.to(y.dtype)
        on_tones = torch.bmm(weight.unsqueeze(1), tones)  # (B, 1, N)
        left = torch.bmm(weight.unsqueeze(1) * (y - of_distance), tones) / on_tones.clamp_min(1e-6)
        of_tones = (on_tones / tones.sum(1, keepdim=True).clamp_min(1e-6)).squeeze(1)
        by_distance = memory.by_distance.update(y - of_time, weight, learns)
        by_time = memory.by_time.update(left, of_tones, learns)
        blocks = (1 - learns / MEMORY) * memory.blocks + learns
        return row, by_distance, by_time, blocks, evidence

    def _row(
        self, memory: VibrationMemory, likelihood: Float[Tensor, "B O"], H: Float[Tensor, "B 1 n"],
        of_speed: Float[Tensor, " B"], moving: Bool[Tensor, " B"],
    ) -> Measurement:  # fmt: skip
        """What a block measures: of a likelihood under a Gaussian, innovation and variance that make its moments."""
        off, share = shifts(likelihood), memory.share
        prior = -0.5 * off.square() / (of_speed + SEARCH**2).unsqueeze(-1)
        searched = (_probability(prior) * off.square()).sum(-1)  # less than all of it, where the shifts end before
        p = _probability(share.unsqueeze(-1) * likelihood + prior)
        mean = (p * off).sum(-1)
        variance = (p * (off - mean.unsqueeze(-1)).square()).sum(-1) + FINEST**2
        says = variance < SAYS * searched
        R = 1 / (1 / torch.minimum(variance, SAYS * searched) - 1 / searched)
        z = mean * (1 + R / searched)
        R = torch.maximum(R, z.square() / OUTLIER**2 - searched)
        measured = moving & ~memory.block.fixed & (share > LEAST_SHARE) & (memory.blocks >= FIRST_BLOCKS) & says
        used = measured & (of_speed < LOST_STD**2)
        R = R * (1 + TOGETHER / memory.blocks.clamp_min(1.0)) * (1 + (memory.age / UNCHECKED_S).square())
        R = torch.where(measured, R, 0.0)
        return Measurement(z.unsqueeze(-1), H, R.unsqueeze(-1), used.unsqueeze(-1))

    def _matrix(self, epoch: Epoch, block: Block) -> Float[Tensor, "B 1 n"]:
        """H of ln of the true over the filter's mean speed of a block that ends now.

        At its middle, L ago, the velocity had the direction u, and its error was that of now before the errors of
        attitude and accelerometers moved it by the impulse S of the specific force since.
        """
        end, middle, speed = epoch.window.end, 0.5 * block.elapsed.unsqueeze(-1), block.speed.unsqueeze(-1)
        now = end.v_n / end.v_n.norm(dim=-1, keepdim=True).clamp_min(0.5)
        cos, sin = block.course_lag.cos(), block.course_lag.sin()
        north, east, down = now.unbind(-1)
        u = torch.stack((cos * north + sin * east, cos * east - sin * north, down), -1)
        impulse = end.v_n - speed * u - middle * epoch.window.gravity
        H = u.new_zeros(len(u), self.states.count)
        H[:, self.states.velocity] = u
        H[:, self.states.attitude] = torch.linalg.cross(u, impulse)
        H[:, ACCEL] = middle * torch.bmm(end.C_nb.mT, now.unsqueeze(-1)).squeeze(-1)
        return (H / speed).unsqueeze(1)


def _predictive(likelihood: Float[Tensor, "B O"], of_speed: Float[Tensor, " B"]) -> Float[Tensor, "B S"]:
    """ln of the density that each share gives to the known δ, less that of a share of 0.

    Before the block δ is N(0, ``WRONG``²); known it is as well as the filter knows its speed.
    """
    off = shifts(likelihood)
    density = likelihood.new_tensor(SHARES).unsqueeze(-1) * likelihood.unsqueeze(1) - 0.5 * (off / WRONG).square()
    known = -0.5 * off.square() / (of_speed + SHIFT**2).unsqueeze(-1)
    said = _log_sum(density + known.unsqueeze(1)) - _log_sum(density)
    return said - said[:, :1]


def _probability(log: Float[Tensor, "B n"]) -> Float[Tensor, "B n"]:
    """Of logarithms up to a constant."""
    p = torch.exp(log - log.amax(-1, keepdim=True))
    return p / p.sum(-1, keepdim=True)


def _log_sum(log: Float[Tensor, "B m n"]) -> Float[Tensor, "B m"]:
    """ln of the sum of what these are the logarithms of."""
    most = log.amax(-1, keepdim=True)
    return (torch.log(torch.exp(log - most).sum(-1, keepdim=True)) + most).squeeze(-1)


def _reset_block(block: Block, over: Bool[Tensor, " B"]) -> Block:
    """The block, or where it is over a new one."""
    return Block(
        torch.where(over[:, None, None], 0.0, block.spectrum), torch.where(over, 0.0, block.distance),
        torch.where(over, 0.0, block.elapsed), torch.where(over, 1e3, block.slowest), block.fixed & ~over,
        torch.where(over, 0.0, block.turned), torch.where(over, 0.0, block.turned_s),
    )  # fmt: skip
