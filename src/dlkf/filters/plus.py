"""``plus``: a Kalman filter that estimates the white noise of its IMU while it runs.

States, strapdown, sources and Riccati recursion are those of a classical filter (``base``). Two factors act on its
white noise. The level of accelerometers and of gyroscopes is slow: virtual outages of 10 to 30 s in the recent past
show it (:mod:`dlkf.filters.virtual_outages`), and it holds through an outage. A recurrent network adds what is fast, a
factor for each gyroscope every epoch, in outages too; it sees the samples, the filter's covariance and how well its
innovations and corrections fit (:mod:`dlkf.filters.matching`). As far as fixes show, their errors are larger than
claimed (:mod:`dlkf.filters.fix_noise`), or those of positions smaller, or wander (:mod:`dlkf.filters.position_errors`).
The walk of a bias grows where its corrections keep their sign (:mod:`dlkf.filters.bias_steps`).
The noise of the vehicle constraints is what innovations show (:mod:`dlkf.filters.constraint_noise`), and the prior of
the vertical gyroscope's scale factor has heavy tails (:mod:`dlkf.filters.heavy_tails`). Before the first fix it is
``base`` to the bit; with fixes and constraints as claimed and weights of zero ``base`` with this prior until the first
virtual outage was scored or corrections of a bias have kept their sign.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from dlkf.base.errors import InputError
from dlkf.base.settings import settings_from
from dlkf.data.drive import Batch
from dlkf.filters.aids.attach import add_sources
from dlkf.filters.aids.wheel_speed import WheelSpeed
from dlkf.filters.bias_steps import SPACING_S, SignTest, normalise_corrections
from dlkf.filters.branches import may_branch
from dlkf.filters.build import build_filter
from dlkf.filters.constraints import CarConstraints
from dlkf.filters.fix_noise import FixNoise
from dlkf.filters.integration import Correction, Epoch
from dlkf.filters.matching import (
    AXIS_FEATURES,
    LOG_FEATURES,
    Matching,
    normalised_innovation,
    ratio_by_axis,
    variance_along,
)
from dlkf.filters.model_based import KalmanMemory as KalmanMemory
from dlkf.filters.model_based import Mbkf
from dlkf.filters.noise_factors import NoiseFactors
from dlkf.filters.position_errors import PositionErrors
from dlkf.filters.slow_errors import NAMES, ErrorChange, SlowErrors
from dlkf.filters.tuning import Tuning
from dlkf.filters.virtual_outages import VirtualOutage
from dlkf.navigation.calibration import ImuError
from dlkf.navigation.error_model import source_scale
from dlkf.navigation.imu_errors import ImuSpec, imu_spec
from dlkf.navigation.state import IMU, PVA
from dlkf.networks.features import level_rotation
from dlkf.networks.plus import (
    LEAST_RATE_HZ,
    WINDOW_FEATURES,
    PlusNetwork,
    PlusNetworkConfig,
    band_level,
    window_features,
)

ANY_MEMS: Mapping[str, Any] = {  # what is known of an IMU of which nothing is known
    "name": "any MEMS",
    "accel": {
        "noise_density": 9.80665e-4, "turn_on_bias": 0.2, "instability": 1e-3, "correlation_time": 3600.0,
        "scale_factor": 5e-3, "misalignment": 5.236e-3,
    },
    "gyro": {
        "noise_density": 6.98132e-5, "turn_on_bias": 0.015, "instability": 9.69627e-5, "correlation_time": 3600.0,
        "scale_factor": 5e-3, "misalignment": 5.236e-3,
    },
}  # fmt: skip
# chosen on simulated and real drives (docs/results/plus.md): where the network's factors begin
START_TUNING: Mapping[str, float] = {
    "accel_noise": 25.0, "gyro_noise": 4.0, "accel_walk": 5.0, "gyro_walk": 5.0,
    "position_std": 2.0, "velocity_std": 2.0, "lateral_std": 0.07, "vertical_std": 0.1,
}  # fmt: skip
KNOWN_BY_PRESET = ("turn_on_bias", "scale_factor", "misalignment")
OLDEST = 600.0  # s, fixes: times and counts are given up to here


@dataclass(frozen=True)
class PlusConfig:
    """A ``plus`` filter: its classical filter and the size of its network."""

    kind: Literal["plus"] = "plus"
    base: str = "mbkf33_car_gated+vibration_speed+receiver"
    network: PlusNetworkConfig = field(default_factory=PlusNetworkConfig)
    tuning: Mapping[str, float] = field(default_factory=lambda: dict(START_TUNING))
    imu: Mapping[str, Any] = field(default_factory=lambda: dict(ANY_MEMS))

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> PlusConfig:
        """From plain values; InputError for unknown keys or values that do not fit."""
        return settings_from(cls, {k: v for k, v in values.items() if v is not None}, "model")

    def as_dict(self) -> dict[str, Any]:
        """Plain values for a file."""
        values = asdict(self) | {"network": {"hidden": self.network.hidden}}
        return {**values, "tuning": dict(self.tuning), "imu": _to_plain(self.imu)}


class PlusMemory(NamedTuple):
    """What the filter carries from epoch to epoch; nothing of it but the Kalman filter's part has axes in n."""

    kalman: KalmanMemory
    hidden: Tensor  # (B, h)
    elapsed: Tensor  # (B,) s since the start
    since_fix: Tensor  # (B,) s
    matching: Matching  # what the fixes say of its noise
    fix_speed: Tensor  # (B,) m/s forward at the last fix
    outage: VirtualOutage  # how much white noise there is
    errors: PositionErrors  # of the fixes
    fix_noise: FixNoise  # of those that claim too little
    steps: SignTest  # whether a bias has changed


