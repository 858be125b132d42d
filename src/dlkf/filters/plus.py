"""``plus``: the analytic Kalman filter whose noise and pseudo-measurements a recurrent network sets every epoch.

States, strapdown and Riccati recursion are those of a classical filter (``base``); the network says how far to trust
what goes into them, in outages too: factors on the process noise of each axis, on GNSS standard deviations, on the
constraints' standard deviations, velocities across the car beside those of its model, and a forward speed that each
drive calibrates while GNSS is there (:mod:`dlkf.filters.car_speed`). It sees the samples, what the filter believes and
how its innovations and that speed fit. With weights of zero, and before the first fix, it is ``base`` to the bit.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from dlkf.data.drive import Batch
from dlkf.errors import InputError
from dlkf.filters.advice import ABSENT, Advice
from dlkf.filters.advised_speed import AdvisedSpeed
from dlkf.filters.branches import may_branch
from dlkf.filters.build import build_filter
from dlkf.filters.car_speed import Calibration, CarSpeed, Foretold
from dlkf.filters.integration import Correction, Epoch
from dlkf.filters.matching import AXIS_FEATURES, LOG_FEATURES, Matching, by_axis, variance_along
from dlkf.filters.model_based import Mbkf
from dlkf.filters.model_based import Memory as KalmanMemory
from dlkf.filters.tuning import Tuning
from dlkf.navigation.calibration import ImuError
from dlkf.navigation.imu_errors import ImuSpec, imu_spec
from dlkf.navigation.state import IMU, PV, PVA, ErrorStates
from dlkf.networks.features import level_rotation
from dlkf.networks.plus import (
    LEAST_RATE_HZ,
    WINDOW_FEATURES,
    Heads,
    PlusNetwork,
    PlusNetworkConfig,
    loudness,
    window_features,
)
from dlkf.settings import settings_from

PARTS = ("process", "fix", "across", "offset", "speed", "residual")
ANY_MEMS: Mapping[str, Any] = {  # what is known of an IMU of which nothing is known
    "name": "any MEMS",
    "accel": {
        "noise_density": 9.80665e-4, "turn_on_bias": 0.1, "instability": 1e-3, "correlation_time": 3600.0,
        "scale_factor": 5e-3, "misalignment": 5.236e-3,
    },
    "gyro": {
        "noise_density": 6.98132e-5, "turn_on_bias": 5.236e-3, "instability": 9.69627e-5, "correlation_time": 3600.0,
        "scale_factor": 5e-3, "misalignment": 5.236e-3,
    },
}  # fmt: skip
# by python -m dlkf.tune objective=log on simulated cars; where training begins
START_TUNING: Mapping[str, float] = {
    "accel_noise": 30.0, "gyro_noise": 3.0, "accel_walk": 100.0, "gyro_walk": 10.0,
    "position_std": 2.0, "velocity_std": 2.0, "lateral_std": 0.1,
}  # fmt: skip
# m/s: a car whose sound tells its speed less well has next to nothing to say, for such errors last through an outage;
# chosen between 0.7 and 2 on validation drives and with real ones in view (docs/results/plus.md)
TELLING_STD = 1.0
SILENT_SHARE = 0.3  # of the training pieces run without the speed, so that the rest learns to do without it
OLDEST = 600.0  # s: times are told up to here


@dataclass(frozen=True)
class PlusConfig:
    """A ``plus`` filter: its classical filter, which parts of the network are in force, what it was trained on."""

    kind: Literal["plus"] = "plus"
    base: str = "mbkf33_car"
    parts: tuple[str, ...] = PARTS[:5]
    network: PlusNetworkConfig = field(default_factory=PlusNetworkConfig)
    tuning: Mapping[str, float] = field(default_factory=lambda: dict(START_TUNING))
    imu: Mapping[str, Any] = field(default_factory=lambda: dict(ANY_MEMS))

    def __post_init__(self) -> None:
        if unknown := sorted(set(self.parts) - set(PARTS)):
            raise InputError(f"model.parts: unknown part {unknown[0]!r}; known: {', '.join(PARTS)}")

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> PlusConfig:
        """From plain values; InputError for unknown keys or values that do not fit."""
        return settings_from(cls, {k: v for k, v in values.items() if v is not None}, "model")

    def plain(self) -> dict[str, Any]:
        """Plain values for a file."""
        values = asdict(self) | {"parts": list(self.parts), "network": {"hidden": self.network.hidden}}
        return {**values, "tuning": dict(self.tuning), "imu": _plain(self.imu)}


class Memory(NamedTuple):
    """What the filter carries from epoch to epoch; nothing of it but the Kalman filter's part has axes in n."""

    kalman: KalmanMemory
    hidden: Tensor  # (B, h)
    elapsed: Tensor  # (B,) s since the start
    since_fix: Tensor  # (B,) s
    matching: Matching  # what the fixes say of its noise
    fix_speed: Tensor  # (B,) m/s forward at the last fix
    car: Calibration  # what the drive has told of the car's speed
    residual: Tensor  # (B, 6) part of the IMU error that the network added
    silent: Tensor  # (B,) bool: pieces in which training withholds the speed
    seen: Heads | None = None  # of the last epoch, for training and pictures


