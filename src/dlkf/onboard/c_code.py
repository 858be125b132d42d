"""A recorded graph as one C function: no library but the C one's mathematics, no allocation, no branch on data.

A filter's step is a list of core ATen operations on tensors of known shapes (:mod:`dlkf.onboard.recording`). Views of
a tensor are strides and offsets and cost nothing; an operation by elements is one loop nest, in which those that feed
it alone are written out; what depends on constants alone is computed here. The rest lies in one block on the stack,
in which what is no longer needed makes room (:class:`dlkf.onboard.c_memory.Block`).

The equations stay where they are, in torch: this knows operations, not filters.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.fx import GraphModule, Node

from dlkf.base.errors import InputError
from dlkf.onboard.c_loops import UNKNOWN, WHOLE
from dlkf.onboard.c_memory import C_TYPES, Buffer, Expression, Tensors, View
from dlkf.onboard.c_operations import BY_ELEMENT, PARTS, literal
from dlkf.onboard.c_reductions import REDUCTIONS


class Translation(Tensors):
    """Walks a graph and writes it down."""

    def __init__(self, graph: GraphModule) -> None:
        super().__init__()
        self.values: dict[Node, Any] = {}
        self.inputs: list[Buffer] = []
        self.outputs: list[View] = []
        self._module = graph
        for node in graph.graph.nodes:
            getattr(self, f"_{node.op}")(node)

    # every kind of node

    def _placeholder(self, node: Node) -> None:
        value = node.meta["val"]
        buffer = Buffer(f"in{len(self.inputs)}", value.dtype, value.numel(), fixed=True)
        self.inputs.append(buffer)
        self.values[node] = View(buffer, torch.empty(value.shape, dtype=value.dtype, device="meta"))

    def _get_attr(self, node: Node) -> None:
        self.values[node] = getattr(self._module, str(node.target)).detach()

    def _call_function(self, node: Node) -> None:
        if not node.users:
            return
        target: Any = node.target
        args, kwargs = self._known(node.args), self._known(node.kwargs)
        if target.__name__ == "getitem":
            self.values[node] = args[0][args[1]]
            return
        name = target._schema.name.removeprefix("aten::")
        parts = [*_flat(args), *_flat(kwargs)]
        if not any(isinstance(a, (View, Expression)) for a in parts) and "val" in node.meta:
            self.values[node] = target(*args, **kwargs)  # known here
        elif name == "_assert_tensor_metadata":
            return
        elif _is_view(target):
            self.values[node] = self._viewed(target, args, kwargs)
        elif name in PARTS:
            self.values[node] = self._copied(node, name, args)
        elif name in BY_ELEMENT:
            self.values[node] = self._by_element(node, name, args, kwargs)
        elif name in WHOLE:
            self.values[node] = WHOLE[name](self, node, *args, **kwargs)
        else:
            raise InputError(f"this filter uses {target}, which {UNKNOWN}")

    def _output(self, node: Node) -> None:
        made: Any = node.args[0]
        self.outputs = [self.tensor(self.values[n]) for n in (made if isinstance(made, (list, tuple)) else [made])]

    # operands

    def _known(self, x: Any) -> Any:
        if isinstance(x, Node):
            return self.values[x]
        if isinstance(x, (list, tuple)):
            return [self._known(a) for a in x]
        return {k: self._known(a) for k, a in x.items()} if isinstance(x, dict) else x

    # kinds of operation

    def _viewed(self, target: Any, args: list, kwargs: dict) -> Any:
        view = self.tensor(args[0])
        try:
            made = target(view.meta, *args[1:], **kwargs)
        except RuntimeError:  # strides that do not allow it
            view = self.dense(view)
            made = target(view.meta, *args[1:], **kwargs)
        return [view.viewed(m) for m in made] if isinstance(made, (list, tuple)) else view.viewed(made)

    def _by_element(self, node: Node, name: str, args: list, kwargs: dict) -> Any:
        value = node.meta["val"]
        pattern, operands = BY_ELEMENT[name], []
        if callable(pattern):
            pattern, args = pattern(value.dtype, args, kwargs)
        segments = []
        for x in args:
            if isinstance(x, Expression) and x.shape == value.shape:
                first = len(operands)
                inner = x.pattern.format(*(f"{{{first + k}}}" for k in range(len(x.operands))))
                segments.append(f"({_cast(x.dtype, value.dtype)}({inner}))")
                operands += x.operands
            elif isinstance(x, (View, Expression)) or (isinstance(x, Tensor) and x.numel() > 1):
                view = self.tensor(x)
                segments.append(f"{_cast(view.meta.dtype, value.dtype)}{{{len(operands)}}}")
                operands.append(view.viewed(view.meta.expand(value.shape)))
            else:
                segments.append(literal(x.item() if isinstance(x, Tensor) else x, value.dtype))
        expression = Expression(
            value.shape, value.dtype, f"({C_TYPES[value.dtype]})({pattern.format(*segments)})", operands
        )
        alone = len(node.users) == 1 and len(operands) <= 12 and value.numel() > 0
        return expression if alone and _goes_on(next(iter(node.users))) else self.tensor(expression)

    def _copied(self, node: Node, name: str, args: list) -> View:
        """An operation that changes a part: a copy, then the part."""
        whole = self.tensor(args[0])
        out = self.block.new(whole.meta.shape, whole.meta.dtype)
        self.block.over(out, "{0}", [whole])
        part = PARTS[name](out.meta, *args[2:])
        source = self.tensor(args[1])
        values = source.viewed(source.meta.expand(part.shape))
        self.block.over(out.viewed(part), f"({C_TYPES[out.meta.dtype]}){{0}}", [values])
        return out


def _cast(given: torch.dtype, wanted: torch.dtype) -> str:
    """What makes the conversion of a wide integer to a floating number a visible one."""
    return "(double)" if wanted.is_floating_point and given == torch.int64 else ""


def _is_view(target: Any) -> bool:
    returns = target._schema.returns
    return bool(returns) and returns[0].alias_info is not None and not returns[0].alias_info.is_write


def _goes_on(user: Node) -> bool:
    """Whether a value may stay an expression: its only user takes each element once."""
    schema = getattr(user.target, "_schema", None)
    return schema is not None and schema.name.removeprefix("aten::") in (*BY_ELEMENT, *REDUCTIONS)


def _flat(x: Any) -> list:
    if isinstance(x, (list, tuple)):
        return [b for a in x for b in _flat(a)]
    return _flat(list(x.values())) if isinstance(x, dict) else [x]
