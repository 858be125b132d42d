"""Speed from the wheels' orders in the vibration that an IMU measures: a wheel sensor without a wheel.

While fixes show the speed, the phase that lines in the spectrum over the distance covered keep, and their power, show
which of them is a wheel's (:mod:`dlkf.filters.wheel_line`), and so how often it turns in a metre, κ; the mean of
spectra over blocks of some 3 s shows by how much it stands out. In an outage the line of a block stands at κ v̄/v̂ for
the true and the filter's own mean speed, which makes a measurement of the speed (chassis vibrations: Lindfors et al.
2016),

    z = ln κ_line − ln κ,    H = uᵀ δv̄ / v̂,    δv̄ = δv − L (Cε + [f_n×] δh)ᵀu    u along the velocity, L half a block

What the spectrum says of ln κ_line is no Gaussian but has several peaks. Its mean and variance under the filter's own
1σ, widened by ``SEARCH``, are those of a measurement with variance R that is taken from them; a block that decides
nothing is kept, so that several do together.

Tones of a fixed frequency, of other gears or of nothing at all are no line of a wheel, and the filter is as without
this source. Training gets no rows: a peak has no gradient.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar, NamedTuple

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
from dlkf.filters.sources import Measurement, Predicted, describe_row, predicted_variance
from dlkf.filters.tuning import Tuning
from dlkf.filters.wheel_line import WheelLine
from dlkf.navigation.state import ACCEL, ErrorStates

PART_S, BLOCK_S = 1.0, 3.0  # whose phase counts, and whose power
SLOWEST = 3.0  # m/s: below, the orders lie among the car's own motion
KNOWN, KNOWN_BLOCK = 0.04, 0.02  # relative 1σ of a speed that shows a line, and of one that teaches its power
FIRST_BLOCKS = 3  # before power is predicted
MEMORY = 75.0  # blocks of the averages
WANDER = 1e-4  # of ln κ, per √block
DRIFT = 0.01  # in ln v, by which a filter's speed may drift from block to block
SEARCH = 0.02  # in ln v, beyond the filter's 1σ
FINEST = 0.005  # in ln κ: a line is no finer
DECIDED, SURE, OUTLIER = 0.8, 0.03, 3.0  # of the search's variance; 1σ in ln κ; σ: what decides a block
LOST_STD = 0.1  # relative 1σ of a speed that no line is looked for at
UNCHECKED_S = 100.0  # s after a fix, from which on what nothing has checked is worth less and less
TOGETHER = 10.0  # measurements that share the error of κ count as so many


class Stretch(NamedTuple):
    """Samples of some update intervals."""

    spectrum: Tensor  # (B, 6, waves)
    distance: Tensor  # (B,) m
    elapsed: Tensor  # (B,) s
    slowest: Tensor  # (B,) m/s
    fixed: Tensor  # (B,) bool: it had a fix

    @classmethod
    def begin(cls, like: Tensor, B: int) -> Stretch:
        """Nothing in it."""
        zero = like.new_zeros(B)
        return cls(like.new_zeros(B, 6, WAVES), zero, zero, zero + 1e3, zero > 0)

    @property
    def speed(self) -> Float[Tensor, " B"]:
        """Mean speed [m/s]."""
        return (self.distance / self.elapsed.clamp_min(1e-3)).clamp_min(0.1)

    @property
    def moving(self) -> Bool[Tensor, " B"]:
        """Whether it was fast enough all the time."""
        return self.slowest > SLOWEST

    def after(self, epoch: Epoch, of_block: Stretch, block_s: float, last: Float[Tensor, "B 6"]) -> Stretch:
        """With one more update interval; ``last`` is the sample before it."""
        x, dt = epoch.corrected, epoch.dt
        M = x.shape[1]
        speed = at_limits(epoch.start.v_n, epoch.window.v_n)[..., :2].norm(dim=-1)
        step = 0.5 * dt * (speed[:, 1:] + speed[:, :-1])
        distance = (of_block.distance + self.distance).unsqueeze(-1) + step.cumsum(1) - 0.5 * step
        sample = torch.arange(M, dtype=x.dtype, device=x.device)
        time = (of_block.elapsed + self.elapsed).unsqueeze(-1) + dt * (sample + 0.5)
        weight = torch.sin((math.pi / block_s) * time).clamp_min(0.0)
        known = (last != 0).any(-1, keepdim=True)
        before = torch.cat((torch.where(known, last, x[:, 0]).unsqueeze(1), x[:, :-1]), 1)
        return Stretch(
            demodulate((x - before) * weight.unsqueeze(-1), distance, self.spectrum),
            self.distance + step.sum(1), self.elapsed + dt * M,
            torch.minimum(self.slowest, -(-speed).amax(1)), self.fixed | epoch.used.any(-1),
        )  # fmt: skip

    def joined(self, part: Stretch) -> Stretch:
        """With a part behind it."""
        return Stretch(
            self.spectrum + part.spectrum, self.distance + part.distance, self.elapsed + part.elapsed,
            torch.minimum(self.slowest, part.slowest), self.fixed | part.fixed,
        )  # fmt: skip


class Wheels(NamedTuple):
    """How a wheel's lines stand out, and how often it turns in a metre."""

    levels: Tensor  # (B, 6, O, K) mean of the log levels
    blocks: Tensor  # (B,) in that mean
    detected: Tensor  # (B,) bool
    log_turns: Tensor  # (B,) ln κ
    variance: Tensor  # (B,) its variance

    @classmethod
    def begin(cls, like: Tensor, B: int) -> Wheels:
        """Nothing."""
        zero = like.new_zeros(B)
        return cls(like.new_zeros(B, 6, len(ORDERS), LINES), zero, zero > 0, zero, zero)

    def excess(self) -> Float[Tensor, "B 6 O"]:
        """By what its lines stand out."""
        kappa = torch.exp(self.log_turns).unsqueeze(-1)
        near = torch.exp(-0.5 * ((torch.exp(log_lines(kappa)) - kappa) / STEP).square())
        near = near / near.sum(1, keepdim=True).clamp_min(1e-12)
        return (self.levels * near[:, None, None]).sum(-1)

    def of_line(self, line: WheelLine) -> Wheels:
        """With a line that was detected, or lost."""
        new = line.detected & ~self.detected
        log_turns, variance = line.log_turns()
        return self._replace(
            detected=line.detected,
            log_turns=torch.where(new, log_turns, self.log_turns),
            variance=torch.where(new, variance, self.variance),
        )

    def learned(self, levels: Float[Tensor, "B 6 O K"], knows: Bool[Tensor, " B"]) -> Wheels:
        """After a block whose speed fixes show."""
        blocks = torch.where(knows, self.blocks + 1, self.blocks)
        rate = torch.where(knows, 1 / blocks.clamp(1, MEMORY), 0.0)
        return self._replace(levels=self.levels + rate[:, None, None, None] * (levels - self.levels), blocks=blocks)


