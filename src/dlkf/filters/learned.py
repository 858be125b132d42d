"""The deep-learning-assisted Kalman filter: gain and IMU error from a network (paper section 2; R030–R052)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from dlkf.data.drive import Batch
from dlkf.errors import InputError
from dlkf.filters.integration import Correction, Epoch
from dlkf.navigation.state import ATTITUDE, NavState
from dlkf.networks.cnn_lstm import CnnLstm, LstmState, NetworkConfig
from dlkf.networks.features import FRAMES, component_features, level_rotation, window_features
from dlkf.networks.heads import GainHead, ImuErrorHead

OUTAGE_MODES = ("hold", "run")
MAX_TRAINING_TURN = 0.2  # rad per correction, a guard in training only (paper.md 4.10)


@dataclass(frozen=True)
class LearnedConfig:
    """How the literal DLKF reads the paper.

    ``outage_mode``: ``hold`` runs the network at GNSS updates only and keeps the last IMU error in between
    (the paper); ``run`` runs it every epoch, with a fix flag and the time since the last fix as further
    inputs (paper.md 4.3). ``frame``: axes of features and gain. ``detach_features`` stops the gradient at
    the network's inputs (paper.md 4.13). ``rate_hz``, ``epoch_s``: what it was trained on.
    """

    network: NetworkConfig = field(default_factory=NetworkConfig)
    outage_mode: str = "hold"
    frame: str = "ned"
    detach_features: bool = True
    initial_gain: float = 0.5
    rate_hz: float = 50.0
    epoch_s: float = 1.0
    kind: str = "dlkf"

    def __post_init__(self) -> None:
        for name, known in (("outage_mode", OUTAGE_MODES), ("frame", FRAMES), ("kind", ("dlkf",))):
            if getattr(self, name) not in known:
                raise InputError(f"model.{name} is {getattr(self, name)!r}; choose one of {', '.join(known)}")
        if round(self.rate_hz * self.epoch_s) != self.network.samples:
            raise InputError(
                f"model.network.samples is {self.network.samples} but rate_hz · epoch_s is "
                f"{self.rate_hz * self.epoch_s:g}; make them equal"
            )

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> LearnedConfig:
        """From plain values; raises InputError for a key it does not know or a value of another type."""
        values = dict(values)
        network = values.pop("network", {})
        if not isinstance(network, Mapping):
            raise InputError(f"model.network is {network!r}; it must hold the network's settings")
        network = dict(network)
        for given, target, where in ((values, cls, "model"), (network, NetworkConfig, "model.network")):
            known = {f.name: f.default for f in fields(target) if f.name != "network"}
            for key, value in given.items():
                if key not in known:
                    raise InputError(f"{where}: unknown key {key!r}; known: {', '.join(sorted(known))}")
                if not _is_like(value, known[key]):
                    raise InputError(f"{where}.{key} is {value!r}; must be like {known[key]!r}")
        values.setdefault("rate_hz", cls.rate_hz)
        values.setdefault("epoch_s", cls.epoch_s)
        network.setdefault("samples", round(values["rate_hz"] * values["epoch_s"]))
        network["dense"] = tuple(network.get("dense", NetworkConfig.dense))
        network["flags"] = 2 if values.get("outage_mode", cls.outage_mode) == "run" else 0
        return cls(network=NetworkConfig(**network), **values)

    def plain(self) -> dict[str, Any]:
        """Plain values for a file."""
        values = asdict(self)
        values["network"]["dense"] = list(values["network"]["dense"])
        values["network"].pop("flags")
        return values


def _is_like(value: Any, default: Any) -> bool:
    """Whether a setting has the type of its default; whole numbers may stand for floats."""
    if isinstance(default, tuple):
        return isinstance(value, (list, tuple)) and all(_is_like(v, default[0]) for v in value)
    kinds = (int, float) if isinstance(default, float) else type(default)
    return isinstance(value, kinds) and isinstance(value, bool) == isinstance(default, bool)


class Memory(NamedTuple):
    """What the filter carries from epoch to epoch; the last four belong to the last network run."""

    lstm: LstmState
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

    def __init__(self, config: LearnedConfig) -> None:
        super().__init__()
        self.config = config
        self.network = CnnLstm(config.network)
        width = config.network.dense[-1]
        self.gain = GainHead(width, config.initial_gain)
        self.imu_error = ImuErrorHead(width)

    def heads(self) -> Iterator[nn.Parameter]:
        """Weights of the output layers, which may learn at their own rate."""
        yield from self.gain.parameters()
        yield from self.imu_error.parameters()

    def begin(self, batch: Batch) -> tuple[Memory, Tensor]:
        """Empty memory, no IMU error."""
        B, _, M = batch.size
        if self.config.network.samples != M:
            raise InputError(
                f"this model was trained on windows of {self.config.network.samples} samples "
                f"({self.config.rate_hz:g} Hz), the data come with {M}; set rate_hz={self.config.rate_hz:g}"
            )
        parameter = self.imu_error.linear.weight
        state = NavState(*(x.detach() for x in batch.start))
        zeros = batch.imu.new_zeros
        memory = Memory(
            lstm=self.network.start(B, parameter),
            elapsed=zeros(B), since_fix=zeros(B), posterior=state, difference=zeros(B, 9),
            difference_s=batch.imu.new_ones(B), correction=zeros(B, 9), fix=zeros(B, 6),
            had_fix=torch.zeros(B, 6, dtype=torch.bool, device=batch.imu.device),
        )  # fmt: skip
        return memory, zeros(B, 6)

    def step(self, memory: Memory, epoch: Epoch) -> tuple[Memory, Correction]:
        """Run the network for the pieces that have a fix (``hold``) or for all (``run``)."""
        B = len(epoch.z)
        span = epoch.dt * epoch.imu.shape[1]
        has_fix = epoch.used.any(-1)
        memory = memory._replace(elapsed=memory.elapsed + span, since_fix=memory.since_fix + span)
        hold = self.config.outage_mode == "hold"
        rows = has_fix.nonzero().squeeze(-1) if hold else torch.arange(B, device=epoch.z.device)
        dx = epoch.z.new_zeros(B, 9)
        gain = epoch.z.new_zeros(B, 9, 6)
        if len(rows) == 0:
            return memory, Correction(dx, epoch.imu_error, gain=gain)
        whole = len(rows) == B
        K, error, lstm = self._run(memory, epoch, rows, whole, has_fix)
        part = (K @ epoch.z[rows].unsqueeze(-1)).squeeze(-1)
        if self.training:
            turn = part[:, ATTITUDE].norm(dim=-1, keepdim=True).detach()
            shrink = (MAX_TRAINING_TURN / turn.clamp_min(1e-9)).clamp(max=1.0)
            part = torch.cat((part[:, :6], part[:, ATTITUDE] * shrink), -1)
        if whole:
            dx, gain, imu_error = part, K, error
        else:
            dx, gain = dx.index_copy(0, rows, part), gain.index_copy(0, rows, K)
            imu_error = epoch.imu_error.index_copy(0, rows, error)
            lstm = tuple(old.index_copy(1, rows, new) for old, new in zip(memory.lstm, lstm))
        return self._remember(memory, epoch, dx, has_fix, rows, lstm), Correction(dx, imu_error, gain=gain)

    def _run(self, memory, epoch, rows, whole, has_fix):
        """Gain in n, IMU error and new LSTM state of the pieces in ``rows``."""
        pick = (lambda x: x) if whole else (lambda x: x[rows])
        cut = Tensor.detach if self.config.detach_features else (lambda x: x)
        p_n, v_n, C_nb = (pick(cut(x)) for x in epoch.window[:3])
        C_hn = level_rotation(C_nb[:, -1], self.config.frame)
        moved = torch.where(memory.had_fix & epoch.used, epoch.fix.value - memory.fix, torch.zeros_like(memory.fix))
        parts = [
            memory.difference / memory.difference_s.unsqueeze(-1),
            memory.correction,
            moved / memory.since_fix.unsqueeze(-1),
            epoch.z,
        ]
        components = component_features(*(pick(cut(x)) for x in parts), C_hn)
        if self.config.outage_mode == "run":
            age = torch.log1p(pick(memory.since_fix)) * ~pick(has_fix)
            components = torch.cat((components, pick(has_fix)[:, None].to(age.dtype), age[:, None]), -1)
        dtype = self.imu_error.linear.weight.dtype
        channels = window_features(p_n, v_n, C_nb, pick(epoch.imu), C_hn, self.config.frame)
        lstm = memory.lstm if whole else tuple(x[:, rows] for x in memory.lstm)
        h, lstm = self.network(channels.to(dtype), components.to(dtype), lstm)
        K, error = self.gain(h).to(epoch.z.dtype), self.imu_error(h).to(epoch.z.dtype)
        if self.config.frame == "heading":
            left, right = (torch.block_diag(*[torch.ones(3, 3)] * n).to(K) for n in (3, 2))
            C_nh = C_hn.mT
            K = (C_nh.repeat(1, 3, 3) * left) @ K @ (C_hn.repeat(1, 2, 2) * right)
        return K, error, lstm

    def _remember(self, memory, epoch, dx, has_fix, rows, lstm) -> Memory:
        """Memory after the network ran on ``rows``."""
        ran = torch.zeros_like(has_fix).index_fill(0, rows, True)
        posterior = epoch.window.end.detach().corrected(dx.detach())
        difference = memory.posterior.error_to(posterior)

        def choose(new: Tensor, old: Tensor, which: Tensor = ran) -> Tensor:
            return torch.where(which.reshape(-1, *[1] * (new.ndim - 1)), new, old)

        return Memory(
            lstm=lstm,
            elapsed=choose(torch.zeros_like(memory.elapsed), memory.elapsed),
            since_fix=choose(torch.zeros_like(memory.since_fix), memory.since_fix, has_fix),
            posterior=NavState(*(choose(n, o) for n, o in zip(posterior, memory.posterior))),
            difference=choose(difference, memory.difference),
            difference_s=choose(memory.elapsed, memory.difference_s),
            correction=choose(dx.detach(), memory.correction),
            fix=torch.where(epoch.used, epoch.fix.value, memory.fix),
            had_fix=memory.had_fix | epoch.used,
        )
