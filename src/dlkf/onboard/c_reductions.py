"""Sums, means, largest elements and running sums, as loops that a compiler can vectorise.

C adds in the order in which a sum is written, so a long sum along memory is written as ``LANES`` sums beside each
other, a short one as one expression, and one across memory keeps its results in registers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import product
from typing import Any, NamedTuple

import torch
from torch.fx import Node

from dlkf.base.errors import InputError
from dlkf.onboard.c_memory import C_TYPES, Expression, Rows, Tensors, View, collapse_loops, loops
from dlkf.onboard.c_operations import suffix

UNKNOWN = "the C form of an exported filter does not know"
TERMS = 8  # of a sum that is written as one expression
REDUCTIONS = ("sum", "any", "mean", "linalg_vector_norm", "cumsum")  # that read each element once
LANES = 8  # sums beside each other
KEPT = 64  # results that are kept in registers, or near


class Reduction(NamedTuple):
    """How a result {0} takes up an element {1}, and what it begins with."""

    joined: str
    first: str


SUM, ANY = Reduction("{0} + {1}", "0"), Reduction("{0} | {1}", "0")
LARGEST = Reduction("{0} > {1} ? {0} : {1}", "-INFINITY")


class Reduced(NamedTuple):
    """Elements (shape of ``of``) that go into results (shape of the axes that are kept), one for each place there."""

    into: View
    of: Expression
    kept: Sequence[int]
    gone: Sequence[int]
    how: Reduction


def normalise_axes(dims: Any, ndim: int) -> list[int]:
    """Axes counted from the front; None and [] are all of them."""
    listed = range(ndim) if dims in (None, []) else [dims] if isinstance(dims, int) else dims
    return [d % ndim for d in listed]


def make_reduction(how: Reduction, element: str = "{0}") -> Callable[..., View]:
    """The operation that reduces what ``element`` makes of every element."""

    def reduce(t: Tensors, node: Node, x: Any, dims: Any = None, keepdim: bool = False, **_: Any) -> View:
        if isinstance(x, Rows) and how is SUM and element == "{0}" and (lines := _sum_rows(x, dims, keepdim)):
            return t.store(node, lines)
        x = t.elements(t.tensor(x) if how is LARGEST else x)  # each is read twice
        x = Expression(x.shape, x.dtype, element.format(x.pattern), x.operands)
        out, gone = t.result(node), normalise_axes(dims, len(x.shape))
        into = out.meta
        for d in sorted(gone, reverse=True) if keepdim else ():
            into = into.select(d, 0)
        write_reduction(t, Reduced(out.view_as(into), x, [d for d in range(len(x.shape)) if d not in gone], gone, how))
        return out

    return reduce


def _sum_rows(x: Rows, dims: Any, keepdim: bool) -> Rows | None:
    """Sums of few rows; None where that is something else."""
    gone = normalise_axes(dims, len(x.shape))
    if len(gone) > 1 or gone[0] >= len(x.lead) or keepdim or x.lead[gone[0]] > TERMS:
        return None
    kept = [n for d, n in enumerate(x.lead) if d != gone[0]]
    items = []
    for place in product(*map(range, kept)):
        terms = [x.at((*place[: gone[0]], k, *place[gone[0] :])) for k in range(x.lead[gone[0]])]
        items.append(join_terms(SUM.joined, terms))
    shape = torch.Size([*kept, *x.shape[len(x.lead) :]])
    return Rows(shape, x.dtype, torch.Size(kept), items)


def write_reduction(t: Tensors, r: Reduced) -> None:
    """The loops."""
    r = _merge_axes(r)
    x, count = r.of, math.prod(r.of.shape[d] for d in r.gone)
    if r.how is not LARGEST and 0 < count <= TERMS and count * len(x.operands) <= 4 * TERMS:
        _write_terms(t, r)
        return
    along = [d for d in r.gone if x.shape[d] >= 2 * LANES and all(v.meta.stride(d) <= 1 for v in x.operands)]
    along = [d for d in along if any(v.meta.stride(d) for v in x.operands)]
    if along:
        _write_lanes(t, r, along[-1])
    else:
        _write_across(t, r)


def _merge_axes(r: Reduced) -> Reduced:
    """With one axis for those that are gone, where all operands have them as one in memory."""
    operands, gone, kept = r.of.operands, sorted(r.gone), r.kept
    sizes, strides = collapse_loops([r.of.shape[d] for d in gone], [[v.meta.stride(d) for d in gone] for v in operands])
    if len(gone) < 2 or len(sizes) != 1:
        return r
    shape = torch.Size([*(r.of.shape[d] for d in kept), *sizes])
    flat = [
        v.view_as(torch.as_strided(v.meta, shape, [*(v.meta.stride(d) for d in kept), *s], v.meta.storage_offset()))
        for v, s in zip(operands, strides)
    ]
    elements = Expression(shape, r.of.dtype, r.of.pattern, flat)
    return Reduced(r.into, elements, list(range(len(kept))), [len(kept)], r.how)


def _write_terms(t: Tensors, r: Reduced) -> None:
    """One expression."""
    terms = []
    for place in product(*(range(r.of.shape[d]) for d in r.gone)):
        operands = []
        for view in r.of.operands:
            meta = view.meta
            for d, k in sorted(zip(r.gone, place), reverse=True):
                meta = meta.select(d, k)
            operands.append(view.view_as(meta))
        terms.append(Expression(r.into.meta.shape, r.of.dtype, r.of.pattern, operands))
    total = join_terms(r.how.joined, terms)
    t.block.assign(r.into, total.pattern, total.operands)


def join_terms(how: str, terms: Sequence[Expression]) -> Expression:
    """One expression of several."""
    total, operands = "", []
    for x in terms:
        term = f"({x.pattern.format(*(f'{{{len(operands) + k}}}' for k in range(len(x.operands))))})"
        total = how.format(total, term) if total else term
        operands += x.operands
    return Expression(terms[0].shape, terms[0].dtype, total, operands)


def _write_lanes(t: Tensors, r: Reduced, along: int) -> None:
    """Along memory, ``LANES`` beside each other."""
    n, kind, each = r.of.shape[along], C_TYPES[r.into.meta.dtype], f"y[l] = {r.how.joined}"
    names = [f"i{d}" for d in range(len(r.of.shape))]
    others = [d for d in r.gone if d != along]

    def term(place: str) -> str:
        names[along] = place
        return f"({r.of.pattern.format(*(v.at(names) for v in r.of.operands))})"

    whole, rest = n - n % LANES, n % LANES
    lines = [f"{kind} y[{LANES}]; for (int l = 0; l < {LANES}; l++) y[l] = {r.how.first};", _loops(r, others) + "{"]
    lines.append(f"for (int k = 0; k < {whole}; k += {LANES}) for (int l = 0; l < {LANES}; l++)")
    lines.append(each.format("y[l]", term("(k+l)")) + ";")
    if rest:
        lines.append(f"for (int l = 0; l < {rest}; l++) {each.format('y[l]', term(f'(l+{whole})'))};")
    lines.append("}")
    half = LANES // 2
    while half > 1:
        lines.append(f"for (int l = 0; l < {half}; l++) {each.format('y[l]', f'y[l+{half}]')};")
        half //= 2
    lines.append(f"{r.into.at([f'i{d}' for d in r.kept])} = {r.how.joined.format('y[0]', 'y[1]')};")
    t.block.write(f"{_loops(r, r.kept)}{{ {' '.join(lines)} }}", r.into, *r.of.operands)


def _write_across(t: Tensors, r: Reduced) -> None:
    """Across memory: results of the last kept axis beside each other."""
    kind, names = C_TYPES[r.into.meta.dtype], [f"i{d}" for d in range(len(r.of.shape))]
    term = f"({r.of.pattern.format(*(v.at(names) for v in r.of.operands))})"
    into = r.into.at([f"i{d}" for d in r.kept])
    if r.kept and r.of.shape[r.kept[-1]] > KEPT:
        t.block.assign(r.into, r.how.first, [])
        every = _loops(r, [*r.gone, *r.kept])
        t.block.write(f"{every}{into} = {r.how.joined.format(into, term)};", r.into, *r.of.operands)
        return
    last = r.kept[-1:]
    at, size = (f"y[i{last[0]}]", r.of.shape[last[0]]) if last else ("y[0]", 1)
    beside = _loops(r, last)
    t.block.write(
        f"{_loops(r, r.kept[:-1])}{{ {kind} y[{size}]; {beside}{at} = {r.how.first}; "
        f"{_loops(r, r.gone)}{beside}{at} = {r.how.joined.format(at, term)}; {beside}{into} = {at}; }}",
        r.into, *r.of.operands,
    )  # fmt: skip


def _loops(r: Reduced, dims: Sequence[int]) -> str:
    return loops([f"i{d}" for d in dims], [r.of.shape[d] for d in dims])


def norm(t: Tensors, node: Node, x: Any, ord: float = 2, dims: Any = None, keepdim: bool = False) -> View:
    """The Euclidean norm; InputError for another."""
    if ord != 2:
        raise InputError(f"this filter uses a norm of order {ord}, which {UNKNOWN}")
    out = make_reduction(SUM, f"square{suffix(node.meta['val'].dtype)}({{0}})")(t, node, x, dims, keepdim)
    t.block.assign(out, f"sqrt{suffix(out.meta.dtype)}({{0}})", [out])
    return out


def mean(t: Tensors, node: Node, x: Any, dims: Any = None, keepdim: bool = False, **_: Any) -> View:
    """The sum over their number."""
    out = make_reduction(SUM)(t, node, x, dims, keepdim)
    t.block.assign(out, f"{{0}} / {t.elements(x).shape.numel() // max(1, out.meta.numel())}", [out])
    return out


def variance(t: Tensors, node: Node, x: Any, dims: Any = None, *, correction: Any = 1, keepdim: bool = False) -> View:
    """The mean square of what is left without the mean."""
    view = t.tensor(x)
    dims = normalise_axes(dims, view.meta.ndim)
    middle = mean(t, node, view, dims, keepdim)
    wide = middle.meta
    if not keepdim:
        for d in sorted(dims):
            wide = wide.unsqueeze(d)
    operands = [view, middle.view_as(wide.expand(view.meta.shape))]
    swing = t.tensor(Expression(view.meta.shape, view.meta.dtype, "{0} - {1}", operands))
    out = make_reduction(SUM, f"square{suffix(view.meta.dtype)}({{0}})")(t, node, swing, dims, keepdim)
    n = math.prod(view.meta.shape[d] for d in dims)
    t.block.assign(out, f"{{0}} / {n - (1 if correction is None else correction)}", [out])
    return out


def running_sum(t: Tensors, node: Node, x: Any, dim: int, **_: Any) -> View:
    """Sums so far along an axis; up to ``KEPT`` of them beside each other."""
    terms, out = t.elements(x), t.result(node)
    shape, dim = terms.shape, dim % len(terms.shape)
    others = [d for d in range(len(shape)) if d != dim]
    beside = others[-1:] if others and shape[others[-1]] <= KEPT else []
    names = [f"i{d}" for d in range(len(shape))]
    at, size = (f"y[i{beside[0]}]", shape[beside[0]]) if beside else ("y[0]", 1)

    def loop_over(dims: Sequence[int]) -> str:
        return loops([names[d] for d in dims], [shape[d] for d in dims])

    term = terms.pattern.format(*(v.at(names) for v in terms.operands))
    rest, kind = loop_over([d for d in others if d not in beside]), C_TYPES[out.meta.dtype]
    t.block.write(
        f"{rest}{{ {kind} y[{size}]; {loop_over(beside)}{at} = 0; "
        f"{loop_over([dim, *beside])}{{ {at} += {term}; {out.at(names)} = {at}; }} }}",
        out, *terms.operands,
    )  # fmt: skip
    return out
