"""Branches on values: they save work on a CPU, in Python and in exported C; compiled graphs have none, and a GPU would
have to sync."""

from __future__ import annotations

from typing import Any, TypeVar

import torch
from jaxtyping import Bool
from torch import Tensor

from dlkf.navigation.compiled import is_recorded

Parts = TypeVar("Parts", bound="Tensor | tuple")


def may_branch(on: Tensor) -> bool:
    """Whether what is done next may depend on the values of ``on``; if not, all is done and ``torch.where`` chooses."""
    return on.device.type == "cpu" and not is_recorded()


def select_branch(on: Bool[Tensor, " B"], then: Parts, otherwise: Parts) -> Parts:
    """``then`` for the drives that are ``on``, else ``otherwise``: a tensor, or named tuples of the same kind.

    Exported C computes what only this uses of ``then`` if ``on`` alone (:mod:`dlkf.onboard.c_branches`).
    """
    if isinstance(then, Tensor):
        return torch.where(on.view(-1, *(1,) * (then.ndim - 1)), then, otherwise)  # type: ignore[return-value]
    parts: Any = (select_branch(on, x, y) for x, y in zip(then, otherwise, strict=True))
    return type(then)(*parts)
