"""A network of a user's own in the place of the CNN-LSTM, named by ``model.network._target_``.

It is a ``torch.nn.Module`` with

    width                                  length of the feature vector that it gives
    start(batch_size, like)                its memory: a tuple of tensors (layers, batch_size, …), perhaps empty
    forward(window, components, memory)    (B, 15, M) and (B, 30 + flags) → (B, width) and the memory after

Its constructor is given the settings beside ``_target_``, and ``samples`` and ``flags`` where it takes them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from dlkf.base.classes import TARGET, drop_spare, instantiate
from dlkf.base.errors import InputError
from dlkf.networks.cnn_lstm import NetworkConfig

NETWORK = ("start", "forward", "state_dict")  # methods of a network
PAPER_FIELDS = {f.name for f in fields(NetworkConfig)}  # settings that lie beside _target_ where a preset is the base


@dataclass(frozen=True)
class OwnNetwork:
    """Settings of a network by name of its class, ``module.Class``; its module is on ``PYTHONPATH``."""

    target: str
    samples: int | None = None
    flags: int = 0
    settings: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> OwnNetwork:
        """From plain values with ``_target_``, of which those of the CNN-LSTM are left out if the class lacks them."""
        values = drop_spare(values, "model.network", NETWORK, PAPER_FIELDS)
        settings = {k: v for k, v in values.items() if k not in (TARGET, "samples")}
        return cls(str(values[TARGET]), values.get("samples"), settings=settings)

    def build(self) -> Any:
        """The network. InputError where it cannot be found, takes other settings, or lacks what a network has."""
        offered = {"samples": self.samples, "flags": self.flags}
        values = {TARGET: self.target, **self.settings}
        network = instantiate(values, "model.network", NETWORK, offered=offered, spare=PAPER_FIELDS)
        if not hasattr(network, "width"):
            raise InputError(f"model.network.{TARGET}={self.target} has no width")
        return network

    def as_dict(self) -> dict[str, Any]:
        """Plain values for a file."""
        return {TARGET: self.target, "samples": self.samples, **self.settings}
