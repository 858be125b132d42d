"""Core ATen operations that are loops of their own: solutions, indexing, joining, convolutions.

Each writes its lines and gives the tensor, or the list of them, that the operation returns.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.fx import Node

from dlkf.base.errors import InputError
from dlkf.onboard.c_memory import Expression, Tensors, View, loops
from dlkf.onboard.c_operations import literal, suffix
from dlkf.onboard.c_places import is_same
from dlkf.onboard.c_products import write_product, write_product_sum
from dlkf.onboard.c_reductions import ANY, LARGEST, SUM, UNKNOWN, make_reduction, mean, norm, running_sum, variance


def _allocate_result(t: Tensors, node: Node) -> tuple[View, Any]:
    """The result's memory, and what torch says of it."""
    value: Any = node.meta["val"]
    return t.result(node), value


def _index_names(count: int) -> list[str]:
    return [f"i{k}" for k in range(count)]


def _write_join(t: Tensors, node: Node, parts: list, dim: int = 0) -> View:
    out = t.result(node)
    start = 0
    for view in map(t.tensor, parts):
        if view.meta.numel():
            size = view.meta.shape[dim]
            place = out.view_as(out.meta.narrow(dim, start, size))
            if not is_same(place, view):
                t.block.assign(place, "{0}", [view])
            start += size
    return out


def _write_calls(t: Tensors, call: str, sizes: tuple[int, ...], *views: View) -> None:
    """A function of algebra.h for every matrix of a batch; ``sizes`` are the numbers of each matrix."""
    many, call = views[0].meta.shape[:-2].numel(), call.replace("(", f"{suffix(views[0].meta.dtype)}(", 1)
    places = [f"&{v.buffer.name}[{v.meta.storage_offset()}+b*{n}]" for v, n in zip(views, sizes)]
    t.block.write(f"for (int b = 0; b < {many}; b++) {call}{', '.join(places)});", *views)


def _write_solve(t: Tensors, node: Node, A: Any, B: Any, **_: Any) -> list:
    """A symmetric and positive definite."""
    a, b = t.dense(A), t.dense(B)
    out, work = t.block.new(b.meta.shape, b.meta.dtype), t.block.new(a.meta.shape, a.meta.dtype)
    m, n = b.meta.shape[-2:]
    _write_calls(t, f"solve({m}, {n}, ", (m * m, m * n, m * m, m * n), a, b, work, out)
    return [out, None, None, None]


def _write_cholesky(t: Tensors, node: Node, A: Any, **_: Any) -> list:
    a = t.dense(A)
    out, m = t.block.new(a.meta.shape, a.meta.dtype), a.meta.shape[-1]
    _write_calls(t, f"factor({m}, ", (m * m, m * m), a, out)
    return [out, None]


def _write_cholesky_solve(t: Tensors, node: Node, B: Any, L: Any, upper: bool = False) -> View:
    b, factor = t.dense(B), t.dense(L)
    out = t.block.new(b.meta.shape, b.meta.dtype)
    m, n = b.meta.shape[-2:]
    _write_calls(t, f"back({m}, {n}, ", (m * m, m * n, m * n), factor, b, out)
    return out


def _write_triangular_solve(
    t: Tensors, node: Node, L: Any, B: Any, *, upper: bool, left: bool = True, unitriangular: bool = False
) -> View:
    """L X = B, L lower triangular. InputError for another form."""
    if upper or not left or unitriangular:
        raise InputError(f"this filter solves a triangular system other than L X = B, which {UNKNOWN}")
    factor, b = t.dense(L), t.dense(B)
    out = t.block.new(b.meta.shape, b.meta.dtype)
    m, n = b.meta.shape[-2:]
    _write_calls(t, f"forward({m}, {n}, ", (m * m, m * n, m * n), factor, b, out)
    return out


def _write_inverse(t: Tensors, node: Node, A: Any, **_: Any) -> list:
    a = t.dense(A)
    if a.meta.shape[-1] != 3:
        raise InputError(f"this filter inverts other than 3x3 matrices, which {UNKNOWN}")
    out = t.block.new(a.meta.shape, a.meta.dtype)
    _write_calls(t, "invert3(", (9, 9), a, out)
    return [out, None]


