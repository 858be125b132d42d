"""A network of a user's own in the place of the CNN-LSTM, named by ``model.network._target_``.

It is a ``torch.nn.Module`` with

    width                                  length of the feature vector that it gives
    start(batch_size, like)                its memory: a tuple of tensors (layers, batch_size, …), perhaps empty
    forward(window, components, memory)    (B, 15, M) and (B, 30 + flags) → (B, width) and the memory after

Its constructor is given the settings beside ``_target_``, and ``samples`` and ``flags`` where it takes them.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from importlib import import_module
from typing import Any

from torch import nn

from dlkf.errors import InputError
from dlkf.networks.cnn_lstm import NetworkConfig

PAPERS = {f.name for f in fields(NetworkConfig)}  # settings that lie beside _target_ where a preset is the base


@dataclass(frozen=True)
class OwnNetwork:
    """Settings of a network by name of its class, ``module.Class``; its module is on ``PYTHONPATH``."""

    target: str
    samples: int
    flags: int = 0
    settings: Mapping[str, Any] = field(default_factory=dict)

    def build(self) -> nn.Module:
        """The network. InputError where it cannot be found, takes other settings, or lacks what a network has."""
        module, _, name = self.target.rpartition(".")
        try:
            made_by = getattr(import_module(module), name)
        except (ImportError, AttributeError, ValueError) as error:
            raise InputError(
                f"model.network._target_={self.target}: {error}; give module.Class, its module's folder in PYTHONPATH"
            ) from None
        takes = inspect.signature(made_by).parameters
        given = {"samples": self.samples, "flags": self.flags, **self.settings}
        if unknown := sorted(set(self.settings) - set(takes) - PAPERS):
            raise InputError(f"model.network: {self.target} takes no {unknown[0]}; it takes {', '.join(takes)}")
        network = made_by(**{k: v for k, v in given.items() if k in takes})
        if missing := [n for n in ("width", "start", "forward") if not hasattr(network, n)]:
            raise InputError(f"model.network._target_={self.target} has no {missing[0]}; see dlkf.networks.own")
        return network

    def plain(self) -> dict[str, Any]:
        """Plain values for a file."""
        return {"_target_": self.target, "samples": self.samples, **self.settings}
