"""Wheel speed, with scale factor, offset, delay and the wheel's place to the right of the IMU as states.

A wheel at y to the right of the IMU that runs at scale 1 + s and comes d seconds late reads at the time t

    m(t) = (1 + s) (v_x(t − d) − y ω_z(t − d)) ± o          v_x = (C_bn v_n)_x

with an offset o away from zero, of a displayed speed or of km/h that are cut off, wherever it does not read zero,

and its samples of an update interval make one measurement, compared with the mean of the prediction over their
stretch. The error states refer to the interval's end, L seconds after the middle of the stretch:
δv(t) = δv + L ([f_n×] δh + C ε).

R holds white noise, slip in proportion to speed and acceleration (tyre stiffness; Gillespie 1992), and is larger, but
not for the gate, for a value that repeats itself, whose error is the same each time. Whole km/h are intervals
(:mod:`dlkf.filters.aids.rounding`). The gate allows for a drift of the filter's own speed that its covariance does not
cover, which is no fault of a wheel. A reading of zero counts only where the car is nearly at rest already: a dead
sensor or a locked wheel does not stop the car. Many sensors read zero below some speed; the largest at which a
good prediction has seen that is the least 1σ of a zero, which is then no proof of a standstill. Any other value is that
of a dead sensor, too, if it stays the same while the speed of the INS changes. A sensor without a sign is read with the
sign of the filter's own speed.

Driven wheels slip on snow or gravel for minutes, as if their scale had changed. A filter that adapts widens the walk of
the scale where wheel and fixes differ with one sign (:meth:`WheelSpeed.widen_walks`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dlkf.data.aid_tables import STANDARD, AidTable
from dlkf.data.drive import Batch
from dlkf.filters.aids.rounding import rounded_measurement
from dlkf.filters.aids.stretch import mean_force, stack_limits, stretch_weights, weighted_mean
from dlkf.filters.aids.trust import Trust, judge
from dlkf.filters.bias_steps import SignTest
from dlkf.filters.integration import Epoch
from dlkf.filters.sources import Measurement, Parameter, Predicted, SensorSource, aid_of, predicted_variance
from dlkf.filters.stationarity import acceleration_std
from dlkf.navigation.state import VELOCITY

LEAST_STD = 0.03  # m/s: the least 1σ, whatever a file gives
KMH = 1 / 3.6
SLIP = 0.005  # s²/m: share of the speed by which a driven or braked wheel slips per m/s²
REPEATS = 5.0  # values equal to the last one weigh less and less, up to so many
ROUNDED_REPEATS = 30.0  # and whole km/h: that the speed stays in its interval says nothing new
JITTER_S = 0.03  # by which the stamps of a sensor of whole km/h are off
SLOPE_S = 0.1  # an acceleration is taken over twice so long
ROLLING, BACKWARDS = 1.0, -0.3  # m/s: a wheel that turns; one with a sign
ZERO, ZERO_STD = 0.05, 0.1  # m/s: a wheel at rest, and how slowly it may turn then
NEARLY_AT_REST = 0.5  # m/s: so slow a car may be stopped by its wheel alone
DEAD_ZONE, RESOLVED = 2.0, 0.2  # m/s: the most that sensors read as zero; less is a standstill
SEES_ZONE = 0.15  # m/s 1σ of a prediction that shows it
KNOWS = 0.5  # m/s 1σ: a filter whose speed is better than this can detect a wrong wheel
DRIFT = 0.2  # m/s² of an IMU that its filter's covariance does not cover: beyond the gate, but no fault of the wheel
# m/s, beyond 2σ of the accelerations: by so much the speed may change within some seconds while a wheel's does not
DEAD, DEAD_S = 1.0, 10.0


class WheelMemory(NamedTuple):
    """Memory of a wheel."""

    std: Tensor  # (1,) m/s of one interval, the same for all drives
    trust: Trust
    last: Tensor  # (B,) m/s, the last value
    repeats: Tensor  # (B,) how often it came again
    gained: Tensor  # (B,) m/s of the INS in the last seconds since it came first
    whole: Tensor  # (B,) share of the values that were whole km/h
    signed: Tensor  # (B,) bool: it has been negative
    zone: Tensor  # (B,) m/s, the largest speed at which it has read zero
    rolling: Tensor  # (B,) bool: it turned in the last interval, and counted
    stopped: Tensor  # (B,) bool: it did not turn in the last interval, and counted
    steps: SignTest  # of its scale


class WheelSpeed(SensorSource):
    """One row: the mean forward speed of a wheel over a stretch of the update interval."""

    table: ClassVar[AidTable] = STANDARD["speed"]
    parameters: ClassVar[Mapping[str, Parameter]] = {
        "wheel_scale": Parameter(std=0.05, walk=5e-5),
        "wheel_delay_s": Parameter(std=0.1, walk=1e-4, start=0.05),
        "wheel_right_m": Parameter(std=0.5, walk=1e-4),
        "wheel_offset": Parameter(std=0.15, walk=1e-5),
    }

    def begin(self, batch: Batch) -> WheelMemory:
        """Memory before the first measurement."""
        B, zeros = batch.size[0], batch.imu.new_zeros(batch.size[0])
        std = batch.imu.new_tensor([self.tuning.wheel_std])
        trust = Trust.begin(batch.imu, B)
        no = zeros > 0
        steps = SignTest.begin(batch.imu, B, 1)
        return WheelMemory(std, trust, zeros, zeros, zeros, zeros, no, zeros, no, no, steps)

    def rows(self, epoch: Epoch, memory: WheelMemory, prediction: Predicted) -> tuple[Measurement | None, WheelMemory]:
        """The row, and what the wheel has earned by it."""
        said = aid_of(epoch, self.table.name)
        if said is None:
            return None, memory
        value, std, lag, span, count = said.unbind(-1)
        seen = count > 0
        scale = 1.0 + prediction.parameters["wheel_scale"]
        speed, H, accel = self._predict_speed(epoch, prediction, lag, span, scale)
        zero = value.abs() < ZERO
        way = torch.where(zero, 0.0, torch.where(speed < 0, -1.0, 1.0))
        H[:, :, self.states.of("wheel_offset")] = way[:, None, None]
        expected = scale * speed + way * prediction.parameters["wheel_offset"]
        unsure = predicted_variance(prediction.P, H)[:, 0]
        reverse = ~memory.signed & (value > 0) & (expected < -2 * unsure.clamp_min(0).sqrt())
        value = torch.where(reverse, -value, value)
        z = innovation = value - expected
        same = seen & ((value - memory.last).abs() < 1e-6)
        repeats = torch.where(
            seen, torch.where(same, (memory.repeats + 1).clamp_max(ROUNDED_REPEATS), 0.0), memory.repeats
        )
        gained, dead = self._watch_gain(epoch, memory, prediction, seen & ~same)
        in_kmh = (value / KMH * count).abs()
        fits = ((in_kmh - (in_kmh + 0.5).floor()).abs() < 1e-3).to(value.dtype)
        turns = seen & (value.abs() > ROLLING)
        whole = torch.where(turns, torch.lerp(memory.whole, fits, 0.1), memory.whole)
        noise = torch.where(std > 0, std.clamp_min(LEAST_STD), memory.std)
        hidden = expected.abs() - 2 * unsure.clamp_min(0).sqrt()
        shown = seen & zero & (unsure < SEES_ZONE**2) & (hidden < DEAD_ZONE)
        zone = torch.where(shown, torch.maximum(memory.zone, hidden), memory.zone)
        noise = torch.where(zero, torch.maximum(noise.clamp_min(ZERO_STD), zone), noise)
        rounded = (whole > 0.5) & ~zero
        noise = torch.where(rounded, (memory.std.square() + (JITTER_S * accel).square()).sqrt(), noise)
        slip = (SLIP * speed * accel).square()
        gate = noise.square() + slip
        R = torch.where(zero | rounded, gate, (noise * (1 + repeats.clamp_max(REPEATS))).square() + slip)
        plausible = torch.where(zero, z.abs() < NEARLY_AT_REST, ~dead)
        beyond = torch.where(rounded, (z.abs() - 0.5 * KMH).clamp_min(0.0), z)
        drifted = (DRIFT * epoch.dt * epoch.imu.shape[1]) ** 2
        trust, used, excess = judge(memory.trust, seen, beyond, unsure + gate + drifted, unsure < KNOWS**2, plausible)
        R = R * excess
        of_cell = rounded_measurement(z, 0.5 * KMH, unsure, R)
        again = torch.where(z.abs() < 0.5 * KMH, (1 + repeats).square(), 1.0)
        z, R = torch.where(rounded, of_cell[0], z), torch.where(rounded, of_cell[1] * again, R)
        steps = self._watch_scale(epoch, memory, prediction, innovation, H, gate, turns)
        memory = WheelMemory(
            memory.std, trust, torch.where(seen, value, memory.last), repeats, gained, whole,
            memory.signed | (used & ~reverse & (value < BACKWARDS)),
            zone, used & turns, used & zero & (zone < RESOLVED), steps,
        )  # fmt: skip
        return Measurement(z.unsqueeze(-1), H, R.unsqueeze(-1), used.unsqueeze(-1)), memory

    def widen_walks(self, P: Float[Tensor, "B n n"], memory: WheelMemory, epoch: Epoch) -> Float[Tensor, "B n n"]:
        """P of an update interval with a fix, in which the scale walks further where fixes contradict it with one sign
        (:mod:`dlkf.filters.bias_steps`)."""
        scale, walk = self.states.of("wheel_scale"), self.parameters["wheel_scale"].walk
        more = torch.where(epoch.used.any(-1, keepdim=True), memory.steps.walk_factors.square() - 1, 0.0)
        P = P.clone()
        P[:, scale, scale] += (walk**2 * epoch.span_s * more).unsqueeze(-1)
        return P

    def _watch_scale(
        self, epoch: Epoch, memory: WheelMemory, prediction: Predicted, z: Float[Tensor, " B"],
        H: Float[Tensor, "B 1 n"], variance: Float[Tensor, " B"], turns: Bool[Tensor, " B"],
    ) -> SignTest:  # fmt: skip
        """Whether the scale has changed: the wheel's innovation less that of the fix's velocity along the car, over
        the 1σ of both and of the scale."""
        scale, H = self.states.of("wheel_scale"), H.squeeze(1)
        of_fix, slope = H[:, VELOCITY], H[:, scale]
        variance = variance + (of_fix * epoch.fix.std[:, VELOCITY]).square().sum(-1)
        variance = variance + (slope.square() * prediction.P[:, scale, scale].squeeze(-1)).squeeze(-1)
        apart = z - (of_fix * epoch.z[:, VELOCITY]).sum(-1)
        e = torch.where(slope < 0, -1.0, 1.0) * (apart / variance.sqrt()).unsqueeze(-1)
        return memory.steps.update(e, turns & epoch.used[:, VELOCITY][:, :2].all(-1), torch.ones_like(z))

    def _watch_gain(
        self, epoch: Epoch, memory: WheelMemory, prediction: Predicted, changed: Bool[Tensor, " B"]
    ) -> tuple[Float[Tensor, " B"], Bool[Tensor, " B"]]:
        """What the speed of the INS has gained in the last ``DEAD_S`` since the wheel's value ``changed``, and whether
        that is more than the errors of its accelerations explain: then it stays until the value changes."""
        end = epoch.window.end
        limit = DEAD + 2 * DEAD_S * acceleration_std(prediction.P, end.C_nb)
        before, after = ((x.C_nb[..., 0] * x.v_n).sum(-1) for x in (epoch.start, end))
        faded = math.exp(-epoch.span_s / DEAD_S) * memory.gained
        kept = torch.where(memory.gained.abs() > limit, memory.gained, faded + after - before)
        gained = torch.where(changed, 0.0, kept)
        return gained, gained.abs() > limit

    def _predict_speed(
        self, epoch: Epoch, prediction: Predicted, lag: Tensor, span: Tensor, scale: Tensor
    ) -> tuple[Float[Tensor, " B"], Float[Tensor, "B 1 n"], Float[Tensor, " B"]]:
        """Speed of the wheel over the stretch at scale 1, H of the measurement, and the acceleration along the car."""
        samples, dt = epoch.corrected.shape[1], epoch.dt
        T = samples * dt
        delay, right = prediction.parameters["wheel_delay_s"], prediction.parameters["wheel_right_m"]
        forward = stack_limits(epoch.start.C_nb[..., 0], epoch.window.C_nb[..., 0])
        v_n = stack_limits(epoch.start.v_n, epoch.window.v_n)
        turn = stack_limits(epoch.corrected[:, 0, 5], epoch.corrected[..., 5])
        along = (forward * v_n).sum(-1)
        wheel = along - right.unsqueeze(-1) * turn
        reach = (0.5 * span).clamp(0.5 * dt, 0.5 * T)
        late = lag + delay
        middle = torch.minimum(torch.maximum(late, reach), T - reach)  # of a stretch inside the window
        weights = stretch_weights(middle, span, samples, dt)
        half = reach.clamp_min(SLOPE_S)
        first, last = (middle + half).clamp_max(T), (middle - half).clamp_min(0.0)
        none = torch.zeros_like(span)
        between = stretch_weights(last, none, samples, dt) - stretch_weights(first, none, samples, dt)
        gained = weighted_mean(between, along)
        accel = gained / (first - last)
        speed = weighted_mean(weights, wheel) - accel * (late - middle)
        axis = weighted_mean(weights, forward)
        H = axis.new_zeros(len(axis), self.states.count)
        H[:, self.states.velocity] = axis
        lever = torch.linalg.cross(axis, mean_force(epoch)) * middle.unsqueeze(-1)
        H[:, self.states.attitude] = weighted_mean(weights, torch.linalg.cross(forward, v_n)) + lever
        H[:, 9] = middle
        H[:, 14] = right
        H = scale.unsqueeze(-1) * H
        H[:, self.states.of("wheel_scale")] = speed.unsqueeze(-1)
        H[:, self.states.of("wheel_delay_s")] = -(scale * accel).unsqueeze(-1)
        H[:, self.states.of("wheel_right_m")] = -(scale * weighted_mean(weights, turn)).unsqueeze(-1)
        return speed, H.unsqueeze(1), accel
