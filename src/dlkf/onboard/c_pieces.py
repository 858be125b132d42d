"""``dlkf::summed`` in C: a loop over pieces of the samples round what :mod:`dlkf.filters.pieces` does with one."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.fx import Node

from dlkf.filters.pieces import find_function
from dlkf.onboard.c_memory import Buffer, Tensors, View
from dlkf.onboard.recording import record

SUMMED = "dlkf::summed"


def write_sum(t: Tensors, node: Node, name: str, count: int, begin: Any, samples: list) -> View:
    """What a piece adds, in ``count`` turns."""
    out = t.result(node)
    t.block.assign(out, *t.expand_elements(begin, out.meta.shape))
    wholes, pieces = [t.tensor(x) for x in samples], []
    for x in wholes:
        size = x.meta.shape[1] // count
        at = Buffer(f"({x.buffer.name}+{size * x.meta.stride(1)}*t)", x.buffer.dtype, x.buffer.numbers, fixed=True)
        pieces.append(View(at, x.meta.narrow(1, 0, size)))
    example = tuple(torch.zeros(x.meta.shape, dtype=x.meta.dtype) for x in (out, *pieces))
    t.block.write(f"for (int t = 0; t < {count}; t++) {{", out, *wholes)
    t.write_graph(record(_Piece(name, example)), [out, *pieces])
    t.block.write("}", out, *wholes)
    return out


class _Piece:
    """What is done with one, as the recorder takes it."""

    def __init__(self, name: str, example: tuple[Tensor, ...]) -> None:
        self._work, self._example = find_function(name), example

    def example(self) -> tuple[Tensor, ...]:
        return self._example

    def __call__(self, *args: Tensor) -> Tensor:
        return self._work(*args)
