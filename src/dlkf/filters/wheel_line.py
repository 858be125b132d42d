"""Which line of an IMU's spectrum over distance is a wheel's: one that keeps its phase, or stands out, at all speeds.

While fixes show the speed, the spectrum of every second (:mod:`dlkf.filters.order_spectrum`) is predicted for each κ by
its mean over the seconds before,

    h_n = Σ_k λᵏ Z_{n−k} / Σ_k λᵏ,  less what noise alone has in it: times 1 − (1 − λ)/((1 + λ)|h|²)

and that of every block of some 3 s by how much κ stood out in the blocks before. The logarithms of both likelihood
ratios against noise are summed, each for itself: phase finds a wheel sooner, power finds what has no phase, as the
unevenness of a road that front and rear wheels run over one after the other.

A tone of a fixed frequency stands at a line at one speed only. So the sums are kept by classes of speed, which forget
for themselves, and a line counts as a wheel's if it was there at other speeds than where it was clearest (two
neighbouring classes), and if no other line is as likely, the sums taken for logarithms of probability. One at the ends
of the range may be the flank of something outside.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dlkf.filters.branches import chosen, may_branch
from dlkf.filters.order_spectrum import LINES, WAVES, log_likelihood_of_phase, log_lines, relative, rotated

TEMPLATE_S = 3.5  # over which a template forgets
LEAST_WEIGHT = 1.2  # of a template that predicts
SLOWEST, WIDTH, CLASSES = 1.1, 0.07, 38  # classes of ln v, from 3 to 43 m/s
PHASE_S, POWER_S = 25.0, 100.0  # in a class of speed, over which evidence is forgotten
LEAST, MOST = -1.0, 5.0  # nats that a class may contradict and give: a wheel is weak at low speed, a tone strong at one
DETECTED, LOST = 4.0, 2.0  # nats of all classes from which a line counts, and below which it does no more
ELSEWHERE, NOWHERE = 1.0, 0.3  # the same of those besides the two where it is clearest
ALONE, NEAR = 0.9, 0.05  # the probability that lines so near in ln κ must have together
EDGE = 3  # lines at the ends of the range
FINEST = 0.004  # 1σ of ln κ at best


class Evidence(NamedTuple):
    """For a wheel at each line."""

    nats: Tensor  # (B, V, K) by classes of speed
    sure: Tensor  # (B,) bool: the best line is a wheel's

    @classmethod
    def begin(cls, like: Tensor, B: int) -> Evidence:
        """None."""
        return cls(like.new_zeros(B, CLASSES, LINES), like.new_zeros(B) > 0)

    def after(
        self, said: Float[Tensor, "B K"], lost: Float[Tensor, " B"], log_speed: Float[Tensor, " B"],
        judged: Bool[Tensor, " B"],
    ) -> Evidence:  # fmt: skip
        """With nats where they are ``judged``; their class of speed forgets the share ``lost`` of what it had."""
        number = ((log_speed - SLOWEST) / WIDTH).floor().clamp(0, CLASSES - 1)
        here = torch.arange(CLASSES, dtype=said.dtype, device=said.device) == number.unsqueeze(-1)
        before = torch.bmm(here.to(said.dtype).unsqueeze(1), self.nats).squeeze(1)
        of_class = before + said - lost.unsqueeze(-1) * before
        of_class = of_class - (of_class.amax(1, keepdim=True) - MOST).clamp_min(0.0)
        nats = torch.where((here & judged.unsqueeze(-1)).unsqueeze(-1), of_class.unsqueeze(1), self.nats)
        return Evidence(nats, Evidence(nats, self.sure)._is_sure())

    def log_turns(self) -> tuple[Float[Tensor, " B"], Float[Tensor, " B"]]:
        """ln κ of the best line and its variance, from the lines about it."""
        total = self.nats.clamp_min(LEAST).sum(1)
        p, lines = _near_the_best(total), log_lines(total)
        p = p / p.sum(1, keepdim=True)
        mean = (p * lines).sum(1)
        return mean, (p * (lines - mean.unsqueeze(-1)).square()).sum(1) + FINEST**2

    def _is_sure(self) -> Bool[Tensor, " B"]:
        """Whether the best line is a wheel's."""
        by_class = self.nats.clamp_min(LEAST)
        total = by_class.sum(1)
        elsewhere = total - (by_class[:, 1:] + by_class[:, :-1]).amax(1)
        p = torch.exp(total - total.amax(1, keepdim=True))
        alone = _near_the_best(total).sum(1) > ALONE * p.sum(1)
        most, besides = total.amax(1), _of_the_best(total, elsewhere)
        enough = (most > DETECTED) & (besides > ELSEWHERE)
        still = self.sure & (most > LOST) & (besides > NOWHERE)
        number = _of_the_best(total, torch.arange(LINES, dtype=p.dtype, device=p.device))
        return alone & (enough | still) & (number >= EDGE) & (number <= LINES - 1 - EDGE)


