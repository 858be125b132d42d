"""Where results are written so that they need not be copied: a part of a joined tensor into its place there, a result
of the function into the caller's memory, a changed part into the tensor that it is a part of.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.fx import GraphModule, Node

from dlkf.onboard.c_memory import Expression, Rows, View
from dlkf.onboard.c_operations import PARTS

RESHAPES = ("view", "_unsafe_view", "reshape")
Place = tuple[Node, Callable[[Tensor], Tensor | None]]  # the node that holds it, and where in what holds that


def operation_name(node: Node) -> str:
    """The operation of a node; "" for what is none."""
    schema = getattr(node.target, "_schema", None)
    return "" if schema is None else schema.name.removeprefix("aten::")


def find_places(graph: GraphModule) -> dict[Node, Place]:
    """Of every node that a ``cat`` joins, directly or through views, its place in that: the first such one."""
    places: dict[Node, Place] = {}
    for node in graph.graph.nodes:
        if operation_name(node) != "cat":
            continue
        parts: Any = node.args[0]
        dim: Any = node.args[1] if len(node.args) > 1 else 0
        start = 0
        for part in parts:
            size = part.meta["val"].shape[dim]
            if part.meta["val"].numel() and part.meta["val"].dtype == node.meta["val"].dtype:
                _note_place(places, part, node, partial(torch.narrow, dim=dim, start=start, length=size))
            start += size if part.meta["val"].numel() else 0
    return places


def _note_place(places: dict[Node, Place], part: Node, holder: Node, where: Callable[[Tensor], Tensor | None]) -> None:
    """Of a part, or of what it is a view of."""
    while (undo := _invert_view(part)) is not None:
        part, where = part.args[0], _compose(where, undo)  # type: ignore[assignment]
    places.setdefault(part, (holder, where))


def _compose(
    where: Callable[[Tensor], Tensor | None], undo: Callable[[Tensor], Tensor | None]
) -> Callable[[Tensor], Tensor | None]:
    def locate(whole: Tensor) -> Tensor | None:
        at = where(whole)
        return None if at is None else undo(at)

    return locate


def _invert_view(node: Node) -> Callable[[Tensor], Tensor | None] | None:
    """What makes the tensor of its view; None where the node is no such view."""
    name, args = operation_name(node), list[Any](node.args)
    if name == "unsqueeze":
        return lambda view: view.squeeze(args[1])  # type: ignore[call-overload, arg-type]
    if name == "expand" and args[0].meta["val"].shape == node.meta["val"].shape:  # type: ignore[union-attr]
        return lambda view: view
    if name in RESHAPES:
        return lambda view: _reshape(view, args[0].meta["val"].shape)  # type: ignore[union-attr]
    if name == "permute":
        order: Any = args[1]
        back = sorted(range(len(order)), key=lambda k: order[k] % len(order))
        return lambda view: view.permute(back)
    return None


def _reshape(view: Tensor, shape: torch.Size) -> Tensor | None:
    try:
        return view.view(shape)
    except RuntimeError:  # strides that do not allow it
        return None


class Readers:
    """Which nodes read which buffer, so that it is written over when nobody does any more."""

    def __init__(self, graph: GraphModule) -> None:
        self._order = {node: k for k, node in enumerate(graph.graph.nodes)}
        self._values: dict[str, list[tuple[Node, Any]]] = {}

    def note(self, node: Node, value: Any) -> None:
        """A node and its value, which reads buffers."""
        for view in _views(value):
            self._values.setdefault(view.buffer.name, []).append((node, value))

    def may_change(self, node: Node, whole: View, source: View) -> bool:
        """Whether a node may put ``source`` into ``whole``, its first operand, in place: later nodes read that buffer
        only to put the result where it already is."""
        if whole.buffer.fixed or source.buffer is whole.buffer:
            return False
        return all(
            self._order[user] <= self._order[node] or _puts_back(user, node, value, whole)
            for reader, value in self._values.get(whole.buffer.name, ())
            for user in reader.users
        )


def _puts_back(user: Node, node: Node, value: Any, whole: View) -> bool:
    part = PARTS.get(operation_name(user))
    if part is None or user.args[1] is not node or not isinstance(value, View):
        return False
    return is_same(value.view_as(part(value.meta, *user.args[2:])), whole)


def is_same(a: View, b: View) -> bool:
    """Whether two tensors are the same numbers in memory."""
    return a.buffer is b.buffer and all(
        f(a.meta) == f(b.meta) for f in (Tensor.size, Tensor.stride, Tensor.storage_offset)
    )


def _views(value: Any) -> Iterator[View]:
    if isinstance(value, View):
        yield value
    elif isinstance(value, Expression):
        yield from value.operands
    elif isinstance(value, (list, tuple, Rows)):
        for x in value.items if isinstance(value, Rows) else value:
            yield from _views(x)
