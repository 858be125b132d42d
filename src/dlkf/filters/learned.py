"""The deep-learning-assisted Kalman filter: gain and IMU error from a network (paper section 2; R030–R052)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor, nn

from dlkf.base.classes import TARGET
from dlkf.base.errors import InputError
from dlkf.base.settings import settings_from
from dlkf.data.drive import Batch
from dlkf.filters.branches import may_branch, select_branch
from dlkf.filters.integration import Correction, Epoch, integrate
from dlkf.navigation.calibration import ImuError
from dlkf.navigation.state import ATTITUDE, NavState
from dlkf.networks.cnn_lstm import NetworkConfig, Recurrent
from dlkf.networks.features import Frame, Scaling, component_features, level_rotation, window_features
from dlkf.networks.heads import Form, GainHead, ImuErrorHead
from dlkf.networks.own import OwnNetwork
from dlkf.networks.products import begin_batch


@dataclass(frozen=True)
class LearnedConfig:
    """How the DLKF reads the paper; the defaults are the literal reading.

    ``outage_mode``: ``hold`` runs the network at GNSS updates only and keeps the last IMU error in between
    (the paper); ``run`` runs it every epoch, with a fix flag and the time since the last fix as further
    inputs (paper.md 4.3). ``frame``: axes of features and gain. ``imu_error``: ``constant`` through an epoch, or
    ``affine`` in the samples, with sensor matrices (paper.md 4.11 E0, E4); ``imu_error_bound`` [σ] limits its bias,
    0 does not. ``known_from``: with ``training``, features have the sizes and the network's IMU error begins
    its training at the mean that training segments have (no truth is used); with ``nothing``, fixed sizes and zero.
    Until the network has run for the first time, at the end of the first epoch (``hold``: at the first fix), the IMU
    error is zero in both. ``detach_features`` stops the gradient at the network's inputs (paper.md 4.13).
    ``training_turn`` [rad] limits the attitude correction of an update in training alone (paper.md 4.10); 0 does not.
    ``rate_hz``, ``epoch_s``: what it was trained on.
    """

    network: NetworkConfig | OwnNetwork = field(default_factory=NetworkConfig)
    outage_mode: Literal["hold", "run"] = "hold"
    frame: Frame = "ned"
    detach_features: bool = True
    training_turn: float = 0.2
    imu_error: Form = "constant"
    imu_error_bound: float = 0.0
    known_from: Literal["nothing", "training"] = "nothing"
    initial_gain: float = 0.5
    rate_hz: float = 50.0
    epoch_s: float = 1.0
    kind: Literal["dlkf"] = "dlkf"

    def __post_init__(self) -> None:
        samples = round(self.rate_hz * self.epoch_s)
        if self.network.samples not in (None, samples):
            raise InputError(
                f"model.network.samples is {self.network.samples} but rate_hz · epoch_s is "
                f"{self.rate_hz * self.epoch_s:g}; make them equal"
            )
        if self.training_turn < 0:
            raise InputError(f"model.training_turn is {self.training_turn!r}, must be 0 (no limit) or more")
        flags = 2 if self.outage_mode == "run" else 0
        object.__setattr__(self, "network", replace(self.network, samples=samples, flags=flags))

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> LearnedConfig:
        """From plain values; InputError for an unknown key or a value of another type."""
        network = values.get("network", {})
        if isinstance(network, Mapping) and TARGET in network:
            values = {**values, "network": OwnNetwork.from_mapping(network)}
        return settings_from(cls, values, "model")

    def as_dict(self) -> dict[str, Any]:
        """Plain values for a file."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return values | {"network": self.network.as_dict()}


class LearnedMemory(NamedTuple):
    """What the filter carries from epoch to epoch; the last six belong to the last network run."""

    recurrent: Recurrent
    origin: Tensor  # (B, 3) estimated position at the start, from which features count
    elapsed: Tensor  # (B,) s since the last network run
    since_fix: Tensor  # (B,) s since the last fix
    posterior: NavState  # after the last run
    difference: Tensor  # (B, 9) posterior there ⊖ posterior one run earlier
    difference_s: Tensor  # (B,) the time between them
    correction: Tensor  # (B, 9) the last correction
    fix: Tensor  # (B, 6) the last fix
    had_fix: Tensor  # (B, 6) bool


