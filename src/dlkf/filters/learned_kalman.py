"""The DLKF beside a Kalman filter: a network that adds to its gain and to its IMU error (``model=dlkf_kalman``).

The heads are the paper's, a 9 × 6 gain and an IMU error (R048), but what they give is added to those of a classical
filter, whose covariance and normalised innovations the network sees:

    dx = K z + ΔK z,    ê = ê_K + Δê

With weights of zero it is that filter. K is optimal for the covariance in force, so with a further ΔK on the fix that
becomes, exactly,

    P⁺ = P⁺_K + E S Eᵀ,    E = (ΔK; 0),    S = H P⁻ Hᵀ + R

(Joseph's form is quadratic in the gain with its least at K), and a wrong ΔK shows in the next gains. Δê is no state: P
does not know it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from dlkf.base.errors import InputError
from dlkf.base.settings import settings_from
from dlkf.data.drive import Batch
from dlkf.filters.build import build_causal, has_prior, is_filter, refuse_smoothed
from dlkf.filters.integration import Correction, Covariances, Epoch
from dlkf.filters.learned import LearnedConfig, LearnedFilter, LearnedMemory
from dlkf.filters.matching import normalised_innovation, variance_along
from dlkf.filters.model_based import KalmanMemory, Mbkf
from dlkf.filters.tuning import Prior, Tuning
from dlkf.navigation.calibration import ImuError
from dlkf.navigation.imu_errors import ImuSpec, imu_spec
from dlkf.navigation.state import IMU, PVA, STATES
from dlkf.networks.features import level_rotation

# usual 1σ of position [m], velocity [m/s], attitude [rad], accelerometer [m/s²] and gyroscope bias [rad/s]
USUAL_STD = (0.5,) * 3 + (0.1,) * 3 + (0.01,) * 3 + (0.1,) * 3 + (0.005,) * 3
FURTHER = len(USUAL_STD) + 6  # inputs of the network: logarithms of the 1σ, normalised innovations


@dataclass(frozen=True)
class LearnedKalmanConfig(LearnedConfig):
    """As :class:`LearnedConfig`, and the Kalman filter ``base``.

    A training takes its ``imu``, its ``tuning`` and, for a base with ``_prior``, its ``prior`` (``mean``, ``std``) from
    the baseline of that name.
    """

    outage_mode: Literal["hold", "run"] = "run"
    base: str = "mbkf33_prior"
    imu: Mapping[str, Any] = field(default_factory=dict)
    tuning: Mapping[str, float] = field(default_factory=dict)
    prior: Mapping[str, Any] = field(default_factory=dict)
    kind: Literal["dlkf_kalman"] = "dlkf_kalman"  # type: ignore[assignment]

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.base == "ins" or not is_filter(self.base):
            raise InputError(f"model.base={self.base} is no Kalman filter; take mbkf33_prior, mbkf21_car or the like")
        refuse_smoothed(self.base, "a network does not")
        if self.outage_mode != "run":
            raise InputError("model.outage_mode must be run: beside a Kalman filter the network runs every epoch")
        object.__setattr__(self, "network", replace(self.network, flags=self.network.flags + FURTHER))

    def with_base(self, imu: ImuSpec, tuning: Tuning, prior: Prior | None) -> LearnedKalmanConfig:
        """With a Kalman filter's numbers."""
        known = {} if prior is None else asdict(prior)
        return replace(self, imu=asdict(imu), tuning=tuning.factors(), prior=known)

    def kalman(self) -> Mbkf:
        """The Kalman filter; InputError for a base that is none."""
        if not self.imu:
            raise InputError(f"model.base={self.base} has no IMU preset; dlkf train sets it")
        prior = settings_from(Prior, self.prior, "model.prior") if has_prior(self.base) else None
        tuning = settings_from(Tuning, self.tuning, "model.tuning")
        kalman = build_causal(self.base, imu_spec(self.imu), "a network does not", tuning=tuning, prior=prior)
        assert isinstance(kalman, Mbkf)
        return replace(kalman, cut_transition=True)


class LearnedKalmanMemory(NamedTuple):
    """What it carries from epoch to epoch."""

    network: LearnedMemory
    kalman: KalmanMemory
    estimate: ImuError  # of the Kalman filter, without what the network adds


