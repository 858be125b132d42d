"""Branches on values: they save work on a CPU; compiled and exported graphs have none, and a GPU would have to sync."""

from __future__ import annotations

from torch import Tensor

from dlkf.navigation.compiled import is_recorded


def may_branch(on: Tensor) -> bool:
    """Whether what is done next may depend on the values of ``on``; if not, all is done and ``torch.where`` chooses."""
    return on.device.type == "cpu" and not is_recorded()
