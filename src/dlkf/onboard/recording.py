"""What torch does in a function: a graph of core ATen operations on tensors of known shapes, none of them in place."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import Any, Protocol

import torch
from torch.func import functionalize
from torch.fx import GraphModule, Node
from torch.fx.experimental.proxy_tensor import make_fx

from dlkf.navigation import compiled

KEPT = {  # operations that are one in C, though core ATen has several for them
    "aten::linalg_cross", "aten::linalg_solve_ex", "aten::_linalg_solve_ex", "aten::linalg_cholesky_ex",
    "aten::cholesky_solve", "aten::linalg_inv_ex", "aten::linalg_solve_triangular", "aten::baddbmm",
    "aten::select_scatter", "aten::unfold",
}  # fmt: skip


class Recordable(Protocol):
    """A function of tensors, and such tensors."""

    def example(self) -> tuple[torch.Tensor, ...]:
        """Arguments of the shapes that the function takes."""
        ...

    def __call__(self, *args: torch.Tensor) -> Any:
        """The function."""
        ...


def record(function: Recordable) -> GraphModule:
    """The graph of a function at its ``example()``; its constants are attributes."""
    example = function.example()
    function(*example)  # constants that it keeps for later calls are made here, not as tensors of the recorder
    graph: Any = function
    whole: Any = function
    try:
        for _ in range(2):  # what is changed in place shows in the first graph and is gone in the second
            recorder = make_fx(functionalize(graph), _decompositions(), "fake", _allow_non_fake_inputs=True)
            graph = recorder(*example)
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
def exporting() -> Iterator[None]:
    """Inside the block filters run as ``torch.export`` can record them."""
    with compiled.tensor_forms(), torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # of torch about torch
        yield


@lru_cache
def _decompositions() -> dict[Any, Any]:
    table: dict[Any, Any] = dict(torch.export.default_decompositions())
    return {operation: f for operation, f in table.items() if operation._schema.name not in KEPT}


def _is_in_place(target: Any) -> bool:
    return isinstance(target, torch._ops.OpOverload) and target._schema.is_mutable