class LearnedKalmanFilter(LearnedFilter):
    """Kalman filter whose gain and IMU error a CNN-LSTM corrects, trained end to end."""

    config: LearnedKalmanConfig

    def __init__(self, config: LearnedKalmanConfig) -> None:
        super().__init__(replace(config, initial_gain=0.0))

    @cached_property
    def kalman(self) -> Mbkf:
        """The Kalman filter; a training is checked before its noise is known."""
        return self.config.kalman()

    def begin(self, batch: Batch) -> tuple[LearnedKalmanMemory, ImuError]:  # type: ignore[override]
        """Of the Kalman filter; the network has seen nothing yet."""
        network, _ = super().begin(batch)
        kalman, error = self.kalman.begin(batch)
        return LearnedKalmanMemory(network, kalman, error), error

    def step(self, memory: LearnedKalmanMemory, epoch: Epoch) -> tuple[LearnedKalmanMemory, Correction]:  # type: ignore[override]
        """The Kalman filter's update with what the network adds."""
        span = epoch.span_s
        kalman, offered = self.kalman.predict_fix(memory.kalman, epoch)
        before, epoch = self.kalman.screen_fix(kalman, offered)
        fixed = epoch.used.any(-1)
        network = memory.network
        network = network._replace(elapsed=network.elapsed + span, since_fix=network.since_fix + span)
        with torch.no_grad():
            further = self._kalman_inputs(before.P, epoch)
        gain, added, recurrent = self._run(network, epoch, torch.arange(len(fixed)), True, fixed, further)
        kalman, correction = self.kalman.update(before, epoch._replace(error=memory.estimate))
        rejected = self.kalman.find_rejected(before, offered, epoch, correction)
        estimate = ImuError.of(correction.imu_error)
        part = self._limit_turn(torch.bmm(gain, epoch.z.unsqueeze(-1)).squeeze(-1))
        dx = correction.dx + part
        covariances = correction.covariances
        assert covariances is not None
        with torch.no_grad():
            P = _add_gain(kalman.P.detach(), gain * epoch.used.unsqueeze(1), covariances)
        network = self._remember(network, epoch, dx, fixed, torch.ones_like(fixed), recurrent)
        total = None if correction.gain is None else correction.gain + gain
        std = P.diagonal(dim1=-2, dim2=-1)[:, :STATES].clamp_min(0).sqrt()
        whole = torch.cat((dx, covariances.dx[:, PVA.stop :]), -1)
        return LearnedKalmanMemory(network, kalman._replace(P=P), estimate), correction._replace(
            dx=dx, imu_error=_add_errors(estimate, added), std=std, gain=total, innovation=offered.z,
            rejected=rejected, covariances=covariances._replace(updated=P, dx=whole),
        )  # fmt: skip

    def _kalman_inputs(self, P: Float[Tensor, "B n n"], epoch: Epoch) -> Float[Tensor, "B K"]:
        """Inputs that a Kalman filter has: 1σ over usual ones, as logarithms, and innovations over their 1σ before the
        last samples were propagated; heading axes."""
        C_hn = level_rotation(epoch.window.end.C_nb, "heading")
        variance = variance_along(P[:, PVA, PVA], C_hn.mT)
        of_imu = P.diagonal(dim1=-2, dim2=-1)[:, IMU]
        usual = P.new_tensor(USUAL_STD)
        spread = torch.log(torch.cat((variance, of_imu), -1).clamp_min(1e-18).sqrt() / usual) / 2
        return torch.cat((spread, torch.asinh(normalised_innovation(P, epoch.z, epoch.fix.std, C_hn, 1e-6))), -1)


def _add_gain(P: Float[Tensor, "B n n"], gain: Float[Tensor, "B 9 6"], c: Covariances) -> Float[Tensor, "B n n"]:
    """Covariance after an optimal update with a further gain on the fix: P + E S Eᵀ."""
    P = P.clone()
    P[:, PVA, PVA] += gain @ c.innovation @ gain.mT
    return P


def _add_errors(a: ImuError, b: ImuError) -> ImuError:
    """Both errors together; a matrix of scale factors alone becomes a full one where the other is."""
    of_a, of_b = a.matrix, b.matrix
    if of_a is not None and of_b is not None and of_a.ndim == 2:
        of_a = torch.diag_embed(of_a.unflatten(-1, (2, 3)))
    matrix = of_b if of_a is None else of_a if of_b is None else of_a + of_b
    return ImuError(a.bias + b.bias, matrix, a.g_sensitivity)