class WheelLine(NamedTuple):
    """What the phase of the lines has shown of this car's wheels."""

    template: Tensor  # (B, 6, waves) Σ λᵏ Z, on the distance since the block began
    weight: Tensor  # (B,) Σ λᵏ
    by_phase: Evidence
    by_power: Evidence

    @classmethod
    def begin(cls, like: Tensor, B: int) -> WheelLine:
        """Nothing."""
        nothing = Evidence.begin(like, B)
        return cls(like.new_zeros(B, 6, WAVES), like.new_zeros(B), nothing, nothing)

    @property
    def detected(self) -> Bool[Tensor, " B"]:
        """Whether one of both is sure of a wheel."""
        return self.by_phase.sure | self.by_power.sure

    def after(
        self, spectrum: Float[Tensor, "B 6 waves"], span_s: Float[Tensor, " B"], log_speed: Float[Tensor, " B"],
        seen: Float[Tensor, "B O"], moving: Bool[Tensor, " B"], knows: Bool[Tensor, " B"],
    ) -> WheelLine:  # fmt: skip
        """After the spectrum of a second: in motion it joins the template, and at a speed that fixes show (``knows``)
        it is evidence. ``seen``: the orders that the sampling rate shows."""
        lasts = torch.exp(-span_s / TEMPLATE_S)
        faded = self._replace(template=lasts[:, None, None] * self.template, weight=lasts * self.weight)
        if may_branch(moving) and not bool(moving.any()):
            return faded
        part = relative(spectrum)
        said = log_likelihood_of_phase(part, self._predicted(lasts), seen)
        judged = knows & (self.weight > LEAST_WEIGHT)
        by_phase = self.by_phase.after(said, span_s / PHASE_S, log_speed, judged)
        return chosen(moving, WheelLine(faded.template + part, faded.weight + 1, by_phase, self.by_power), faded)

    def with_power(
        self, said: Float[Tensor, "B K"], span_s: Float[Tensor, " B"], log_speed: Float[Tensor, " B"],
        judged: Bool[Tensor, " B"],
    ) -> WheelLine:  # fmt: skip
        """After a block, with what the power of its lines says."""
        return self._replace(by_power=self.by_power.after(said, span_s / POWER_S, log_speed, judged))

    def from_here(self, distance: Float[Tensor, " B"], on: Bool[Tensor, " B"]) -> WheelLine:
        """With the distance counted from so many metres further on, where ``on``."""
        return self._replace(template=chosen(on, rotated(self.template, distance), self.template))

    def log_turns(self) -> tuple[Float[Tensor, " B"], Float[Tensor, " B"]]:
        """ln κ of the best line and its variance; by phase, if that is sure."""
        of_phase, of_power = self.by_phase.log_turns(), self.by_power.log_turns()
        mean, variance = (torch.where(self.by_phase.sure, x, y) for x, y in zip(of_phase, of_power))
        return mean, variance

    def _predicted(self, lasts: Float[Tensor, " B"]) -> Float[Tensor, "B 6 waves"]:
        """The template's mean, less what noise alone has in it."""
        h = self.template / self.weight.clamp_min(1e-3)[:, None, None]
        square = h.square().unflatten(2, (2, -1)).sum(2)
        noise = ((1 - lasts) / (1 + lasts))[:, None, None]
        kept = (1 - noise / square.clamp_min(1e-9)).clamp_min(0.0)
        return h * torch.cat((kept, kept), -1)


def _near_the_best(total: Float[Tensor, "B K"]) -> Float[Tensor, "B K"]:
    """Probability relative to the best line, 0 beyond ``NEAR``."""
    lines = log_lines(total)
    p = torch.exp(total - total.amax(1, keepdim=True))
    return p * ((lines - _of_the_best(total, lines).unsqueeze(-1)).abs() < NEAR).to(p.dtype)


def _of_the_best(total: Float[Tensor, "B K"], values: Tensor) -> Float[Tensor, " B"]:
    """The value of the best line, of those of all lines; the mean of several that are equal."""
    largest = (total >= total.amax(1, keepdim=True)).to(total.dtype)
    return (largest * values).sum(1) / largest.sum(1)