class PlusFilter(nn.Module):
    """Estimator round a classical one: levels by virtual outages, factors of a network."""

    card: dict[str, Any]  # what the weights were made of; those of a file have it
    least_rate_hz = LEAST_RATE_HZ  # of samples that have all bands of frequency that it sees

    def __init__(self, config: PlusConfig) -> None:
        super().__init__()
        self.config = config
        kalman = build_filter(config.base, imu_spec(config.imu), tuning=settings_from(Tuning, config.tuning, "tuning"))
        if not isinstance(kalman, Mbkf):
            raise InputError(
                f"model.base={config.base} is no Kalman filter that plus can stand on; take {PlusConfig.base}"
            )
        sources = tuple(replace(s, adapts_noise=True) if isinstance(s, CarConstraints) else s for s in kalman.sources)
        kalman = replace(kalman, sources=sources, cut_transition=True, heavy_tails=True)
        self.kalman = add_sources(kalman, [SlowErrors])
        count = self.kalman.states.base.count
        now = 3 + 3 + 3 + 2 + 6
        features = WINDOW_FEATURES + count + (count - 9) + 2 + 4 + 6 + LOG_FEATURES + 4 + now
        self.network = PlusNetwork(PlusNetworkConfig(config.network.hidden, features, 2 + AXIS_FEATURES), now)

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

    def with_imu(self, imu: ImuSpec) -> PlusFilter:
        """The same weights for an IMU whose 1σ of turn-on biases, scale factors and misalignments are known.

        Its white noise and the walks of its biases stay those of an unknown IMU: they are found, and data sheets do not
        know a car's vibration.
        """
        known = {}
        for name, sensor in (("accel", imu.accel), ("gyro", imu.gyro)):
            known[name] = {**self.config.imu[name], **{k: getattr(sensor, k) for k in KNOWN_BY_PRESET}}
        same = PlusFilter(replace(self.config, imu={"name": imu.name, **known}))
        same.load_state_dict(self.state_dict())
        same.card = getattr(self, "card", {})
        return same.train(self.training)

    def heads(self) -> Iterator[nn.Parameter]:
        """Weights of the output layer, but for that of the axes, which has to find what is small."""
        yield from self.network.noise.parameters()

    def begin(self, batch: Batch) -> tuple[PlusMemory, Tensor | ImuError]:
        """Of the Kalman filter, and nothing seen yet."""
        kalman, error = self.kalman.begin(batch)
        zeros, B = batch.imu.new_zeros, batch.size[0]
        zero = zeros(B)
        outage = VirtualOutage.begin(kalman.P)
        matching, errors = Matching.begin(batch.imu, B), PositionErrors.begin(batch.imu, B)
        fix_noise, steps = FixNoise.begin(batch.imu, B, batch.start_noise), SignTest.begin(batch.imu, B, 6)
        network = self.network.start(B)
        return PlusMemory(kalman, network, zero, zero, matching, zero, outage, errors, fix_noise, steps), error

    def step(self, memory: PlusMemory, epoch: Epoch) -> tuple[PlusMemory, Correction]:
        """One update interval: the fix is screened, the noise adapted, the Kalman filter run, and the fix teaches."""
        interval = memory.since_fix + epoch.span_s
        memory, change = self._propagate_slow_errors(memory, epoch)
        kalman, claimed = self.kalman.predict_fix(memory.kalman, epoch)
        kalman = self._widen_walks(kalman, claimed)
        offered = memory.fix_noise.inflate_fix(claimed)
        kalman, epoch = self.kalman.screen_fix(kalman, offered)
        memory, of_network, noise = self._adapt_noise(memory._replace(kalman=kalman), epoch, offered)
        kalman, correction = self.kalman.update(memory.kalman, epoch._replace(noise=noise))
        rejected = self.kalman.find_rejected(memory.kalman, offered._replace(noise=noise), epoch, correction)
        with torch.no_grad():
            if (c := correction.covariances) is not None:
                slow = self._slow.start
                correction = correction._replace(covariances=c._replace(Phi=change.add_decay(c.Phi, slow)))
            memory = self._learn(memory, epoch, claimed, offered, correction, of_network, interval)
        if correction.std is not None:
            correction = correction._replace(std=memory.errors.add_slow_std(correction.std))
        return memory._replace(kalman=kalman), correction._replace(innovation=claimed.z, rejected=rejected)

    @property
    def _slow(self) -> slice:
        """The states of slow position errors."""
        start = self.states.of(NAMES[0]).start
        return slice(start, start + len(NAMES))

    def _slow_estimates(self, kalman: KalmanMemory) -> Float[Tensor, "B 3"]:
        assert kalman.parameters is not None
        first = self._slow.start - self.states.of_others.start
        return kalman.parameters[:, first:][:, : len(NAMES)]

    def _propagate_slow_errors(self, memory: PlusMemory, epoch: Epoch) -> tuple[PlusMemory, ErrorChange]:
        """Slow errors of positions over the update interval, in the filter and in the virtual outage beside it."""
        errors, change = memory.errors.advance(epoch, memory.since_fix)
        kalman, outage, slow = memory.kalman, memory.outage, self._slow.start
        assert kalman.parameters is not None
        parameters = change.shrink(kalman.parameters, slow - self.states.of_others.start)
        kalman = kalman._replace(P=change.propagate(kalman.P, slow), parameters=parameters)
        outage = outage._replace(
            P=change.propagate(outage.P, slow, follows=False), drift=change.shrink(outage.drift, slow)
        )
        return memory._replace(kalman=kalman, outage=outage, errors=errors), change

    def _widen_walks(self, kalman: KalmanMemory, claimed: Epoch) -> KalmanMemory:
        """The Kalman filter with more uncertainty of the mounting, where the constraints show that it turns."""
        for source, of_source in zip(self.kalman.sources, kalman.sources, strict=True):
            if isinstance(source, CarConstraints | WheelSpeed):
                kalman = kalman._replace(P=source.widen_walks(kalman.P, of_source, claimed))
        return kalman

    def _adapt_noise(
        self, memory: PlusMemory, epoch: Epoch, offered: Epoch
    ) -> tuple[PlusMemory, Float[Tensor, "B 4 3"], NoiseFactors]:
        """Memory with this fix's innovations, factors of the network alone, and those in force: network and levels."""
        fixed = epoch.used.any(-1)
        with torch.no_grad():
            normalised = self._normalise_innovation(memory, epoch)
            memory = memory._replace(
                elapsed=memory.elapsed + epoch.span_s,
                since_fix=torch.where(fixed, 0.0, memory.since_fix + epoch.span_s),
                matching=memory.matching.update(normalised, epoch.used),
            )
            bands = window_features(epoch.corrected, epoch.dt)
            levels, matched = band_level(bands), memory.matching.logarithms()
            features, now = self._features(memory, epoch, normalised, bands, levels, matched)
            axes = torch.cat((levels.unflatten(-1, (2, 3)).mT, ratio_by_axis(matched)), -1)
        dtype = self.network.inward.weight.dtype
        gyro_noise, hidden = self.network(features.to(dtype), now.to(dtype), axes.to(dtype), memory.hidden)
        gyro_noise = gyro_noise.to(epoch.z.dtype)
        seen = memory.since_fix < memory.elapsed  # before the first fix there is nothing to adapt to
        if not (may_branch(seen) and bool(seen.all())):
            gyro_noise = torch.where(seen.unsqueeze(-1), gyro_noise, 1.0)
        (levels, weight), same = memory.outage.estimates(), torch.ones_like(gyro_noise)
        walks = memory.steps.walk_factors.unflatten(-1, (2, 3))
        of_network, in_force = (
            torch.cat((torch.stack((same, x), 1), walks), 1) for x in (gyro_noise, gyro_noise ** weight.unsqueeze(-1))
        )
        process = in_force * torch.cat((levels, levels.clamp_min(1.0)), -1).unsqueeze(-1)
        of_fix = memory.errors.noise(offered, memory.kalman.fix.scale[0, 0, 0])
        return memory._replace(hidden=hidden), of_network, NoiseFactors(process, of_fix, kept=memory.fix_noise.kept)

    def _learn(
        self, memory: PlusMemory, epoch: Epoch, claimed: Epoch, offered: Epoch, correction: Correction,
        of_network: Float[Tensor, "B 4 3"], interval: Float[Tensor, " B"],
    ) -> PlusMemory:  # fmt: skip
        """Memory, but for the Kalman filter's, with what the fix and the corrections of this update show."""
        fixed, end = epoch.used.any(-1), epoch.window.end
        after = end.correct(correction.dx)
        forward = (after.C_nb[:, :, 0] * after.v_n).sum(-1)
        memory = memory._replace(fix_speed=torch.where(fixed, forward, memory.fix_speed))
        if (c := correction.covariances) is None:
            return memory
        scale = source_scale(of_network, epoch.start.C_nb)
        outage = memory.outage.update(epoch, c, memory.kalman.windows, scale)
        offering = c._replace(H=self.kalman.fix.matrix(claimed))  # before the gate
        estimated = self._slow_estimates(memory.kalman)
        return memory._replace(
            outage=outage, errors=memory.errors.update(offered, offering, estimated, c.dx[:, self._slow]),
            fix_noise=memory.fix_noise.update(claimed, offering, outage),
            matching=memory.matching.update_ratios(c.dx, c.predicted, c.updated, end.C_nb, fixed),
            steps=memory.steps.update(normalise_corrections(c), fixed, (interval / SPACING_S).clamp_max(1.0)),
        )  # fmt: skip

    def _normalise_innovation(self, memory: PlusMemory, epoch: Epoch) -> Float[Tensor, "B 6"]:
        """Innovations over their 1σ as the filter of the last epoch has it, in heading axes; zero without a fix."""
        C_hn = level_rotation(epoch.window.end.C_nb, "heading")
        return normalised_innovation(memory.kalman.P, epoch.z, epoch.fix.std, C_hn, 1e-4)

    def _features(
        self, memory: PlusMemory, epoch: Epoch, normalised: Float[Tensor, "B 6"], bands: Float[Tensor, "B K"],
        levels: Float[Tensor, "B 6"], matched: Float[Tensor, "B L"],
    ) -> tuple[Float[Tensor, "B F"], Float[Tensor, "B N"]]:  # fmt: skip
        """What the network sees, each of order 1; the second part goes to the noise's heads directly as well."""
        P, C_nb, states = memory.kalman.P, epoch.window.end.C_nb, self.kalman.states
        fixed = epoch.used.any(-1, keepdim=True).to(P.dtype)
        variance = torch.cat(
            (variance_along(P[:, PVA, PVA], C_nb), P.diagonal(dim1=-2, dim2=-1)[:, IMU.start : states.base.count]), -1
        ).clamp_min(1e-18)
        size = self._sizes(P)
        v_b = torch.bmm(C_nb.mT, epoch.window.end.v_n.unsqueeze(-1)).squeeze(-1)
        rate, force = epoch.rate_b, epoch.corrected[..., :3].mean(1)
        error, structure = epoch.error, memory.kalman.structure
        parts = (error.bias, error.elements(self.kalman.states), *(() if structure is None else (structure,)))
        known = torch.cat(parts, -1)
        fix_std = torch.log(epoch.fix.std[:, [0, 2, 3, 5]].clamp(1e-3, 1e3)) / 3 * fixed
        age = torch.log1p(torch.stack((memory.since_fix, memory.elapsed), -1).clamp_max(OLDEST)) / 3
        fixes = torch.log(4 + memory.matching.fixes.clamp_max(OLDEST)) / 3
        now = torch.cat(
            (v_b / v_b.new_tensor((10.0, 1.0, 1.0)), torch.log(variance[:, 3:6]) / 6, v_b[:, :1] * rate[:, 2:] / 3,
             force[:, 1:2] / 3, rate[:, 2:] / 0.3, fixed, age[:, :1], levels), -1,
        )  # fmt: skip
        features = torch.cat(
            (
                bands, torch.log(variance) / 4 - torch.log(size) / 2,
                torch.asinh(known / size[9:]), age, fix_std, torch.asinh(normalised),
                matched, fixed, fixed * v_b[:, :1] / 10, memory.fix_speed.unsqueeze(-1) / 10, fixes.unsqueeze(-1), now,
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


def _to_plain(values: Mapping[str, Any]) -> dict[str, Any]:
    return {k: _to_plain(v) if isinstance(v, Mapping) else v for k, v in values.items()}
