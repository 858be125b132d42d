"""A recorded graph as one C function: no library but the C one's mathematics, no allocation.

A filter's step is a list of core ATen operations on tensors of known shapes (:mod:`dlkf.onboard.recording`). Views of
a tensor are strides and offsets and cost nothing; an operation by elements is one loop nest, in which those that feed
it alone are written out; what depends on constants alone is computed here. The rest lies in one block of memory, in
which what is no longer needed makes room (:class:`dlkf.onboard.c_memory.Block`). What is needed on a condition alone
stands in an ``if`` (:mod:`dlkf.onboard.c_branches`).

The equations stay where they are, in torch: this knows operations, not filters.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any

import torch
from torch import Tensor
from torch.fx import GraphModule, Node

from dlkf.base.errors import InputError
from dlkf.onboard.c_branches import find_branches, find_choice
from dlkf.onboard.c_loops import WHOLE
from dlkf.onboard.c_memory import C_TYPES, Block, Buffer, Expression, Rows, Tensors, View
from dlkf.onboard.c_operations import BY_ELEMENT, COPIES, MANY, PARTS, literal, suffix, vectorise
from dlkf.onboard.c_pieces import SUMMED, write_sum
from dlkf.onboard.c_places import RESHAPES, Readers, find_places, is_same, operation_name
from dlkf.onboard.c_reductions import REDUCTIONS, UNKNOWN


class Translation(Tensors):
    """Walks a graph and writes it down."""

    def __init__(self, graph: GraphModule, block: Block | None = None, given: Sequence[View] = ()) -> None:
        """``given``, in a ``block`` of another function, are the inputs; the result goes into the first of them."""
        super().__init__(block)
        self.values: dict[Node, Any] = {}
        self.inputs: list[Buffer] = []
        self.outputs: list[View] = []
        self._given = list(given)
        self._on = find_branches(graph)
        self._module, self._readers, self._places = graph, Readers(graph), find_places(graph)
        self._held = _find_in_place_result(graph, given[0]) if given else _allocate_outputs(graph)
        self._conditions, self._open = set(self._on.values()), None
        for node in graph.graph.nodes:
            self._enter(self._on.get(node, find_choice(node, self._on)))
            getattr(self, f"_{node.op}")(node)
            self._readers.note(node, self.values.get(node))

    def write_graph(self, graph: GraphModule, given: Sequence[View]) -> None:
        """The lines of another graph, which changes the first of ``given``."""
        made = Translation(graph, self.block, given).outputs[0]
        if not is_same(made, given[0]):
            self.block.assign(given[0], "{0}", [made])

    # every kind of node

    def _placeholder(self, node: Node) -> None:
        if self._given:
            self.values[node] = self._given[len(self.values)]
            return
        value = node.meta["val"]
        buffer = Buffer(f"in{len(self.inputs)}", value.dtype, value.numel(), fixed=True)
        self.inputs.append(buffer)
        self.values[node] = View(buffer, torch.empty(value.shape, dtype=value.dtype, device="meta"))

    def _get_attr(self, node: Node) -> None:
        self.values[node] = getattr(self._module, str(node.target)).detach()

    def _call_function(self, node: Node) -> None:
        if not node.users or node in self.values:
            return
        target: Any = node.target
        args, kwargs = self._resolve(node.args), self._resolve(node.kwargs)
        if target.__name__ == "getitem":
            self.values[node] = args[0][args[1]]
            return
        name = target._schema.name.removeprefix("aten::")
        parts = [*_flatten(args), *_flatten(kwargs)]
        if not any(isinstance(a, (View, Expression, Rows)) for a in parts) and "val" in node.meta:
            self.values[node] = target(*args, **kwargs)  # known here
        elif name == "_assert_tensor_metadata":
            return
        elif _is_view(target):
            self.values[node] = self._make_view(node, target, args, kwargs)
        elif name in COPIES and _is_copy(args[0], node):
            self.values[node] = args[0]
        elif name in PARTS:
            self.values[node] = self._write_scatter(node, name, args)
        elif find_choice(node, self._on) is not None:
            self.values[node] = self._write_choice(node, args[1], args[2])
        elif name == SUMMED:
            self.values[node] = write_sum(self, node, *args)
        elif name in BY_ELEMENT:
            self.values[node] = self._translate_elementwise(node, name, args, kwargs)
        elif name in WHOLE:
            self.values[node] = WHOLE[name](self, node, *args, **kwargs)
        else:
            raise InputError(f"this filter uses {target}, which {UNKNOWN}")

    def _output(self, node: Node) -> None:
        made: Any = node.args[0]
        self.outputs = [self.tensor(self.values[n]) for n in (made if isinstance(made, (list, tuple)) else [made])]

    # operands

    def _resolve(self, x: Any) -> Any:
        if isinstance(x, Node):
            return self.values[x]
        if isinstance(x, (list, tuple)):
            return [self._resolve(a) for a in x]
        return {k: self._resolve(a) for k, a in x.items()} if isinstance(x, dict) else x

    def result(self, node: Node) -> View:
        """Memory for what an operation returns: a place in what joins it, if that has one for it."""
        if node not in self._held:
            self._held[node] = self._find_place(node) or super().result(node)
        return self._held[node]

    def _find_place(self, node: Node) -> View | None:
        if node not in self._places:
            return None
        holder, where = self._places[node]
        whole = self.result(holder)
        meta = where(whole.meta)
        return None if meta is None or meta.shape != node.meta["val"].shape else whole.view_as(meta)

    def may_stay_expression(self, node: Node) -> bool:
        """As there; views of rows are rows."""
        users = list(node.users)
        if len(users) != 1 or node in self._conditions:
            return False
        name = operation_name(users[0])
        return name in (*BY_ELEMENT, *REDUCTIONS, SUMMED) or (name in RESHAPES and self.may_stay_expression(users[0]))

    # branches

    def _enter(self, condition: Node | None) -> None:
        """The lines that follow are for a truth value alone, or for all."""
        if condition is self._open:
            return
        if self._open is not None:
            self.block.write("}")
        if condition is not None:
            on = self.tensor(self.values[condition])
            self.block.write(f"if ({on.at(['0'] * on.meta.ndim)}) {{", on)
        self._open = condition

    def _write_choice(self, node: Node, then: Any, otherwise: Any) -> View:
        """The branches' ends: one tensor in both."""
        out = self.result(node)
        for x, end in ((then, "} else {"), (otherwise, "}")):
            if isinstance(x, (View, Expression, Rows)) or (isinstance(x, Tensor) and x.numel() > 1):
                pattern, operands = self.expand_elements(x, out.meta.shape)
            else:
                pattern, operands = literal(x.item() if isinstance(x, Tensor) else x, out.meta.dtype), []
            if not (operands and is_same(operands[0], out)):
                self.block.assign(out, f"({C_TYPES[out.meta.dtype]}){pattern}", operands)
            self.block.write(end)
        self._open = None
        return out

    # kinds of operation

    def _make_view(self, node: Node, target: Any, args: list, kwargs: dict) -> Any:
        reshapes = isinstance(args[0], Rows) and operation_name(node) in RESHAPES
        if reshapes and (rows := args[0].view_as(node.meta["val"].shape)):
            return rows
        view = self.tensor(args[0])
        try:
            made = target(view.meta, *args[1:], **kwargs)
        except RuntimeError:  # strides that do not allow it
            view = self.dense(view)
            made = target(view.meta, *args[1:], **kwargs)
        return [view.view_as(m) for m in made] if isinstance(made, (list, tuple)) else view.view_as(made)

    def _translate_elementwise(self, node: Node, name: str, args: list, kwargs: dict) -> Any:
        value, keep = node.meta["val"], self.may_stay_expression(node)
        if name in ("sin", "cos") and (both := self._write_sincos(node, args[0])):
            return both
        rows = next((x for x in args if isinstance(x, Rows) and x.shape == value.shape), None)
        if rows is not None and not any(isinstance(x, Expression) for x in args):
            shape, items = rows.shape[len(rows.lead) :], []
            for index in product(*map(range, rows.lead)):
                operands = [self._take_row(x, rows, index) for x in args]
                items.append(self._make_expression(shape, value.dtype, name, operands, kwargs))
            x: Expression | Rows = Rows(rows.shape, value.dtype, rows.lead, items)
            return x if keep else self.store(node, x)
        x = self._make_expression(value.shape, value.dtype, name, args, kwargs)
        return x if keep and len(x.operands) <= 24 and value.numel() > 0 else self.store(node, x)

    def _write_sincos(self, node: Node, x: Any) -> View | None:
        """Of the same many angles, at once; None where one is wanted alone."""
        pair = {operation_name(user): user for user in node.args[0].users if user.args == node.args}  # type: ignore[union-attr]
        value = node.meta["val"]
        plain = isinstance(x, View) and x.meta.is_contiguous() and x.meta.dtype == torch.float64 == value.dtype
        if not plain or value.numel() < MANY or not {"sin", "cos"} <= pair.keys():
            return None
        if self._on.get(pair["sin"]) is not self._on.get(pair["cos"]):
            return None
        outs = [self.result(pair[name]) for name in ("sin", "cos")]
        if not all(out.meta.is_contiguous() for out in outs):
            outs = [self.block.new(value.shape, value.dtype) for _ in range(2)]
        at = ", ".join(f"&{v.at(['0'] * v.meta.ndim)[:-1]}+i]" for v in outs)
        angle = f"{x.at(['0'] * x.meta.ndim)[:-1]}+i]"
        self.block.write(f"for (int i = 0; i < {value.numel()}; i++) each_sincos({angle}, {at});", x, *outs)
        self.values |= {pair["sin"]: outs[0], pair["cos"]: outs[1]}
        return self.values[node]

    def _take_row(self, x: Any, rows: Rows, index: tuple[int, ...]) -> Any:
        """Of an operand what belongs to a row."""
        if isinstance(x, Rows) and x.lead == rows.lead:
            return x.at(index)
        if not isinstance(x, (View, Rows, Tensor)):
            return x
        view = self.tensor(x)
        return view.view_as(view.meta.expand(rows.shape)[index])

    def _make_expression(
        self, shape: torch.Size, dtype: torch.dtype, name: str, args: list, kwargs: dict
    ) -> Expression:
        pattern, operands = BY_ELEMENT[name], []
        if callable(pattern):
            pattern, args = pattern(dtype, args, kwargs)
        pattern = vectorise(pattern.replace("{f}", suffix(dtype)), shape.numel())
        segments = []
        for x in args:
            if isinstance(x, Expression) and x.shape == shape:
                first = len(operands)
                inner = x.pattern.format(*(f"{{{first + k}}}" for k in range(len(x.operands))))
                segments.append(f"({_cast(x.dtype, dtype)}({inner}))")
                operands += x.operands
            elif isinstance(x, (View, Expression, Rows)) or (isinstance(x, Tensor) and x.numel() > 1):
                view = self.tensor(x)
                segments.append(f"{_cast(view.meta.dtype, dtype)}{{{len(operands)}}}")
                operands.append(view.view_as(view.meta.expand(shape)))
            else:
                segments.append(literal(x.item() if isinstance(x, Tensor) else x, dtype))
        return Expression(shape, dtype, f"({C_TYPES[dtype]})({pattern.format(*segments)})", operands)

    def _write_scatter(self, node: Node, name: str, args: list) -> View:
        """An operation that changes a part: a copy, then the part."""
        whole, source = self.tensor(args[0]), self.tensor(args[1])
        out = whole
        if is_same(source, whole.view_as(PARTS[name](whole.meta, *args[2:]))):
            return whole
        if not self._readers.may_change(node, whole, source):
            out = self.result(node)
            self.block.assign(out, "{0}", [whole])
        part = out.view_as(PARTS[name](out.meta, *args[2:]))
        values = source.view_as(source.meta.expand(part.meta.shape))
        self.block.assign(part, f"({C_TYPES[out.meta.dtype]}){{0}}", [values])
        return out


