"""Tensors of a C function: views of buffers, loops over them, and one block of memory in which they lie."""

from __future__ import annotations

from bisect import insort
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import count, product
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.fx import GraphModule, Node

C_TYPES = {
    torch.float64: "double", torch.float32: "float", torch.int64: "int64_t", torch.int32: "int32_t",
    torch.bool: "unsigned char",
}  # fmt: skip
CACHE_LINE = 64  # bytes
SHORT, LONG = 8, 16  # a row shorter than that is no vector; rows from which on they are many


@dataclass
class Buffer:
    """Memory of one tensor: where it begins in the block is not known before its last use is."""

    name: str
    dtype: torch.dtype
    numbers: int
    born: int = 0  # line
    last: int = 0
    fixed: bool = False  # an argument or a constant


@dataclass
class View:
    """A tensor: a buffer, and a tensor without data (``meta``) that has its shape, strides and offset."""

    buffer: Buffer
    meta: Tensor

    def at(self, index: Sequence[str]) -> str:
        """The element at an index."""
        terms = [f"{s}*{i}" if s != 1 else i for s, i in zip(self.meta.stride(), index) if s and i != "0"]
        if self.meta.storage_offset() or not terms:
            terms.append(str(self.meta.storage_offset()))
        return f"{self.buffer.name}[{'+'.join(terms)}]"

    def view_as(self, meta: Tensor) -> View:
        """The same memory in another way."""
        return View(self.buffer, meta)


@dataclass
class Expression:
    """Elements of a tensor that are not computed yet: a C expression over the elements of others."""

    shape: torch.Size
    dtype: torch.dtype
    pattern: str  # with {0}, {1}, … for the operands
    operands: list[View]


@dataclass
class Rows:
    """Elements that are not computed yet, an expression for each index of the leading axes."""

    shape: torch.Size
    dtype: torch.dtype
    lead: torch.Size
    items: list[Expression]  # in the order of memory

    def at(self, index: Sequence[int]) -> Expression:
        """That of an index of the leading axes."""
        place = 0
        for n, i in zip(self.lead, index):
            place = place * n + i
        return self.items[place]

    def view_as(self, shape: torch.Size) -> Rows | None:
        """As another shape; None where that parts an expression."""
        for k in range(len(shape) + 1):
            if shape[:k].numel() == self.lead.numel():
                try:
                    items = []
                    for x in self.items:
                        operands = [v.view_as(v.meta.view(shape[k:])) for v in x.operands]
                        items.append(Expression(shape[k:], x.dtype, x.pattern, operands))
                except RuntimeError:  # strides that do not allow it
                    return None
                return Rows(shape, self.dtype, shape[:k], items)
        return None


