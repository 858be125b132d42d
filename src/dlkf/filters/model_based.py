"""Model-based estimators: pure inertial, and error-state Kalman filters (MBKF; R007–R020)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple, Protocol, TypeGuard, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from dlkf.data.drive import Batch
from dlkf.filters.adaptive import AdaptiveNoise
from dlkf.filters.branches import may_branch
from dlkf.filters.constraints import STRUCTURE_STD, STRUCTURE_WALK_STD
from dlkf.filters.g_sensitivity import add_columns, has_g_sensitivity, select_matrix
from dlkf.filters.gating import CoarseGate, Gate
from dlkf.filters.gnss_fix import FixMemory, GnssFix
from dlkf.filters.heavy_tails import HeavyTails
from dlkf.filters.integration import Correction, Covariances, Epoch, Estimator
from dlkf.filters.kalman_update import kalman_prediction, kalman_update
from dlkf.filters.receiver import (
    add_drift,
    discount_information,
    has_receiver,
    let_delay_grow,
    predict_fix,
    widen_start,
)
from dlkf.filters.slow_errors import has_slow_errors, subtract_slow_errors
from dlkf.filters.sources import Measurement, Parameter, Predicted, Source, describe_aid, predicted_variance
from dlkf.filters.tuning import Prior, Tuning
from dlkf.navigation.calibration import ImuError
from dlkf.navigation.earth import STANDARD_GRAVITY
from dlkf.navigation.error_model import PLAIN, WindowModel, mask_rows, source_scale, window_model
from dlkf.navigation.imu_errors import ImuSpec, SensorErrors
from dlkf.navigation.state import GYRO, PVA, STATES, ErrorStates

GENERIC_IMU = ImuSpec("any", SensorErrors(), SensorErrors())


class InsMemory(NamedTuple):
    """How long the INS has run by itself."""

    since_fix_s: Tensor  # (B,) s since the last position, or the start


@dataclass(frozen=True)
class Ins:
    """Inertial navigation from the last fix (R012): the raw IMU is used, and no error of it is estimated.

    A fix sets position and velocity, so that an outage begins where those of the Kalman filters begin; a velocity that
    it lacks is corrected by the innovation of the position over the time since the last one. Attitude runs
    from the start, for nothing corrects it. ``free``: nothing is set, pure strapdown from the start.
    """

    free: bool = False

    def begin(self, batch: Batch) -> tuple[InsMemory, Tensor]:
        """At the start, with the raw IMU."""
        return InsMemory(batch.imu.new_zeros(batch.size[0])), batch.imu.new_zeros(batch.size[0], 6)

    def step(self, memory: InsMemory, epoch: Epoch) -> tuple[InsMemory, Correction]:
        """The innovation itself, of the components of the fix."""
        if self.free:
            return memory, Correction(epoch.z.new_zeros(len(epoch.z), 9), epoch.error)
        p, v = epoch.z.split(3, -1)
        since = memory.since_fix_s + epoch.span_s
        v = torch.where(epoch.used[:, 3:], v, p / since.unsqueeze(-1))
        memory = InsMemory(torch.where(epoch.used[:, :3].any(-1), 0.0, since))
        return memory, Correction(torch.cat((p, v, torch.zeros_like(p)), -1), epoch.error)


class KalmanMemory(NamedTuple):
    """What a Kalman filter carries from epoch to epoch."""

    P: Tensor  # (B, n, n)
    windows: WindowModel
    fix: FixMemory
    sources: tuple[Any, ...] = ()  # one of each
    structure: Tensor | None = None  # (B, 5) of the car
    noise: AdaptiveNoise | None = None
    parameters: Tensor | None = None  # (B, k) of the sources, in the order of ``states.others``
    tails: HeavyTails | None = None  # of the prior of the vertical gyroscope's scale factor


def bias_sigma(imu: ImuSpec, states: ErrorStates) -> Float[Tensor, " 6"]:
    """1σ of the error that a constant-bias state has to carry at the start [m/s², rad/s].

    Turn-on bias and in-run part, plus what scale factor (down axis) and misalignment (level axes) make of
    gravity where the filter has no states for them: then they are biases.
    """
    a, g = imu.accel, imu.gyro
    accel, gyro = math.hypot(a.turn_on_bias, a.instability), math.hypot(g.turn_on_bias, g.instability)
    level = accel if states.matrix == "full" else math.hypot(accel, STANDARD_GRAVITY * a.misalignment)
    down = math.hypot(accel, STANDARD_GRAVITY * a.scale_factor) if states.matrix == "none" else accel
    return torch.tensor([level, level, down, gyro, gyro, gyro], dtype=torch.float64)


@dataclass(frozen=True)
class Mbkf:
    """Error-state Kalman filter with position, velocity, attitude and IMU errors (paper eqs 1–6).

    ``states`` gives 15 (the paper's), 21 or 33 of them. A ``prior`` replaces zero and the preset's spread as the
    initial knowledge of the IMU: with a training set's mean error these are ``mbkf15_prior``, ``mbkf33_prior``
    (paper.md 4.6).
    ``gated`` refuses outliers among the fixes, ``sources`` gives further measurements, ``adaptive``: Q and R follow the
    innovations.
    """

    imu: ImuSpec
    tuning: Tuning = field(default_factory=Tuning)
    states: ErrorStates = PLAIN
    prior: Prior | None = None
    gated: bool = False
    sources: tuple[Source, ...] = ()
    adaptive: bool = False
    cut_transition: bool = False  # no gradient through Φ, which makes training faster
    heavy_tails: bool = False  # of the prior of the vertical gyroscope's scale factor, where it is a state

    @cached_property
    def fix(self) -> GnssFix:
        """Where GNSS comes in; built once, since the gate's limits take longer than an epoch."""
        return GnssFix(self.tuning, self.states, Gate(self.tuning.gate) if self.gated else CoarseGate())

    @property
    def code(self) -> Mbkf:
        """The filter without its numeric settings, which its memory carries: two of one code do the same."""
        return replace(
            self, imu=GENERIC_IMU, tuning=Tuning(), prior=None,
            sources=tuple(getattr(s, "code", s) for s in self.sources),
        )  # fmt: skip

    def begin(self, batch: Batch) -> tuple[KalmanMemory, ImuError]:
        """P₀ from the start's law and the preset; the IMU error at its prior mean, both with what the start has found
        of the gyroscopes' bias."""
        like = {"dtype": batch.imu.dtype, "device": batch.imu.device}
        B, _, M = batch.size
        sigma = torch.cat((batch.start_std, self._imu_sigma().to(**like).expand(B, -1)), -1)
        structure = None
        if self.states.structure:
            known = torch.tensor(STRUCTURE_STD, **like).expand(B, -1)
            sigma, structure = torch.cat((sigma, known), -1), torch.zeros_like(known)
        parameters, walk = None, [*(STRUCTURE_WALK_STD if self.states.structure else ())]
        if self.states.others:
            of_sources = [self.parameters[name] for name in self.states.others]
            sigma = torch.cat((sigma, torch.tensor([p.std for p in of_sources], **like).expand(B, -1)), -1)
            parameters = torch.tensor([p.start for p in of_sources], **like).expand(B, -1)
            walk += [p.walk for p in of_sources]
        of_walk = torch.tensor(walk) ** 2 if walk else None
        windows = window_model(batch.frame, batch.dt, M, self.psd(), states=self.states, walk=of_walk)
        sources = tuple(source.begin(batch) for source in self.sources)
        noise = None
        if self.adaptive:
            noise = AdaptiveNoise.begin(batch.imu, self.states.count, self.tuning.forgetting)
        error = ImuError(torch.zeros(B, 6, **like))
        if self.prior is not None:
            mean = torch.tensor(self.prior.mean, **like).expand(B, -1)
            error = error.update(torch.cat((torch.zeros(B, 9, **like), mean), -1), self.states)
        if batch.start_gyro is not None:
            found, std = batch.start_gyro.split(3, -1)
            variance, bias = sigma[:, GYRO].square(), error.bias[:, 3:]
            gain = variance / (variance + std.square())
            error = error._replace(bias=torch.cat((error.bias[:, :3], bias + gain * (found - bias)), -1))
            sigma = torch.cat((sigma[:, :12], ((1 - gain) * variance).sqrt(), sigma[:, 15:]), -1)
        P, fix = torch.diag_embed(sigma**2), self.fix.begin(batch)
        if has_receiver(self.states) and batch.start_noise is not None:  # a start that was found from fixes
            P = widen_start(P, batch.start, self.states)
        tails = None
        if self.heavy_tails and self.states.elements:
            tails = HeavyTails.begin(self._imu_sigma().to(**like).expand(B, -1), self.states)
        return KalmanMemory(P, windows, fix, sources, structure, noise, parameters, tails), error

    @cached_property
    def parameters(self) -> dict[str, Parameter]:
        """What the sources estimate, by name."""
        return {name: p for source in self.sources for name, p in getattr(source, "parameters", {}).items()}

    def psd(self) -> dict[str, float]:
        """Over-bounded power spectral densities of the noise sources (R016)."""
        t, a, g = self.tuning, self.imu.accel, self.imu.gyro
        return {
            "accel_noise": t.accel_noise**2 * a.noise_psd,
            "gyro_noise": t.gyro_noise**2 * g.noise_psd,
            "accel_walk": t.accel_walk**2 * max(a.walk_psd, t.walk_floor_accel**2),
            "gyro_walk": t.gyro_walk**2 * max(g.walk_psd, t.walk_floor_gyro**2),
        }

    def step(self, memory: KalmanMemory, epoch: Epoch) -> tuple[KalmanMemory, Correction]:
        """:meth:`update` with what the gate leaves of the fix."""
        memory, epoch = self.predict_fix(memory, epoch)
        memory, screened = self.screen_fix(memory, epoch)
        after, correction = self.update(memory, screened)
        rejected = self.find_rejected(memory, epoch, screened, correction)
        return after, correction._replace(innovation=epoch.z, rejected=rejected)

    def find_rejected(
        self, memory: KalmanMemory, offered: Epoch, screened: Epoch, correction: Correction
    ) -> Float[Tensor, "B 6"] | None:
        """Variance of the innovations of an ``offered`` fix that the gate has left out, zero for others; None where it
        has left out none. ``memory`` is that before the update."""
        rejected, c = offered.used & ~screened.used, correction.covariances
        if c is None or (may_branch(offered.z) and not bool(rejected.any())):
            return None
        with torch.no_grad():
            H, R = self.fix.matrix(offered), self.fix.variance(offered, memory.fix, memory.noise)
            return torch.where(rejected, predicted_variance(c.predicted, H) + R, 0.0)

    def predict_fix(self, memory: KalmanMemory, epoch: Epoch) -> tuple[KalmanMemory, Epoch]:
        """At the end of an update interval: the delay of the fixes has grown, and the innovation is that which delay,
        antenna and slow errors give, where the filter estimates them."""
        if memory.parameters is not None and has_receiver(self.states):
            P, parameters = let_delay_grow(memory.P, memory.parameters, self.states, epoch.span_s)
            memory = memory._replace(P=P, parameters=parameters)
            epoch = predict_fix(epoch, self._name_parameters(parameters))
        if memory.parameters is not None and has_slow_errors(self.states):
            epoch = subtract_slow_errors(epoch, self._name_parameters(memory.parameters))
        return memory, epoch

    def screen_fix(self, memory: KalmanMemory, epoch: Epoch) -> tuple[KalmanMemory, Epoch]:
        """Memory and epoch after the gate of its fixes."""
        fix, epoch, P = self.fix.screen_fix(memory.fix, epoch, memory.P, memory.noise)
        return memory if fix is memory.fix else memory._replace(P=P, fix=fix), epoch

    def update(self, memory: KalmanMemory, epoch: Epoch) -> tuple[KalmanMemory, Correction]:
        """Propagate P over the window, update where there is something to learn (paper eqs 2–6, Joseph form)."""
        Phi = self._transition(memory, epoch)
        if has_g_sensitivity(self.states):
            Phi = add_columns(Phi, epoch.corrected, self.states)
        process = None if epoch.noise is None else epoch.noise.process
        Q = memory.windows.noise(Phi, None if process is None else source_scale(process, epoch.start.C_nb))
        if memory.noise is not None:
            Q = torch.where(memory.noise.settled[:, None, None], memory.noise.Q, Q)
        predicted = kalman_prediction(memory.P, Phi, Q)
        named = {} if memory.parameters is None else self._name_parameters(memory.parameters)
        prediction = Predicted(predicted, memory.structure, named)
        fix = self.fix.rows(epoch, memory.fix, memory.noise)
        parts, sources, said = [fix], [], []
        for source, of_source in zip(self.sources, memory.sources, strict=True):
            rows, of_source = source.rows(epoch, of_source, prediction)
            sources.append(of_source)
            if (rolling := getattr(of_source, "rolling", None)) is not None:
                prediction = prediction._replace(rolling=rolling, stopped=getattr(of_source, "stopped", None))
            if (table := getattr(source, "table", None)) is not None:
                said.append(describe_aid(epoch, table.name, rows, prediction.P))
            elif (describe := getattr(source, "describe", None)) is not None:
                said.append(describe(epoch, of_source, rows, prediction.P))
            if rows is not None:
                H, R = mask_rows(rows.H, rows.R, rows.used)
                parts.append(Measurement(rows.z * rows.used, H, R, rows.used))
        z, H, R = ((x[0] if len(x) == 1 else torch.cat(x, 1)) for x in ([m[k] for m in parts] for k in range(3)))
        informative = not may_branch(predicted) or any(bool(m.used.any()) for m in parts)
        P = predicted
        if informative:
            dx, K, P = kalman_update(P, H, R, z)
        else:
            dx, K, P = P.new_zeros(P.shape[:2]), P.new_zeros(*P.shape[:2], H.shape[1]), torch.lerp(P, P.mT, 0.5)
        tails = memory.tails
        if tails is not None:
            tails, P, dx = tails.update(P, dx, epoch.error, self.states, epoch.used.any(-1))
        if memory.parameters is not None and epoch.noise is not None and epoch.noise.kept is not None:
            P, dx = discount_information(P, dx, memory.parameters, self.states, epoch.noise.kept)
        noise = memory.noise
        if noise is not None:
            R = self.fix.variance(epoch, memory.fix, noise)
            noise = noise.update(epoch.z, fix.used, fix.H, R, P, dx, Q)
        structure = memory.structure
        if structure is not None:
            structure = structure + dx[:, self.states.of_structure]
        std = P.diagonal(dim1=-2, dim2=-1)[:, :STATES].clamp_min(0).sqrt()
        parameters = memory.parameters
        if parameters is not None:
            parameters = parameters + dx[:, self.states.of_others]
            largest = [self.parameters[name].largest for name in self.states.others]
            if min(largest) < math.inf:
                most = parameters.new_tensor(largest)
                parameters = torch.maximum(torch.minimum(parameters, most), -most)
            said += [parameters, P.diagonal(dim1=-2, dim2=-1)[:, self.states.of_others].clamp_min(0).sqrt()]
        if has_receiver(self.states):
            Phi = add_drift(Phi, self.states, epoch.span_s)
        memory = KalmanMemory(P, memory.windows, memory.fix, tuple(sources), structure, noise, parameters, tails)
        error = epoch.error.update(dx, self.states)
        if parameters is not None and has_g_sensitivity(self.states):
            error = error._replace(g_sensitivity=select_matrix(parameters, self.states))
        return memory, Correction(
            dx[:, PVA], error, std=std, gain=K[:, PVA, :6],
            accepted=epoch.used.any(-1), covariances=Covariances(Phi, predicted, P, fix.H, fix.R, dx),
            aids=torch.cat(said, -1) if said else None,
        )  # fmt: skip

    def _name_parameters(self, parameters: Float[Tensor, "B k"]) -> dict[str, Tensor]:
        """Estimates (B,) of the sources' parameters."""
        return dict(zip(self.states.others, parameters.unbind(-1)))

    def _transition(self, memory: KalmanMemory, epoch: Epoch) -> Float[Tensor, "B n n"]:
        if not (self.cut_transition and torch.is_grad_enabled()):
            return memory.windows.transition(epoch.start, epoch.window, epoch.corrected, epoch.frame)
        with torch.no_grad():
            w = epoch.window
            window = w._replace(p_n=w.p_n.detach(), v_n=w.v_n.detach(), C_nb=w.C_nb.detach(), end=w.end.detach())
            return memory.windows.transition(epoch.start.detach(), window, epoch.corrected.detach(), epoch.frame)

    def _imu_sigma(self) -> Float[Tensor, " k"]:
        if self.prior is not None:
            return torch.tensor(self.prior.std, dtype=torch.float64)
        bias = bias_sigma(self.imu, self.states)
        of_matrix = [
            sensor.scale_factor if i == j else sensor.misalignment
            for sensor in (self.imu.accel, self.imu.gyro)
            for i, j in self.states.elements
        ]
        return torch.cat((bias, torch.tensor(of_matrix, dtype=torch.float64)))


@runtime_checkable
class CovarianceEstimator(Estimator, Protocol):
    """An estimator that carries error states and their covariance: a Kalman filter, or one with a network round it."""

    @property
    def states(self) -> ErrorStates:
        """Its error states."""
        ...


def has_covariance(estimator: object) -> TypeGuard[CovarianceEstimator]:
    """Whether an estimator can be smoothed and its covariance compared with its errors."""
    return isinstance(estimator, CovarianceEstimator)