def _allocate_outputs(graph: GraphModule) -> dict[Node, View]:
    """Memory of the caller for what a function returns."""
    returned: Any = next(node for node in graph.graph.nodes if node.op == "output").args[0]
    held: dict[Node, View] = {}
    for k, node in enumerate(returned if isinstance(returned, (list, tuple)) else [returned]):
        value = node.meta["val"]
        buffer = Buffer(f"out{k}", value.dtype, value.numel(), fixed=True)
        held.setdefault(node, View(buffer, torch.empty(value.shape, dtype=value.dtype, device="meta")))
    return held


def _find_in_place_result(graph: GraphModule, into: View) -> dict[Node, View]:
    """Memory of the first input for what a function returns, if nothing but the returned operation reads that."""
    nodes = list(graph.graph.nodes)
    made: Any = nodes[-1].args[0]
    made = made[0] if isinstance(made, (list, tuple)) else made
    while operation_name(made) in RESHAPES:
        made = made.args[0]
    read = nodes[0]
    while len(read.users) == 1 and operation_name(user := next(iter(read.users))) in RESHAPES:
        read = user
    alone = list(read.users) == [made] and operation_name(made) in ("baddbmm", *BY_ELEMENT)
    return {made: into.view_as(into.meta.view(made.meta["val"].shape))} if alone else {}


def _cast(given: torch.dtype, wanted: torch.dtype) -> str:
    """What makes the conversion of a wide integer to a floating number a visible one."""
    return "(double)" if wanted.is_floating_point and given == torch.int64 else ""


def _is_view(target: Any) -> bool:
    returns = target._schema.returns
    return bool(returns) and returns[0].alias_info is not None and not returns[0].alias_info.is_write


def _is_copy(x: Any, node: Node) -> bool:
    """Whether an operation returns the same numbers in the same order."""
    value = node.meta["val"]
    if not isinstance(x, View) or x.meta.dtype != value.dtype:
        return False
    return all(n == 1 or s == v for n, s, v in zip(value.shape, x.meta.stride(), value.stride()))


def _flatten(x: Any) -> list:
    if isinstance(x, (list, tuple)):
        return [b for a in x for b in _flatten(a)]
    return _flatten(list(x.values())) if isinstance(x, dict) else [x]