@dataclass
class Block:
    """Lines of the function, and the buffers that they use."""

    lines: list[str] = field(default_factory=list)
    buffers: list[Buffer] = field(default_factory=list)
    constants: list[tuple[Buffer, np.ndarray]] = field(default_factory=list)
    places: dict[str, int] = field(default_factory=dict)
    names: Any = field(default_factory=lambda: count(0))

    def new(
        self, shape: torch.Size | tuple[int, ...], dtype: torch.dtype, strides: Sequence[int] | None = None
    ) -> View:
        """A tensor to be written next; ``strides`` of one without gaps, if its axes stand in another order."""
        meta = torch.empty(shape, dtype=dtype, device="meta")
        if strides is not None:
            meta = torch.empty_strided(shape, strides, dtype=dtype, device="meta")
        buffer = Buffer(f"x{next(self.names)}", dtype, max(1, meta.numel()), len(self.lines), len(self.lines))
        self.buffers.append(buffer)
        return View(buffer, meta)

    def constant(self, value: Tensor) -> View:
        """A tensor known here."""
        value = value.detach().cpu().contiguous()
        numbers = value.reshape(-1).numpy()
        same = (buffer for buffer, x in self.constants if x.dtype == numbers.dtype and x.tobytes() == numbers.tobytes())
        buffer = next(same, None)
        if buffer is None:
            buffer = Buffer(f"c{next(self.names)}", value.dtype, max(1, value.numel()), fixed=True)
            self.constants.append((buffer, numbers))
        return View(buffer, value.to("meta"))

    def write(self, line: str, *used: View) -> None:
        """A line, and the tensors in it."""
        for view in used:
            view.buffer.last = len(self.lines)
        self.lines.append(line)

    def assign(self, out: View, expression: str, operands: Sequence[View]) -> None:
        """``out`` = expression at every index; operands have the shape of ``out``."""
        order = sorted(range(out.meta.ndim), key=lambda d: -out.meta.stride(d))  # along its memory
        metas = [m.permute(order) for m in (out.meta, *(o.meta for o in operands))]
        sizes, strides = collapse_loops(list(metas[0].shape), [list(m.stride()) for m in metas])
        views = [View(v.buffer, _restride(v.meta, sizes, s)) for v, s in zip((out, *operands), strides)]
        index = [f"i{k}" for k in range(len(sizes))]
        elements = [v.at(index) for v in views[1:]]
        self.write(f"{loops(index, sizes)}{views[0].at(index)} = {expression.format(*elements)};", out, *operands)

    def lay_out(self) -> int:
        """Give every buffer that is on the stack its place; bytes in all. What lives together lies apart."""
        alive: list[tuple[int, int, int]] = []  # start, end, last line
        highest = CACHE_LINE
        for b in sorted(self.buffers, key=lambda b: b.born):
            size = -(-b.numbers * b.dtype.itemsize // CACHE_LINE) * CACHE_LINE
            alive = [a for a in alive if a[2] >= b.born]
            place = 0
            for start, end, _ in alive:
                if start >= place + size:
                    break
                place = max(place, end)
            insort(alive, (place, place + size, b.last))
            self.places[b.name] = place
            highest = max(highest, place + size)
        return highest


class Tensors:
    """Values of a graph as tensors in memory."""

    def __init__(self, block: Block | None = None) -> None:
        self.block = Block() if block is None else block

    def result(self, node: Node) -> View:
        """Memory for what an operation returns, as torch has it; many rows of few numbers column by column."""
        value: Any = node.meta["val"]
        if value.ndim > 1 and value.shape[-1] < SHORT <= LONG <= value.shape[-2] and value.is_contiguous():
            out = self.block.new((*value.shape[:-2], *value.shape[:-3:-1]), value.dtype)
            return out.view_as(out.meta.mT)
        whole = value.numel() and torch.ops.aten.is_non_overlapping_and_dense(value)
        return self.block.new(value.shape, value.dtype, value.stride() if whole else None)

    def may_stay_expression(self, node: Node) -> bool:
        """Whether a node's value may stay an expression: one node uses it, and that takes each element once."""
        raise NotImplementedError

    def write_graph(self, graph: GraphModule, given: Sequence[View]) -> None:
        """The lines of another graph, which changes the first of ``given``."""
        raise NotImplementedError

    def expand_elements(self, x: Any, shape: torch.Size) -> tuple[str, list[View]]:
        """Pattern and operands of a tensor of a shape."""
        if isinstance(x, Expression) and x.shape == shape:
            return f"({x.pattern})", x.operands
        view = self.tensor(x)
        return "{0}", [view.view_as(view.meta.expand(shape))]

    def store(self, node: Node, x: Expression | Rows) -> View:
        """A node's value in memory."""
        return self._write(self.result(node), x)

    def _write(self, out: View, x: Expression | Rows) -> View:
        if isinstance(x, Expression):
            self.block.assign(out, x.pattern, x.operands)
        else:
            for index in product(*map(range, x.lead)):
                item = x.at(index)
                self.block.assign(out.view_as(out.meta[index]), item.pattern, item.operands)
        return out

    def elements(self, x: Any) -> Expression:
        """A value element by element."""
        if isinstance(x, Expression):
            return x
        view = self.tensor(x)
        return Expression(view.meta.shape, view.meta.dtype, "{0}", [view])

    def tensor(self, x: Any) -> View:
        """A value as a tensor in memory."""
        if isinstance(x, Tensor):
            return self.block.constant(x)
        return self._write(self.block.new(x.shape, x.dtype), x) if isinstance(x, (Expression, Rows)) else x

    def dense(self, x: Any) -> View:
        """A value as a tensor without gaps."""
        view = self.tensor(x)
        if view.meta.is_contiguous():
            return view
        out = self.block.new(view.meta.shape, view.meta.dtype)
        self.block.assign(out, "{0}", [view])
        return out


def loops(names: Sequence[str], sizes: Sequence[int]) -> str:
    """Heads of nested loops."""
    return "".join(f"for (int {i} = 0; {i} < {n}; {i}++) " for i, n in zip(names, sizes))


def collapse_loops(sizes: list[int], strides: list[list[int]]) -> tuple[list[int], list[list[int]]]:
    """A loop nest with as few loops as all operands allow; loops of one pass fall away."""
    kept = [k for k, n in enumerate(sizes) if n != 1]
    sizes, strides = [sizes[k] for k in kept], [[s[k] for k in kept] for s in strides]
    k = len(sizes) - 1
    while k > 0:
        if all(s[k - 1] == s[k] * sizes[k] for s in strides):
            sizes[k - 1 : k + 1] = [sizes[k - 1] * sizes[k]]
            for s in strides:
                s[k - 1 : k + 1] = [s[k]]
        k -= 1
    return sizes, strides


def _restride(meta: Tensor, sizes: list[int], strides: list[int]) -> Tensor:
    return torch.as_strided(meta, sizes, strides, meta.storage_offset())
