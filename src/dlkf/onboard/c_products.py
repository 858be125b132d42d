"""Matrix products as loops that a compiler can vectorise without changing the order of sums.

Which loops are fast depends on what is known of the matrices. A constant one with few elements is written out, and
where its rows have one element each they are not even copied. Sums of several rows stay in registers.
Of other matrices many are mostly zeros in filters (H, K, Φ), so zeros in A save the loop over a row of B.
"""

from __future__ import annotations

from math import prod
from typing import Any

import torch
from torch import Tensor
from torch.fx import Node

from dlkf.onboard.c_memory import C_TYPES, Expression, Rows, Tensors, View, loops
from dlkf.onboard.c_operations import literal, suffix
from dlkf.onboard.c_reductions import LANES

SMALL = 4096  # numbers of a matrix that is copied to be read along its rows, rather than weights of a network
WIDE = 8  # columns from which on rows of B are worth it, and of A from which on zeros are worth asking for
FEW = 4  # elements of a row of a constant matrix, on average, that is written out
NARROW = 16  # columns up to which a branch costs more than it saves
VECTOR = 64  # bytes of a processor's largest vector: rows as long as that go through tiles


def write_product(
    t: Tensors, node: Node, A: Any, B: Any, begin: Any = None, beta: float = 1, alpha: float = 1
) -> View | Rows:
    """A B (b × m × k · k × n), on top of β · ``begin`` where there is one."""
    a, b, value = t.tensor(A), t.tensor(B), node.meta["val"]
    n = b.meta.shape[-1]
    if begin is None and alpha == 1 and n >= WIDE and (rows := _sparse_rows(t, a)):
        lines = _product_rows(rows, b, value)
        return lines if t.may_stay_expression(node) and max(map(len, rows)) == 1 else t.store(node, lines)
    out = t.result(node)
    given = None
    if begin is not None:
        given = t.tensor(begin)
        given = given.view_as(given.meta.expand(value.shape))
    factors = ["" if x == 1 else f"{literal(x, value.dtype)} * " for x in (alpha, beta)]
    if a.meta.stride(-2) == out.meta.stride(-2) == 1 != out.meta.stride(-1):  # both by columns
        of_given = None if given is None else given.view_as(given.meta.mT)
        _write(t, out.view_as(out.meta.mT), b.view_as(b.meta.mT), a.view_as(a.meta.mT), of_given, *factors)
    else:
        _write(t, out, a, b, given, *factors)
    return out


def _write(t: Tensors, out: View, a: View, b: View, given: View | None, scale: str, beta: str) -> None:
    """``scale`` A B + ``beta`` · ``given``."""
    m, k, n = a.meta.shape[-2], a.meta.shape[-1], b.meta.shape[-1]
    small = prod(out.meta.shape[:-2]) * k * n <= SMALL
    along = b.meta.stride(-2) == 1 and b.meta.stride(-1) != 1
    if along and a.meta.stride(-1) == 1 and k >= 2 * LANES and (n < WIDE or not small):
        _write_dots(t, out, a, b, given, scale, beta)
    else:
        if small and n >= WIDE and m > 1 and b.meta.stride(-1) != 1:
            b = t.dense(b)
        _write_rows(t, out, a, b, given, scale, beta, small)


def write_product_sum(t: Tensors, node: Node, c: Any, a: Any, b: Any, beta: float = 1, alpha: float = 1) -> View | Rows:
    """β C + α A B."""
    return write_product(t, node, a, b, c, beta, alpha)


def _find_constant(t: Tensors, view: View) -> Tensor | None:
    """A constant matrix, None for another tensor."""
    values = next((x for buffer, x in t.block.constants if buffer is view.buffer), None)
    if values is None or view.meta.numel() != view.meta.shape[-2] * view.meta.shape[-1]:
        return None
    A = torch.as_strided(torch.from_numpy(values), view.meta.shape, view.meta.stride(), view.meta.storage_offset())
    return A.reshape(A.shape[-2:])


def _sparse_rows(t: Tensors, a: View) -> list[list[tuple[int, float]]]:
    """Column and value of what is not zero in each row of a constant matrix with few elements."""
    A = _find_constant(t, a)
    if A is None:
        return []
    rows = [[(k, float(row[k])) for k in row.nonzero()[:, 0].tolist()] for row in A]
    return rows if sum(map(len, rows)) <= FEW * len(rows) else []


def _product_rows(rows: list[list[tuple[int, float]]], b: View, value: Any) -> Rows:
    """Rows of A B as sums of few rows of B."""
    matrix = b.meta[0] if b.meta.ndim == 3 else b.meta
    items = []
    for row in rows:
        terms = []
        for j, (_, w) in enumerate(row):
            terms.append(f"{{{j}}}" if w == 1 else f"-{{{j}}}" if w == -1 else f"{literal(w, value.dtype)} * {{{j}}}")
        operands = [b.view_as(matrix[k]) for k, _ in row]
        items.append(Expression(matrix.shape[1:], value.dtype, f"({' + '.join(terms) or '0'})", operands))
    return Rows(value.shape, value.dtype, value.shape[:-1], items)


