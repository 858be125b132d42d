"""What torch does in a function: a graph of core ATen operations on tensors of known shapes, none of them in place."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from operator import getitem
from typing import Any, Protocol

import torch
from torch import Tensor
from torch.func import functionalize
from torch.fx import Graph, GraphModule, Node
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_map_only

from dlkf.navigation import compiled

KEPT = {  # operations that are one in C, though core ATen has several for them
    "aten::linalg_cross", "aten::linalg_solve_ex", "aten::_linalg_solve_ex", "aten::linalg_cholesky_ex",
    "aten::cholesky_solve", "aten::linalg_inv_ex", "aten::linalg_solve_triangular", "aten::baddbmm",
    "aten::select_scatter", "aten::unfold", "aten::addcmul", "aten::lerp", "aten::rad2deg",
}  # fmt: skip
LIFT, COPY = torch.ops.aten.lift_fresh.default, torch.ops.aten.lift_fresh_copy.default
INDEX = torch.ops.aten.index.Tensor
SAME = {torch.ops.aten.alias.default, torch.ops.aten.detach.default}  # the same numbers in another tensor


class Recordable(Protocol):
    """A function of tensors, and such tensors."""

    def example(self) -> tuple[torch.Tensor, ...]:
        """Arguments of the shapes that the function takes."""
        ...

    def __call__(self, *args: torch.Tensor) -> Any:
        """The function."""
        ...


class ValueDependence(Exception):
    """A value in Python, a shape or a random number that no graph can follow."""


class NoValues(TorchFunctionMode):
    """Refuses the ways on which values leave a tensor without an operation."""

    def __torch_function__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        if func in (Tensor.numpy, Tensor.__array__, Tensor.__dlpack__, Tensor.__repr__):
            raise ValueDependence(f"{func.__name__} takes values out of a tensor")
        return func(*args, **(kwargs or {}))


class Recorder(TorchDispatchMode):
    """Runs operations and notes each in a graph: what ``make_fx`` does, on tensors with values, in a fifth of its time.

    A tensor that is neither an input nor the result of an operation is a constant, an attribute of the graph.
    Raises ValueDependence where a value in Python, or a shape, depends on values of the inputs, and for random numbers.
    """

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        """No: that would load torch's compiler, which takes seconds and which this does without."""
        return False

    def __init__(self, inputs: tuple[Tensor, ...]) -> None:
        super().__init__()
        self.graph, self.constants = Graph(), torch.nn.Module()
        self._nodes: dict[int, Node] = {}
        self._tensors: list[Tensor] = []  # so that no other tensor gets the identity of one that is gone
        self._varies: set[int] = set()  # tensors that depend on the inputs
        for k, x in enumerate(inputs):
            self._note(x, self.graph.placeholder(f"in_{k}"), True)

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        kwargs = kwargs or {}
        if func in SAME:
            made, x = func(*args, **kwargs), args[0]
            self._note(made, self.node(x), id(x) in self._varies)
            return made
        simpler: Callable[..., Any] | None = _decompositions().get(func)
        if simpler is None and _is_composite(func):
            simpler = func.decompose
        if simpler is not None:
            with self:
                made = simpler(*args, **kwargs)
            if made is not NotImplemented:
                return made
        varies = any(id(x) in self._varies for x in _iterate_tensors((args, kwargs)))
        takes_value = torch.Tag.data_dependent_output in func.tags
        if varies and (takes_value or self._has_shape_of_values(func, args)):
            raise ValueDependence(f"what {func} gives depends on values of a tensor")
        if torch.Tag.nondeterministic_seeded in func.tags:
            raise ValueDependence(f"{func} is random")
        if takes_value:
            return func(*args, **kwargs)
        func = COPY if func is LIFT else func
        made = func(*args, **kwargs)
        node = self.graph.call_function(func, *tree_map_only(Tensor, self.node, (args, kwargs)))
        if isinstance(made, Tensor):
            self._note(made, node, varies)
        elif isinstance(made, (tuple, list)):
            node.meta["val"] = made
            for k, part in enumerate(made):
                if isinstance(part, Tensor):
                    self._note(part, self.graph.call_function(getitem, (node, k)), varies)
        return made

    def node(self, x: Tensor) -> Node:
        """The node that makes a tensor; a tensor that none has made is a constant."""
        if id(x) not in self._nodes:
            name = f"constant_{len(self._tensors)}"
            setattr(self.constants, name, x)
            self._note(x, self.graph.get_attr(name), False)
        return self._nodes[id(x)]

    def _has_shape_of_values(self, func: Any, args: tuple[Any, ...]) -> bool:
        if func is INDEX:  # by positions, or by a constant mask, the shape is known
            masks = (x for x in _iterate_tensors(args[1]) if x.dtype in (torch.bool, torch.uint8))
            return any(id(x) in self._varies for x in masks)
        return torch.Tag.dynamic_output_shape in func.tags

    def _note(self, x: Tensor, node: Node, varies: bool) -> None:
        node.meta.setdefault("val", x)
        self._nodes[id(x)] = node
        self._tensors.append(x)
        if varies:
            self._varies.add(id(x))

    def finish(self, made: Any) -> GraphModule:
        """The graph of what was recorded, that returns these tensors."""
        self.graph.output(tree_map_only(Tensor, self.node, made))
        return GraphModule(self.constants, self.graph)