def _write_cross(t: Tensors, node: Node, A: Any, B: Any, *, dim: int = -1) -> View:
    out, value = _allocate_result(t, node)
    a, b = (v.view_as(v.meta.expand(value.shape)) for v in (t.tensor(A), t.tensor(B)))
    for k in range(3):
        parts = [v.view_as(v.meta.select(dim, j % 3)) for v, j in ((a, k + 1), (b, k + 2), (a, k + 2), (b, k + 1))]
        t.block.assign(out.view_as(out.meta.select(dim, k)), "{0} * {1} - {2} * {3}", parts)
    return out


def _write_index_select(t: Tensors, node: Node, x: Any, dim: int, index: Any) -> View | Expression:
    return _write_index(t, node, x, [None] * (dim % t.tensor(x).meta.ndim) + [index])


def _write_index(t: Tensors, node: Node, x: Any, indices: list) -> View | Expression:
    """x[…, i, j, …] with tensors side by side that broadcast, None for a whole axis."""
    view, value = t.tensor(x), node.meta["val"]
    if t.may_stay_expression(node) and all(i is None or isinstance(i, Tensor) for i in indices):
        return _index_by_table(t, view, indices)
    out = t.result(node)
    names = _index_names(value.ndim)
    source, given = _locate_elements(t, view, indices, names)
    t.block.write(f"{loops(names, value.shape)}{out.at(names)} = {view.at(source)};", out, view, *given)
    return out


def _index_by_table(t: Tensors, view: View, indices: list) -> Expression:
    """The same with constants, element by element: by a table of where each is in memory."""
    shape, stride, offset = view.meta.shape, view.meta.stride(), view.meta.storage_offset()
    last = sum((n - 1) * s for n, s in zip(shape, stride))
    places = torch.arange(last + 1, dtype=torch.int32).as_strided(shape, stride)
    table = t.block.constant(places[tuple(slice(None) if i is None else i for i in indices)])
    source = view.view_as(torch.as_strided(view.meta, table.meta.shape, [0] * table.meta.ndim))
    return Expression(table.meta.shape, view.meta.dtype, f"({view.buffer.name}+{offset})[{{0}}]", [table, source])


def _write_index_put(t: Tensors, node: Node, x: Any, indices: list, values: Any, accumulate: bool = False) -> View:
    """x[…, i, j, …] = values, or += of a copy."""
    view, outputs, (out, _) = t.tensor(x), t.tensor(values), _allocate_result(t, node)
    t.block.assign(out, "{0}", [view])
    chosen = [t.tensor(i).meta for i in indices if i is not None]
    shape = torch.broadcast_shapes(*(i.shape for i in chosen))
    first = next(k for k, i in enumerate(indices) if i is not None)
    sizes = [*view.meta.shape[:first], *shape, *view.meta.shape[first + len(chosen) :]]
    names = _index_names(len(sizes))
    target, given = _locate_elements(t, view, indices, names)
    wide = outputs.view_as(outputs.meta.expand(sizes))
    sign = "+=" if accumulate else "="
    t.block.write(f"{loops(names, sizes)}{out.at(target)} {sign} {wide.at(names)};", out, outputs, *given)
    return out


def _locate_elements(t: Tensors, view: View, indices: list, names: list[str]) -> tuple[list[str], list[View]]:
    """Where an element of x[indices] comes from, and the tensors that say so."""
    given = {k: t.tensor(i) for k, i in enumerate(indices) if i is not None}
    first = min(given)
    if max(given) - first != len(given) - 1:
        raise InputError(f"this filter indexes axes that are not neighbours, which {UNKNOWN}")
    shape = torch.broadcast_shapes(*(i.meta.shape for i in given.values()))
    inner = names[first : first + len(shape)]
    rest = iter(names[:first] + names[first + len(shape) :])
    chosen = {k: i.view_as(i.meta.expand(shape)).at(inner) for k, i in given.items()}
    return [chosen[k] if k in chosen else next(rest) for k in range(view.meta.ndim)], list(given.values())


def _write_gather(t: Tensors, node: Node, x: Any, dim: int, index: Any, **_: Any) -> View:
    view, rows, (out, value) = t.tensor(x), t.tensor(index), _allocate_result(t, node)
    names = _index_names(value.ndim)
    source = [rows.at(names) if k == dim % value.ndim else i for k, i in enumerate(names)]
    t.block.write(f"{loops(names, value.shape)}{out.at(names)} = {view.at(source)};", out, view, rows)
    return out


