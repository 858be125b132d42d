"""Sums over samples in pieces, so that memory holds what one piece needs.

In Python that is a loop, where the drives are many. Where operations are recorded it is one of them, ``dlkf::summed``,
and the C of it a loop round that of a piece (:mod:`dlkf.onboard.c_pieces`).
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module

import torch
from torch import Tensor
from torch.nn.functional import pad

from dlkf.navigation.compiled import is_recorded

LONGEST = 20  # samples of a piece
AT_ONCE = 400  # samples of all drives up to which Python takes them at once
Sum = Callable[..., Tensor]


def sum_pieces(work: Sum, begin: Tensor, *samples: Tensor) -> Tensor:
    """``work(begin, *samples)`` of a function of a module, which adds something of every sample (B, M, …) to ``begin``,
    and nothing of one that is zero."""
    if not is_recorded():
        drives, length = samples[0].shape[:2]
        for piece in zip(*(x.split(LONGEST if drives * length > AT_ONCE else length, 1) for x in samples)):
            begin = work(begin, *piece)
        return begin
    count = -(-samples[0].shape[1] // LONGEST)
    size = -(-samples[0].shape[1] // count)
    filled = [pad(x, (*(0, 0) * (x.ndim - 2), 0, count * size - x.shape[1])) for x in samples]
    return torch.ops.dlkf.summed(f"{work.__module__}:{work.__name__}", count, begin, filled)


def find_function(name: str) -> Sum:
    """The function that :func:`sum_pieces` has named."""
    module, function = name.split(":")
    return getattr(import_module(module), function)


torch.library.define("dlkf::summed", "(str name, int count, Tensor begin, Tensor[] samples) -> Tensor")


@torch.library.impl("dlkf::summed", "cpu")
def _run(name: str, count: int, begin: Tensor, samples: list[Tensor]) -> Tensor:
    return find_function(name)(begin.clone(), *samples)


@torch.library.register_fake("dlkf::summed")
def _(name: str, count: int, begin: Tensor, samples: list[Tensor]) -> Tensor:
    return torch.empty_like(begin)