class OrdersMemory(NamedTuple):
    """Memory of the source; nothing of it has axes in n."""

    block: Stretch  # the present one, of the parts that are over
    part: Stretch  # the present one
    last_sample: Tensor  # (B, 6)
    line: WheelLine
    wheels: Wheels
    undecided: Tensor  # (B, K) ln Λ of blocks that decided nothing
    age: Tensor  # (B,) s since the last fix


@dataclass(frozen=True)
class WheelOrders:
    """One row: ln of the true over the filter's mean speed in a block."""

    imu: object
    tuning: Tuning
    states: ErrorStates
    columns: ClassVar[tuple[str, ...]] = (
        "wheel_orders_innovation", "wheel_orders_innovation_std", "wheel_orders_used",
        "wheel_orders_circumference_m", "std_wheel_orders_circumference_m",
    )  # fmt: skip

    @property
    def code(self) -> WheelOrders:
        """It has no settings of its own."""
        return WheelOrders(None, Tuning(), self.states)

    def begin(self, batch: Batch) -> OrdersMemory:
        """Nothing detected."""
        like, B = batch.imu, batch.size[0]
        nothing = Stretch.begin(like, B)
        return OrdersMemory(
            nothing, nothing, like.new_zeros(B, 6), WheelLine.begin(like, B), Wheels.begin(like, B),
            like.new_zeros(B, LINES), like.new_zeros(B),
        )  # fmt: skip

    def rows(
        self, epoch: Epoch, memory: OrdersMemory, prediction: Predicted
    ) -> tuple[Measurement | None, OrdersMemory]:
        """A row at the end of a block whose lines decide something."""
        if torch.is_grad_enabled():
            return None, memory
        span = epoch.dt * epoch.imu.shape[1]
        part_s = max(1, round(PART_S / span)) * span
        block_s = max(1, round(BLOCK_S / part_s)) * part_s
        part = memory.part.after(epoch, memory.block, block_s, memory.last_sample)
        age = torch.where(epoch.used.any(-1), 0.0, memory.age + span)
        memory = memory._replace(part=part, last_sample=epoch.corrected[:, -1], age=age)
        over = part.elapsed > part_s - 0.5 * span
        if may_branch(over) and not bool(over.any()):
            return None, memory
        line = self._shown(epoch, memory, prediction)
        memory = memory._replace(
            block=chosen(over, memory.block.joined(part), memory.block), part=_emptied(part, over),
            line=chosen(over, line, memory.line),
        )  # fmt: skip
        done = over & (memory.block.elapsed > block_s - 0.5 * span)
        if may_branch(done) and not bool(done.any()):
            return None, memory
        row, wheels, undecided, line = self._judged(epoch, memory, prediction, done)
        line = chosen(done, line, memory.line).from_here(memory.block.distance, done)
        kept = torch.where(epoch.used.any(-1, keepdim=True) | row.used, 0.0, undecided)
        zeros, B = epoch.z.new_zeros, len(epoch.z)  # zeros like the row's would need the row, in C at any time
        nothing = Measurement(
            zeros(B, 1), zeros(B, 1, self.states.count), zeros(B, 1), zeros(B, 1, dtype=torch.bool)
        )  # fmt: skip
        return chosen(done, row, nothing), memory._replace(
            block=_emptied(memory.block, done), line=line, wheels=chosen(done, wheels, memory.wheels),
            undecided=chosen(done, kept, memory.undecided),
        )  # fmt: skip

    def describe(
        self, epoch: Epoch, memory: OrdersMemory, rows: Measurement | None, P: Float[Tensor, "B n n"]
    ) -> Float[Tensor, "B 5"]:
        """What is to be said of an update interval: :attr:`columns`; NaN where nothing was measured, or is detected."""
        wheels = memory.wheels
        said = describe_row(epoch, rows, P, None if rows is None else wheels.detected & (rows.R[:, 0] > 0))
        length = torch.exp(-wheels.log_turns)
        found = torch.stack((length, length * wheels.variance.clamp_min(0.0).sqrt()), -1)
        return torch.cat((said, torch.where(wheels.detected.unsqueeze(-1), found, torch.nan)), -1)

    def _shown(self, epoch: Epoch, memory: OrdersMemory, prediction: Predicted) -> WheelLine:
        """What the phase of the lines shows after a part that is over."""
        part = memory.part
        of_speed = predicted_variance(prediction.P, self._matrix(epoch, 0.5 * part.elapsed, part.speed))[:, 0]
        knows = part.moving & part.fixed & (of_speed < KNOWN**2)
        seen = self._seen(epoch, part.speed)
        return memory.line.after(part.spectrum, part.elapsed, torch.log(part.speed), seen, part.moving, knows)

    def _judged(
        self, epoch: Epoch, memory: OrdersMemory, prediction: Predicted, done: Bool[Tensor, " B"]
    ) -> tuple[Measurement, Wheels, Float[Tensor, "B K"], WheelLine]:
        """The row of a block that is done, what is known after it, and what the blocks since the last row say."""
        block, before = memory.block, memory.wheels
        levels = log_levels(block.spectrum)
        lines = log_lines(levels)
        speed, moving, seen = block.speed, done & block.moving, self._seen(epoch, block.speed)

        H = self._matrix(epoch, 0.5 * block.elapsed, speed)
        of_speed = predicted_variance(prediction.P, H)[:, 0]
        levels = levels * seen[:, None, :, None]
        knows = moving & block.fixed & (of_speed < KNOWN_BLOCK**2)
        by_power, judged = log_likelihood(levels, before.levels), knows & (before.blocks >= FIRST_BLOCKS)
        line = memory.line.with_power(by_power, block.elapsed, torch.log(speed), judged)
        wheels = before.of_line(line)
        likelihood = log_likelihood(levels, (wheels.excess() * seen.unsqueeze(1)).unsqueeze(-1))
        undecided = _diffused(memory.undecided)
        undecided = undecided + (moving & wheels.detected).to(likelihood.dtype).unsqueeze(-1) * likelihood

        wheels = wheels.learned(levels, knows)

        off = lines - wheels.log_turns.unsqueeze(-1)
        searched = of_speed + wheels.variance + SEARCH**2
        z, R, decided = _gaussian(undecided - 0.5 * off.square() / searched.unsqueeze(-1), off, searched)
        used = moving & wheels.detected & decided & (of_speed + wheels.variance < LOST_STD**2)
        if prediction.rolling is not None:  # a wheel that agrees says more
            used = used & ~prediction.rolling
        gain = torch.where(knows & used, wheels.variance / (wheels.variance + of_speed + R), 0.0)
        R = (R + TOGETHER * wheels.variance) * (1 + (memory.age / UNCHECKED_S).square())
        R = R * (z.square() / (of_speed + R) / OUTLIER**2).clamp_min(1.0)
        wheels = wheels._replace(
            log_turns=wheels.log_turns + gain * z,
            variance=(1 - gain) * wheels.variance + torch.where(done, WANDER**2, 0.0),
        )
        return Measurement(z.unsqueeze(-1), H, R.unsqueeze(-1), used.unsqueeze(-1)), wheels, undecided, line

    def _seen(self, epoch: Epoch, speed: Float[Tensor, " B"]) -> Float[Tensor, "B O"]:
        """Which orders are below the sampling's limit at a speed."""
        highest = 0.55 * speed.unsqueeze(-1) * speed.new_tensor(ORDERS)
        return (highest < NYQUIST / epoch.dt).to(speed.dtype)

    def _matrix(self, epoch: Epoch, middle: Float[Tensor, " B"], speed: Float[Tensor, " B"]) -> Float[Tensor, "B 1 n"]:
        """H of ln of the true over the filter's mean speed of a block, whose middle is so many seconds ago."""
        end = epoch.window.end
        along = end.v_n / end.v_n.norm(dim=-1, keepdim=True).clamp_min(0.5)
        H = along.new_zeros(len(along), self.states.count)
        H[:, self.states.velocity] = along
        H[:, self.states.attitude] = middle.unsqueeze(-1) * torch.linalg.cross(along, mean_force(epoch))
        H[:, ACCEL] = middle.unsqueeze(-1) * torch.bmm(end.C_nb.mT, along.unsqueeze(-1)).squeeze(-1)
        return (H / speed.unsqueeze(-1)).unsqueeze(1)


def _emptied(stretch: Stretch, over: Bool[Tensor, " B"]) -> Stretch:
    """The stretch, or where it is over a new one."""
    return Stretch(
        torch.where(over[:, None, None], 0.0, stretch.spectrum), torch.where(over, 0.0, stretch.distance),
        torch.where(over, 0.0, stretch.elapsed), torch.where(over, 1e3, stretch.slowest), stretch.fixed & ~over,
    )  # fmt: skip


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