class PlusFilter(nn.Module):
    """Estimator round a classical one."""

    card: dict[str, Any]  # what the weights were made of; those of a file have it
    least_rate_hz = LEAST_RATE_HZ  # of the samples that it hears the car through

    def __init__(self, config: PlusConfig) -> None:
        super().__init__()
        self.config = config
        kalman = build_filter(config.base, imu_spec(config.imu), tuning=settings_from(Tuning, config.tuning, "tuning"))
        if not isinstance(kalman, Mbkf):
            raise InputError(f"model.base={config.base} is no Kalman filter that plus can stand on; take mbkf33_car")
        speed = (AdvisedSpeed(kalman.states),) if "speed" in config.parts else ()
        self.kalman = replace(kalman, sources=(*kalman.sources, *speed), cut_transition=True)
        count = self.kalman.states.count
        now = 3 + 3 + 3 + 2 + 6
        features = WINDOW_FEATURES + count + (count - 9) + 2 + 4 + 6 + LOG_FEATURES + 3 + 5 + now
        self.network = PlusNetwork(PlusNetworkConfig(config.network.hidden, features, 2 + AXIS_FEATURES), now)
        self.car_speed = CarSpeed(WINDOW_FEATURES)
        self.parts = frozenset(config.parts)

    @property
    def states(self):
        """The error states of the Kalman filter."""
        return self.kalman.states

    @property
    def tuning(self) -> Tuning:
        """Where its noise begins."""
        return self.kalman.tuning

    @property
    def imu(self) -> ImuSpec:
        """What it takes an unknown IMU for."""
        return self.kalman.imu

    def heads(self) -> Iterator[nn.Parameter]:
        """Weights of the output layers, but for that of the axes, which has to find what is small."""
        yield from self.network.noise.parameters()
        yield from self.network.trust.parameters()

    def begin(self, batch: Batch) -> tuple[Memory, Tensor | ImuError]:
        """Of the Kalman filter, and nothing seen yet."""
        kalman, error = self.kalman.begin(batch)
        zeros, B = batch.imu.new_zeros, batch.size[0]
        memory = Memory(
            kalman, self.network.start(B), zeros(B), zeros(B), Matching.begin(batch.imu, B), zeros(B),
            self.car_speed.begin(B), zeros(B, 6),
            torch.rand(B, device=batch.imu.device) < SILENT_SHARE if self.training else zeros(B) > 0,
        )  # fmt: skip
        return memory, error

    def step(self, memory: Memory, epoch: Epoch) -> tuple[Memory, Correction]:
        """Network, then the Kalman filter with its advice."""
        span = epoch.dt * epoch.imu.shape[1]
        fixed = epoch.used.any(-1)
        with torch.no_grad():
            forward = (epoch.window.end.C_nb[:, :, 0] * epoch.window.end.v_n).sum(-1)
            normalised = self._normalised(memory, epoch)
            memory = memory._replace(
                elapsed=memory.elapsed + span,
                since_fix=torch.where(fixed, 0.0, memory.since_fix + span),
                matching=memory.matching.innovated(normalised, epoch.used),
            )
            heard = window_features(epoch.corrected, epoch.dt)
        dtype = self.network.inward.weight.dtype
        foretold = self.car_speed(heard.to(dtype), memory.car)
        with torch.no_grad():
            loud, matched = loudness(heard), memory.matching.logarithms()
            features, now = self._features(memory, epoch, normalised, forward, heard, loud, matched, foretold)
            axes = torch.cat((loud.unflatten(-1, (2, 3)).mT, by_axis(matched)), -1)
        heads, hidden = self.network(features.to(dtype), now.to(dtype), axes.to(dtype), memory.hidden)
        seen = memory.since_fix < memory.elapsed  # before the first fix there is nothing to adapt to
        heads = Heads(*(x.to(epoch.z.dtype) for x in heads))
        if not (may_branch(seen) and bool(seen.all())):
            heads = heads.where(seen)
        speed = torch.stack((foretold.speed, foretold.std), -1).to(epoch.z.dtype)
        advice = self._advice(heads, speed, memory.silent | ~seen)
        kalman, correction = self.kalman.step(memory.kalman, epoch._replace(advice=advice))
        if "speed" in self.parts:
            correction = correction._replace(speed=speed)
        residual = memory.residual
        if "residual" in self.parts:
            error = correction.imu_error
            assert isinstance(error, ImuError)
            correction = correction._replace(imu_error=error._replace(bias=error.bias + heads.residual - residual))
            residual = heads.residual
        with torch.no_grad():
            after = epoch.window.end.corrected(correction.dx)
            told = (after.C_nb[:, :, 0] * after.v_n).sum(-1)
            matching = memory.matching
            if (c := correction.covariances) is not None:
                matching = matching.corrected(c.dx, c.predicted, c.updated, epoch.window.end.C_nb, fixed)
        memory = memory._replace(
            kalman=kalman, hidden=hidden, residual=residual, matching=matching, seen=heads,
            fix_speed=torch.where(fixed, told, memory.fix_speed),
            car=self.car_speed.learned(memory.car, foretold, told.to(dtype), fixed),
        )  # fmt: skip
        return memory, correction

    def _advice(self, heads: Heads, speed: Float[Tensor, "B 2"], silent: Tensor) -> Advice:
        """What of the network's answer is in force."""
        given = {name: getattr(heads, name) for name in ("process", "fix", "across", "offset") if name in self.parts}
        if "speed" in self.parts:
            mute = 1 + (speed[:, 1] / TELLING_STD).square().square()
            std = torch.where(silent, 2 * ABSENT, speed[:, 1] * heads.doubt * mute)
            given["speed"] = torch.stack((speed[:, 0], std), -1)
        return Advice(**given)

    def _normalised(self, memory: Memory, epoch: Epoch) -> Float[Tensor, "B 6"]:
        """Innovations over their 1σ as the filter of the last epoch has it, in heading axes; zero without a fix."""
        C_hn = level_rotation(epoch.window.end.C_nb, "heading")
        variance = variance_along(memory.kalman.P[:, PV, PV], C_hn.mT)
        R = torch.bmm(epoch.fix.std.square().unflatten(-1, (2, 3)), C_hn.mT.square()).flatten(1)
        z = torch.bmm(epoch.z.unflatten(-1, (2, 3)), C_hn.mT).flatten(1)
        return z / (variance + R + 1e-4).sqrt()

    def _features(
        self, memory: Memory, epoch: Epoch, normalised: Float[Tensor, "B 6"], forward: Float[Tensor, " B"],
        heard: Float[Tensor, "B K"], loud: Float[Tensor, "B 6"], matched: Float[Tensor, "B L"], foretold: Foretold,
    ) -> tuple[Float[Tensor, "B F"], Float[Tensor, "B N"]]:  # fmt: skip
        """What the network sees, each of order 1; the second part goes to the noise's heads directly as well."""
        P, C_nb = memory.kalman.P, epoch.window.end.C_nb
        fixed = epoch.used.any(-1, keepdim=True).to(P.dtype)
        variance = torch.cat(
            (variance_along(P[:, PVA, PVA], C_nb), P.diagonal(dim1=-2, dim2=-1)[:, IMU.start :]), -1
        ).clamp_min(1e-18)
        size = self._sizes(P)
        v_b = torch.bmm(C_nb.mT, epoch.window.end.v_n.unsqueeze(-1)).squeeze(-1)
        rate, force = epoch.rate_b, epoch.corrected[..., :3].mean(1)
        known = _flat(epoch.error, memory.kalman.structure, self.kalman.states)
        fix_std = torch.log(epoch.fix.std[:, [0, 2, 3, 5]].clamp(1e-3, 1e3)) / 3 * fixed
        age = torch.log1p(torch.stack((memory.since_fix, memory.elapsed), -1).clamp_max(OLDEST)) / 3
        speed, std = foretold.speed.to(P.dtype), foretold.std.to(P.dtype)
        car = torch.stack(
            (torch.log1p(memory.car.count) / 3, torch.log(memory.car.squares / memory.car.count + 0.01) / 2,
             torch.log1p(foretold.novelty), torch.asinh((speed - forward) / std), speed / 20), -1,
        )  # fmt: skip
        now = torch.cat(
            (v_b / v_b.new_tensor((10.0, 1.0, 1.0)), torch.log(variance[:, 3:6]) / 6, v_b[:, :1] * rate[:, 2:] / 3,
             force[:, 1:2] / 3, rate[:, 2:] / 0.3, fixed, age[:, :1], loud), -1,
        )  # fmt: skip
        features = torch.cat(
            (
                heard, torch.log(variance) / 4 - torch.log(size) / 2,
                torch.asinh(known / size[9:]), age, fix_std, torch.asinh(normalised),
                matched, fixed, fixed * forward.unsqueeze(-1) / 10,
                memory.fix_speed.unsqueeze(-1) / 10, car, now,
            ), -1,
        )  # fmt: skip
        return features, now

    def _sizes(self, like: Tensor) -> Float[Tensor, " n"]:
        """Typical sizes of the states, for scaling."""
        states = self.kalman.states
        matrix, car = 2 * len(states.elements), (0.05, 0.05, 1.0, 0.01, 0.005) if states.structure else ()
        return like.new_tensor(
            (1.0,) * 3 + (0.3,) * 3 + (0.02,) * 3 + (0.1,) * 3 + (0.005,) * 3 + (0.005,) * matrix + car
        )


def _flat(error: ImuError, structure: Tensor | None, states: ErrorStates) -> Float[Tensor, "B k"]:
    """Estimates of the IMU's errors and of the car's structure in the order of their states."""
    parts = [error.bias]
    if states.elements:
        if error.matrix is None:
            parts.append(error.bias.new_zeros(len(error.bias), 2 * len(states.elements)))
        elif error.matrix.ndim == 2:
            parts.append(error.matrix)
        else:
            rows, columns = (list(x) for x in zip(*states.elements))
            parts.append(error.matrix[:, :, rows, columns].flatten(1))
    return torch.cat(parts if structure is None else [*parts, structure], -1)


def _plain(values: Mapping[str, Any]) -> dict[str, Any]:
    return {k: _plain(v) if isinstance(v, Mapping) else v for k, v in values.items()}