class LearnedFilter(nn.Module):
    """Estimator whose gain and IMU error come from a CNN-LSTM trained end to end."""

    network: Any  # the CNN-LSTM or one of a user's own
    card: dict[str, Any]  # what the weights were made of; those of a file have it

    def __init__(self, config: LearnedConfig) -> None:
        super().__init__()
        self.config = config
        self.scaling = Scaling()
        self.network = config.network.build()
        self.gain = GainHead(self.network.width, config.initial_gain)
        self.imu_error = ImuErrorHead(self.network.width, config.imu_error, config.imu_error_bound)

    def heads(self) -> Iterator[nn.Parameter]:
        """Weights of the output layers, which may learn at their own rate."""
        yield from self.gain.parameters()
        yield from self.imu_error.parameters()

    def begin(self, batch: Batch) -> tuple[LearnedMemory, Tensor]:
        """Empty memory, no IMU error."""
        B, _, M = batch.size
        if self.config.network.samples != M:
            c = self.config
            raise InputError(
                f"this model was trained on windows of {c.network.samples} samples ({c.rate_hz:g} Hz over epochs of "
                f"{c.epoch_s:g} s), the data come with {M}; leave rate_hz and epoch_s to the model"
            )
        begin_batch(self)
        parameter = self.imu_error.linear.weight
        state = NavState(*(x.detach() for x in batch.start))
        zeros = batch.imu.new_zeros
        memory = LearnedMemory(
            recurrent=self.network.start(B, parameter), origin=state.p_n,
            elapsed=zeros(B), since_fix=zeros(B), posterior=state, difference=zeros(B, 9),
            difference_s=batch.imu.new_ones(B), correction=zeros(B, 9), fix=zeros(B, 6),
            had_fix=torch.zeros(B, 6, dtype=torch.bool, device=batch.imu.device),
        )  # fmt: skip
        return memory, zeros(B, 6)

    def step(self, memory: LearnedMemory, epoch: Epoch) -> tuple[LearnedMemory, Correction]:
        """Run the network for the segments that have a fix (``hold``) or for all (``run``)."""
        B = len(epoch.z)
        span = epoch.span_s
        has_fix = epoch.used.any(-1)
        memory = memory._replace(elapsed=memory.elapsed + span, since_fix=memory.since_fix + span)
        hold = self.config.outage_mode == "hold"
        picking = hold and may_branch(has_fix)  # if not, all segments run, and those without a fix keep what they had
        rows = has_fix.nonzero().squeeze(-1) if picking else torch.arange(B, device=epoch.z.device)
        dx = epoch.z.new_zeros(B, 9)
        gain = epoch.z.new_zeros(B, 9, 6)
        if len(rows) == 0:
            return memory, Correction(dx, epoch.error, gain=gain)
        whole = len(rows) == B
        K, error, recurrent = self._run(memory, epoch, rows, whole, has_fix)
        part = self._limit_turn((K @ epoch.z[rows].unsqueeze(-1)).squeeze(-1))
        if hold and not picking:
            dx, gain = select_branch(has_fix, part, dx), select_branch(has_fix, K, gain)
            matrix = None
            if error.matrix is not None and epoch.error.matrix is not None:
                matrix = select_branch(has_fix, error.matrix, epoch.error.matrix)
            error = ImuError(select_branch(has_fix, error.bias, epoch.error.bias), matrix)
            recurrent = tuple(torch.where(has_fix[:, None], new, o) for new, o in zip(recurrent, memory.recurrent))
        elif whole:
            dx, gain = part, K
        else:
            dx, gain = dx.index_copy(0, rows, part), gain.index_copy(0, rows, K)
            error = _replace_rows(epoch.error, rows, error)
            recurrent = tuple(old.index_copy(1, rows, new) for old, new in zip(memory.recurrent, recurrent))
        ran = has_fix if hold else torch.ones_like(has_fix)
        return self._remember(memory, epoch, dx, has_fix, ran, recurrent), Correction(dx, error, gain=gain)

    def _limit_turn(self, dx: Tensor) -> Tensor:
        """A correction (b, 9) whose turn is limited in training."""
        if not (self.training and self.config.training_turn):
            return dx
        turn = dx[:, ATTITUDE].norm(dim=-1, keepdim=True).detach()
        shrink = (self.config.training_turn / turn.clamp_min(1e-9)).clamp(max=1.0)
        return torch.cat((dx[:, :6], dx[:, ATTITUDE] * shrink), -1)

    def _run(
        self, memory: LearnedMemory, epoch: Epoch, rows: Tensor, whole: bool, has_fix: Tensor,
        further: Tensor | None = None,
    ) -> tuple[Tensor, ImuError, Recurrent]:  # fmt: skip
        """Gain in n, IMU error and new state of the cells for the segments in ``rows``; ``further`` inputs (b, k)."""

        def pick(x: Tensor) -> Tensor:
            x = x.detach() if self.config.detach_features else x
            return x if whole else x[rows]

        with torch.set_grad_enabled(torch.is_grad_enabled() and not self.config.detach_features):
            window, components, C_hn = self._features(memory, epoch, pick)
            window, components = self.scaling(window, components)
        if self.config.outage_mode == "run":
            fixed = pick(has_fix)
            age = torch.log1p(pick(memory.since_fix)) * ~fixed
            components = torch.cat((components, fixed[:, None].to(age.dtype), age[:, None]), -1)
        if further is not None:
            components = torch.cat((components, pick(further)), -1)
        dtype = self.imu_error.linear.weight.dtype
        recurrent = memory.recurrent if whole else tuple(x[:, rows] for x in memory.recurrent)
        h, recurrent = self.network(window.to(dtype), components.to(dtype), recurrent)
        K, error = self.gain(h).to(epoch.z.dtype), self.imu_error(h)
        matrix = error.matrix if error.matrix is None else error.matrix.to(epoch.z.dtype)
        error = ImuError(error.bias.to(epoch.z.dtype), matrix)
        if self.config.frame == "heading":
            left, right = (torch.block_diag(*[torch.ones(3, 3)] * n).to(K) for n in (3, 2))
            K = (C_hn.mT.repeat(1, 3, 3) * left) @ K @ (C_hn.repeat(1, 2, 2) * right)
        return K, error, recurrent

    def _features(
        self, memory: LearnedMemory, epoch: Epoch, pick: Callable[[Tensor], Tensor]
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Window (b, M, 15), components (b, 30) in physical units, and the rotation into their axes (b, 3, 3)."""
        p_n, v_n, C_nb = (pick(x) for x in epoch.window[:3])
        C_hn = level_rotation(C_nb[:, -1], self.config.frame)
        moved = torch.where(memory.had_fix & epoch.used, epoch.fix.value - memory.fix, 0.0)
        components = component_features(
            pick(memory.difference / memory.difference_s.unsqueeze(-1)),
            pick(memory.correction),
            pick(moved / memory.since_fix.unsqueeze(-1)),
            pick(epoch.z),
            C_hn,
        )
        moved_n = p_n - pick(memory.origin)[:, None]
        window = window_features(moved_n, v_n, C_nb, pick(epoch.imu), C_hn, self.config.frame)
        return window, components, C_hn

    @torch.no_grad()
    def _remember(
        self, memory: LearnedMemory, epoch: Epoch, dx: Tensor, has_fix: Tensor, ran: Tensor, recurrent: Recurrent
    ) -> LearnedMemory:
        """Memory after the network ran on some segments."""
        dx = dx.detach()
        posterior = epoch.window.end.detach().correct(dx)
        difference = memory.posterior.error_to(posterior)

        return LearnedMemory(
            recurrent=recurrent,
            origin=memory.origin,
            elapsed=select_branch(ran, torch.zeros_like(memory.elapsed), memory.elapsed),
            since_fix=select_branch(has_fix, torch.zeros_like(memory.since_fix), memory.since_fix),
            posterior=select_branch(ran, posterior, memory.posterior),
            difference=select_branch(ran, difference, memory.difference),
            difference_s=select_branch(ran, memory.elapsed, memory.difference_s),
            correction=select_branch(ran, dx, memory.correction),
            fix=torch.where(epoch.used, epoch.fix.value, memory.fix),
            had_fix=memory.had_fix | epoch.used,
        )

    @contextmanager
    def record_inputs(self) -> Iterator[list[tuple[Tensor, Tensor]]]:
        """Windows (b, M, 15) and components (b, 30) of every run of the network inside the block, unscaled."""
        seen: list[tuple[Tensor, Tensor]] = []
        hook = self.scaling.register_forward_pre_hook(lambda _, given: seen.append((given[0], given[1])))
        try:
            yield seen
        finally:
            hook.remove()

    def learn_sizes(self, batches: Sequence[Batch]) -> None:
        """Set the sizes of the features to those of these segments, as the filter stands."""
        with torch.inference_mode(), self.record_inputs() as seen:
            for batch in batches:
                integrate(batch, self)
        windows, components = (torch.cat(x).float() for x in zip(*seen))
        self.scaling.fit(windows.clone(), components.clone())


def _replace_rows(old: ImuError, rows: Tensor, new: ImuError) -> ImuError:
    """The errors of all segments after those in ``rows`` got new ones."""
    bias = old.bias.index_copy(0, rows, new.bias)
    if new.matrix is None:
        return ImuError(bias)
    before = new.matrix.new_zeros(len(bias), *new.matrix.shape[1:]) if old.matrix is None else old.matrix
    return ImuError(bias, before.index_copy(0, rows, new.matrix))