def _write_argmax(t: Tensors, node: Node, x: Any, dim: int = -1, keepdim: bool = False) -> View:
    """Where the largest element is."""
    view, (out, _) = t.tensor(x), _allocate_result(t, node)
    names, dim = _index_names(view.meta.ndim), dim % view.meta.ndim
    outer = [k for k in range(view.meta.ndim) if k != dim]
    at = out.at([("0" if k == dim else i) for k, i in enumerate(names)] if keepdim else [names[k] for k in outer])
    best = view.at([("best" if k == dim else i) for k, i in enumerate(names)])
    t.block.write(
        f"{loops([names[k] for k in outer], [view.meta.shape[k] for k in outer])}{{ int best = 0; "
        f"{loops([names[dim]], [view.meta.shape[dim]])}if ({view.at(names)} > {best}) best = {names[dim]}; "
        f"{at} = best; }}",
        out, view,
    )  # fmt: skip
    return out


def _write_convolution(
    t: Tensors, node: Node, X: Any, W: Any, bias: Any,
    stride: list, padding: list, dilation: list, transposed: bool, _: list, groups: int,
) -> View:  # fmt: skip
    """Over one axis, zeros outside. InputError for strides, dilation, groups, transposition."""
    if not stride == dilation == [1] or transposed or groups != 1:
        raise InputError(f"this network has a convolution other than of stride, dilation and groups 1, which {UNKNOWN}")
    x, w, (out, value) = t.tensor(X), t.tensor(W), _allocate_result(t, node)
    (inward, M), (outward, _inward, taps), pad, n = x.meta.shape[1:], w.meta.shape, padding[0], value.shape[2]
    b = [] if bias is None else [t.tensor(bias)]
    start, at, source = b[0].at(["o"]) if b else "0", out.at(["0", "o", "n"]), x.at(["0", "c", f"(n + k - {pad})"])
    t.block.write(
        f"for (int o = 0; o < {outward}; o++) {{ for (int n = 0; n < {n}; n++) {at} = {start}; "
        f"for (int c = 0; c < {inward}; c++) for (int k = 0; k < {taps}; k++) {{ "
        f"int low = {pad} > k ? {pad} - k : 0, high = {M + pad} - k < {n} ? {M + pad} - k : {n}; "
        f"for (int n = low; n < high; n++) {at} += {w.at(['o', 'c', 'k'])} * {source}; }} }}",
        out, x, w, *b,
    )  # fmt: skip
    return out


def _write_padding(t: Tensors, node: Node, x: Any, pad: list, fill: float = 0.0) -> View:
    view, (out, value) = t.tensor(x), _allocate_result(t, node)
    t.block.assign(out, literal(fill, value.dtype), [])
    part = out.meta
    for k in range(len(pad) // 2):
        axis = part.ndim - 1 - k
        part = part.narrow(axis, pad[2 * k], view.meta.shape[axis])
    t.block.assign(out.view_as(part), "{0}", [view])
    return out


def _write_repeat(t: Tensors, node: Node, x: Any, times: list) -> View:
    view, (out, _) = t.tensor(x), _allocate_result(t, node)
    shape = (*(1,) * (len(times) - view.meta.ndim), *view.meta.shape)
    place = out.meta.view([n for pair in zip(times, shape) for n in pair])
    source = view.meta.reshape(shape)
    for axis in range(len(times)):
        source = source.unsqueeze(2 * axis)
    t.block.assign(out.view_as(place), "{0}", [view.view_as(source.expand(place.shape))])
    return out


WHOLE: dict[str, Callable[..., Any]] = {
    "cat": _write_join, "sum": make_reduction(SUM), "any": make_reduction(ANY, "{0} != 0"),
    "amax": make_reduction(LARGEST), "mean": mean, "var": variance, "linalg_vector_norm": norm,
    "cumsum": running_sum, "mm": write_product, "bmm": write_product, "addmm": write_product_sum,
    "baddbmm": write_product_sum, "_linalg_solve_ex": _write_solve, "linalg_solve_ex": _write_solve,
    "linalg_cholesky_ex": _write_cholesky, "cholesky_solve": _write_cholesky_solve, "linalg_inv_ex": _write_inverse,
    "linalg_solve_triangular": _write_triangular_solve, "linalg_cross": _write_cross,
    "index_select": _write_index_select, "index": _write_index, "index_put": _write_index_put,
    "gather": _write_gather, "argmax": _write_argmax, "convolution": _write_convolution,
    "constant_pad_nd": _write_padding, "repeat": _write_repeat,
}  # fmt: skip