def _write_dots(t: Tensors, out: View, a: View, b: View, given: View | None, scale: str, beta: str) -> None:
    """Both along memory: ``dots`` of products.c.in."""
    lead = ["b"] if a.meta.ndim == 3 else []
    at = [f"&{x.at([*lead, '0', '0'])}, {x.meta.stride(d)}" for x, d in ((a, -2), (b, -1), (out, -2))]
    sizes = f"{a.meta.shape[-2]}, {a.meta.shape[-1]}, {b.meta.shape[-1]}"
    call = f"dots{suffix(out.meta.dtype)}({sizes}, {', '.join(at)}, {out.meta.stride(-1)});"
    t.block.write(loops(lead, a.meta.shape[:1]) + call, out, a, b)
    if given is not None:
        t.block.assign(out, f"{beta}{{0}} + {scale}{{1}}", [given, out])
    elif scale:
        t.block.assign(out, f"{scale}{{0}}", [out])


def _write_rows(
    t: Tensors, out: View, a: View, b: View, given: View | None, scale: str, beta: str, small: bool
) -> None:
    """Along rows of B, or along its columns where these alone lie in memory."""
    m, k, n = a.meta.shape[-2], a.meta.shape[-1], b.meta.shape[-1]
    kind, lead = C_TYPES[out.meta.dtype], ["b"] if a.meta.ndim == 3 else []
    used = [out, a, b, *([] if given is None else [given])]
    each = loops(lead, a.meta.shape[:1])
    if b.meta.stride(-1) != 1 and (n == 1 or b.meta.stride(-2) == 1):  # along columns of B
        start = "0" if given is None else f"{beta}{given.at([*lead, 'i', 'j'])}"
        body = (
            f"for (int j = 0; j < {n}; j++) {{ {kind} y = 0; for (int k = 0; k < {k}; k++) "
            f"y += {a.at([*lead, 'i', 'k'])} * {b.at([*lead, 'k', 'j'])}; "
            f"{out.at([*lead, 'i', 'j'])} = {start} + {scale}y; }}"
        )
        t.block.write(each + loops(["i"], [m]) + body, *used)
    elif n * out.meta.dtype.itemsize >= VECTOR and b.meta.stride(-1) == out.meta.stride(-1) == 1:
        weights = not small or any(buffer is b.buffer for buffer, _ in t.block.constants)
        sums = given is not None and given.buffer is out.buffer
        _write_tiles(t, out, a, b, given, scale, beta, sparse=not (weights or sums) and k >= WIDE and n > NARROW)
    else:
        row = loops(["j"], [n])
        start = "0" if given is None else beta + given.at([*lead, "i", "j"])
        body = (
            f"{{ {kind} y[{n}]; {row}y[j] = {start}; for (int k = 0; k < {k}; k++) {{ "
            f"{kind} w = {scale}{a.at([*lead, 'i', 'k'])}; {row}y[j] += w * {b.at([*lead, 'k', 'j'])}; }} "
            f"{row}{out.at([*lead, 'i', 'j'])} = y[j]; }}"
        )
        t.block.write(each + loops(["i"], [m]) + body, *used)


def _write_tiles(
    t: Tensors, out: View, a: View, b: View, given: View | None, scale: str, beta: str, sparse: bool
) -> None:
    """By ``multiply`` of products.c.in."""
    m, k, n = a.meta.shape[-2], a.meta.shape[-1], b.meta.shape[-1]
    overlaps = given is not None and given.buffer is out.buffer and n * out.meta.dtype.itemsize % VECTOR != 0
    if given is not None and (overlaps or given.meta.stride(-1) != 1):
        copy = t.block.new(given.meta.shape, given.meta.dtype)
        t.block.assign(copy, "{0}", [given])
        given = copy
    lead = ["b"] if a.meta.ndim == 3 else []

    def place(view: View) -> str:
        return "&" + view.at([*lead, "0", "0"])

    factors = [x.removesuffix(" * ") or "1" for x in (scale, beta)]
    begin = "0, 0" if given is None else f"{place(given)}, {given.meta.stride(-2)}"
    call = (
        f"multiply{suffix(out.meta.dtype)}({m}, {k}, {n}, {int(sparse)}, {factors[0]}, {place(a)}, "
        f"{a.meta.stride(-2)}, {a.meta.stride(-1)}, {place(b)}, {b.meta.stride(-2)}, {factors[1]}, {begin}, "
        f"{place(out)}, {out.meta.stride(-2)});"
    )
    t.block.write(loops(lead, a.meta.shape[:1]) + call, out, a, b, *([] if given is None else [given]))
