"""Vehicle constraints as pseudo-measurements: no sideways or vertical velocity, none at all while stationary.

Non-holonomic constraint (NHC; Dissanayake et al. 2001). The velocity of the IMU in body axes is, across the car,

    v_y = ψ v_x + a ω_z + k v_x² ω_z      v_z = θ v_x − a ω_y + s v_x f_x

with ψ, θ the direction in which the car moves relative to the IMU's axes (mounting), a how far ahead of the rear axle
the IMU sits, k the sideslip per lateral acceleration and speed (single-track model), and s how far its springs let the
car pitch back per specific force f_x forward (pitch gradient; Gillespie 1992). Plain, all five are zero; with structure
they are further states of the filter. A standstill (:mod:`dlkf.filters.stationarity`) measures v = 0
(zero-velocity update) and ω_b = Earth rate (zero-angular-rate update). A gyroscope that reads the same all the time
rounds, or holds back a rate that it takes for none, so it shows nothing of its bias.

Roads shake a car across its way by more than that, and its springs bring it back. So velocity and rate are means over
the last ``MEAN_S``, in which the errors of the filter count as constant. A pothole or a knock may still make a row off
by many σ: beyond ``OUTLIER`` σ its 1σ grows in proportion to its innovation, and its correction falls with one over it.

The 1σ of a row is that of one a second: of shorter update intervals each row has a larger one, so that a second says
the same.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dlkf.data.drive import Batch
from dlkf.filters.constraint_noise import ConstraintNoise
from dlkf.filters.integration import Epoch
from dlkf.filters.sources import Measurement, Predicted, predicted_variance
from dlkf.filters.stationarity import VibrationLevel, WheelMotion, detect_stationary
from dlkf.filters.tuning import Tuning
from dlkf.navigation.state import GYRO, POSITION, STATES, VELOCITY, ErrorStates

STRUCTURE_STD = (0.05, 0.05, 1.5, 0.01, 0.005)  # rad, rad, m, s²/m, s²·rad/m: what is known of a car before it moves
STRUCTURE_WALK_STD = (2e-5, 2e-5, 1e-4, 1e-6, 1e-6)  # per √s
MEAN_S = 0.5  # of velocity and rate across the car, at most an epoch
SPRINGS_S = 0.3  # the springs follow the force so slowly: it is averaged over so long, at most an epoch
OUTLIER = 3.0  # σ of an innovation across the car, from which on its 1σ grows with it
SHOWN_RATE_STD = 1e-6  # rad/s: with a smaller spread a gyroscope reads the same in every sample
SLOWEST = 0.5  # m/s: below, course and yaw rate do not show the vehicle parameters


class CarMemory(NamedTuple):
    """What the constraints carry from epoch to epoch."""

    std: Tensor  # (1, 8) of the rows, the same for all drives
    liveliness: VibrationLevel  # of this car
    prior: Tensor  # (1,) prior least level of a second of motion, the same for all drives
    noise: ConstraintNoise | None = None  # across the car, where it is found


@dataclass(frozen=True)
class CarConstraints:
    """Constraints on a car's motion for a filter with the given error states.

    ``adapts_noise``: the 1σ across the car follows what innovations show (:mod:`dlkf.filters.constraint_noise`).
    """

    tuning: Tuning
    states: ErrorStates
    adapts_noise: bool = field(default=False, kw_only=True)

    @property
    def code(self) -> CarConstraints:
        """Without the numbers that the memory carries."""
        return replace(self, tuning=Tuning())

    def begin(self, batch: Batch) -> CarMemory:
        """No standstill so far, and the 1σ of the rows."""
        t, new = self.tuning, batch.imu.new_tensor
        std = [t.lateral_std, t.vertical_std] + [t.rest_velocity_std] * 3 + [t.rest_rate_std] * 3
        noise = ConstraintNoise.begin(batch.imu, batch.size[0]) if self.adapts_noise else None
        return CarMemory(new([std]), VibrationLevel.begin(batch), new([t.rest_accel * t.rest_gyro]), noise)

    def rows(self, epoch: Epoch, memory: CarMemory, prediction: Predicted) -> tuple[Measurement, CarMemory]:
        """NHC (2 rows), zero velocity (3), zero angular rate (3)."""
        zn, Hn, moving = self._measure_lateral(epoch, prediction.structure)
        zr, Hr = self._measure_standstill(epoch)
        resting, liveliness, rate_variance = self.detect_rest(epoch, zr[:, 3:], prediction, memory)
        resting = resting.unsqueeze(-1)
        shown = resting & (rate_variance > SHOWN_RATE_STD**2)
        used = torch.cat(((moving.unsqueeze(-1) & ~resting).expand(-1, 2), resting.expand(-1, 3), shown), -1)
        per_second = max(1.0, 1.0 / epoch.span_s)
        variance = (memory.std.square() * per_second).expand(len(zn), -1)
        if epoch.noise is not None and epoch.noise.across is not None:
            variance = torch.cat((variance[:, :2] * epoch.noise.across.square(), variance[:, 2:]), -1)
        noise, of_state, a_second = memory.noise, predicted_variance(prediction.P, Hn), variance[:, :2] / per_second
        if noise is not None:
            variance = torch.cat((noise.factor * variance[:, :2], variance[:, 2:]), -1)
            learns = used[:, 0] & _is_near_fix(epoch, prediction.P)
            noise = noise.update(zn, of_state, a_second, OUTLIER, learns)
        across = _widen_outliers(variance[:, :2], zn, of_state)
        of_bias = prediction.P.diagonal(dim1=-2, dim2=-1)[:, GYRO]
        rate = _widen_outliers(variance[:, 5:] + rate_variance, zr[:, 3:], of_bias)
        variance = torch.cat((across, variance[:, 2:5], rate), -1)
        z = torch.cat((zn, zr), -1) * used
        return Measurement(z, torch.cat((Hn, Hr), 1), variance, used), memory._replace(
            liveliness=liveliness, noise=noise
        )

    def widen_walks(self, P: Float[Tensor, "B n n"], memory: CarMemory, epoch: Epoch) -> Float[Tensor, "B n n"]:
        """P of an update interval with a fix, in which the mounting walks further where its innovations keep their
        sign (:mod:`dlkf.filters.constraint_noise`)."""
        if memory.noise is None or not self.states.structure:
            return P
        walk = P.new_tensor(STRUCTURE_WALK_STD[:2]).square() * epoch.span_s
        more = torch.where(epoch.used.any(-1, keepdim=True), memory.noise.turn.walk_factors.square() - 1, 0.0)
        first, P = self.states.of_structure.start, P.clone()
        P[:, first : first + 2, first : first + 2] += torch.diag_embed(more * walk)
        return P

    def detect_rest(
        self, epoch: Epoch, turning: Float[Tensor, "B 3"], prediction: Predicted, memory: CarMemory
    ) -> tuple[Bool[Tensor, " B"], VibrationLevel, Float[Tensor, "B 3"]]:
        """Whether the car was stationary in the window, the vibration levels after it, and the variance of its mean
        rate by the samples."""
        wheel = None
        if prediction.rolling is not None and prediction.stopped is not None:
            wheel = WheelMotion(prediction.rolling, prediction.stopped)
        return detect_stationary(epoch, turning, prediction.P, memory.liveliness, memory.prior, wheel)

    def _measure_lateral(
        self, epoch: Epoch, structure: Float[Tensor, "B 5"] | None
    ) -> tuple[Float[Tensor, "B 2"], Float[Tensor, "B 2 n"], Bool[Tensor, " B"]]:
        """Innovation and H of the mean velocity across the car at the window's end."""
        last = max(1, min(epoch.corrected.shape[1], round(MEAN_S / epoch.dt)))
        axes, v_n = epoch.window.C_nb[:, -last:].mT, epoch.window.v_n[:, -last:].unsqueeze(2)
        v_b, rate = (axes * v_n).sum((1, 3)) / last, epoch.corrected[:, -last:, 3:].sum(1) / last
        C_bn = axes.sum(1) / last
        turned = torch.linalg.cross(axes, v_n.expand_as(axes)).sum(1) / last  # Cᵀ [v×]
        vx, w_y, w_z = v_b[:, 0], rate[:, 1], rate[:, 2]
        zero = torch.zeros_like(vx)
        yaw, pitch, axle, slip, gradient = (zero,) * 5 if structure is None else structure.unbind(-1)
        count = max(1, min(epoch.corrected.shape[1], round(SPRINGS_S / epoch.dt)))
        force = epoch.corrected[:, -count:, 0].sum(1) / count
        pitch = pitch + gradient * force
        model = torch.stack((yaw * vx + (axle + slip * vx * vx) * w_z, pitch * vx - axle * w_y), -1)
        # h(x) = v_across − model = 0; the innovation is 0 − h(x̂)
        slope = torch.stack((yaw + 2 * slip * vx * w_z, pitch), -1).unsqueeze(-1)
        J, of_attitude = (x[:, 1:] - slope * x[:, :1] for x in (C_bn, turned))
        # δω = −ζ, δf = −ε: the model's rates and forces are too large by the sensors' remaining errors
        lateral = [zero] * 5 + [axle + slip * vx * vx]
        vertical = [gradient * vx, zero, zero, zero, -axle, zero]
        if self.states.structure:
            lateral += [-vx, zero, -w_z, -vx * vx * w_z, zero]
            vertical += [zero, -vx, w_y, zero, -vx * force]
        known = torch.stack(lateral + vertical, -1).unflatten(-1, (2, -1))
        sensors, car = known.split((6, known.shape[-1] - 6), -1)
        position, matrices = J.new_zeros(len(J), 2, 3), J.new_zeros(len(J), 2, self.states.navigation - STATES)
        others = J.new_zeros(len(J), 2, len(self.states.others))
        H = torch.cat((position, J, of_attitude, sensors, matrices, car, others), -1)
        return model - v_b[:, 1:], H, vx.abs() > SLOWEST

    def _measure_standstill(self, epoch: Epoch) -> tuple[Float[Tensor, "B 6"], Float[Tensor, "B 6 n"]]:
        """Innovation and H of a standstill: zero velocity, and the Earth rate in body axes."""
        state = epoch.window.end
        earth_b = torch.bmm(state.C_nb.mT, epoch.frame.earth_rate_n.unsqueeze(-1)).squeeze(-1)
        z = torch.cat((-state.v_n, epoch.corrected[..., 3:].mean(1) - earth_b), -1)
        return z, _standstill_matrix(self.states.count, z.dtype, z.device).expand(len(z), -1, -1)


def _is_near_fix(epoch: Epoch, P: Float[Tensor, "B n n"]) -> Bool[Tensor, " B"]:
    """Whether the window has a fix whose horizontal position is within 3σ of the filter's."""
    S = P.diagonal(dim1=-2, dim2=-1)[:, POSITION] + epoch.fix.std[:, POSITION].square()
    near = epoch.z[:, POSITION].square() < OUTLIER**2 * S
    return (epoch.used[:, POSITION] & near)[:, :2].all(-1)


def _widen_outliers(
    variance: Float[Tensor, "B n"], z: Float[Tensor, "B n"], of_state: Float[Tensor, "B n"]
) -> Float[Tensor, "B n"]:
    """Variance of rows, larger where an innovation z is beyond ``OUTLIER`` σ: a skid, or a car that still sways."""
    return variance * (z.square() / (OUTLIER**2 * (of_state + variance))).clamp_min(1.0)


@lru_cache
@torch.inference_mode(False)
def _standstill_matrix(states: int, dtype: torch.dtype, device: torch.device) -> Float[Tensor, "6 n"]:
    """H of velocity and of the gyroscopes' rate."""
    eye = torch.eye(states, dtype=dtype, device=device)
    return torch.cat((eye[VELOCITY], eye[GYRO]))