def record(function: Recordable) -> GraphModule:
    """The graph of a function at its ``example()``; its constants are attributes."""
    example = tuple(x.clone() for x in function.example())  # none of them is a constant, or given twice
    function(*example)  # constants that it keeps for later calls are made here, not as tensors of the recorder
    graph: Any = function
    whole: Any = function
    try:
        for _ in range(2):  # what is changed in place shows in the first graph and is gone in the second
            recorder = Recorder(example)
            with NoValues(), recorder:
                made = functionalize(graph)(*example)
            graph = recorder.finish(made)
            if not any(node.op == "call_function" and _is_in_place(node.target) for node in graph.graph.nodes):
                break
    except RuntimeError:  # it writes into what it has made of constants alone: the slower way knows them as inputs
        program = torch.export.export(whole, example, strict=False).run_decompositions(_decompositions())
        return program.module(check_guards=False)
    _merge_equal(graph)
    for node in graph.graph.nodes:
        if node.target is torch.ops.aten._linalg_check_errors.default:  # C raises nothing
            graph.graph.erase_node(node)
    graph.graph.eliminate_dead_code()  # views of what was there before a change, too
    return graph


def _merge_equal(graph: GraphModule) -> None:
    """One node for operations that are the same on the same tensors."""
    seen: dict[str, Node] = {}
    for node in graph.graph.nodes:
        if node.op in ("call_function", "get_attr"):
            what = id(getattr(graph, str(node.target))) if node.op == "get_attr" else node.target
            first = seen.setdefault(f"{what} {node.args} {node.kwargs}", node)
            if first is not node:
                node.replace_all_uses_with(first)


@contextmanager
def export_mode() -> Iterator[None]:
    """Inside the block filters run as :func:`record` can record them."""
    with compiled.tensor_forms(), torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # of torch about torch
        yield


@lru_cache
def _decompositions() -> dict[Any, Any]:
    table: dict[Any, Any] = dict(torch.export.default_decompositions())
    return {operation: f for operation, f in table.items() if operation._schema.name not in KEPT}


def _is_in_place(target: Any) -> bool:
    return isinstance(target, torch._ops.OpOverload) and target._schema.is_mutable


@lru_cache
def _is_composite(func: Any) -> bool:
    """Whether torch runs it as other operations."""
    return func._can_decompose() and not torch._C._dispatch_has_kernel_for_dispatch_key(func.name(), "CPU")


def _iterate_tensors(x: Any) -> Iterator[Tensor]:
    if isinstance(x, Tensor):
        yield x
    elif isinstance(x, (tuple, list)):
        for part in x:
            yield from _iterate_tensors(part)
    elif isinstance(x, dict):
        yield from _iterate_tensors(list(x.values()))
