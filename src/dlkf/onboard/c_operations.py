"""Core ATen operations in C: those that go element by element as expressions, the others as loops."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.fx import Node

from dlkf.errors import InputError
from dlkf.onboard.c_memory import C_TYPES, View

if TYPE_CHECKING:
    from dlkf.onboard.c_code import Translation

def literal(x: Any, dtype: torch.dtype) -> str:
    """A number in C."""
    if isinstance(x, bool):
        return str(int(x))
    if isinstance(x, int):
        return f"{x}.0" if dtype.is_floating_point else str(x)
    if math.isnan(x):
        return "NAN"
    if math.isinf(x):
        return "INFINITY" if x > 0 else "(-INFINITY)"
    return f"{x!r}f" if dtype == torch.float32 else repr(x)


def _function(name: str) -> Any:
    """A function of <math.h> in the precision of the result."""

    def made(dtype: torch.dtype, args: list, kwargs: dict) -> tuple[str, list]:
        return f"{name}{'f' if dtype == torch.float32 else ''}({', '.join(f'{{{k}}}' for k in range(len(args)))})", args

    return made


def _scaled(sign: str) -> Any:
    """a ± alpha b."""

    def made(dtype: torch.dtype, args: list, kwargs: dict) -> tuple[str, list]:
        alpha = kwargs.get("alpha", 1)
        return ("{0} " + sign + " {1}", args[:2]) if alpha == 1 else ("{0} " + sign + " {2} * {1}", [*args[:2], alpha])

    return made


def _clamped(dtype: torch.dtype, args: list, kwargs: dict) -> tuple[str, list]:
    low, high = ([*args[1:], None, None])[:2]
    low, high = kwargs.get("min", low), kwargs.get("max", high)
    if low is None:
        return "({0} > {1} ? {1} : {0})", [args[0], high]
    if high is None:
        return "({0} < {1} ? {1} : {0})", [args[0], low]
    return "({0} < {1} ? {1} : {0} > {2} ? {2} : {0})", [args[0], low, high]


def _power(dtype: torch.dtype, args: list, kwargs: dict) -> tuple[str, list]:
    x, n = args[:2]
    if not isinstance(n, Tensor) and n in (2, 3):
        return "square({0})" if n == 2 else "cube({0})", [x]
    return "pow({0}, {1})", [x, n]


def _filled(dtype: torch.dtype, args: list, kwargs: dict) -> tuple[str, list]:
    return "{0}", [args[1]]


def _one(pattern: str) -> Any:
    return lambda dtype, args, kwargs: (pattern, args[:1])


BY_ELEMENT: dict[str, Any] = {
    "add": _scaled("+"), "sub": _scaled("-"), "mul": "{0} * {1}", "div": "{0} / {1}", "neg": "-{0}",
    "reciprocal": "1 / {0}", "pow": _power, "square": "square({0})", "rsqrt": "1 / sqrt({0})",
    "sqrt": _function("sqrt"), "exp": _function("exp"), "log": _function("log"), "log1p": _function("log1p"),
    "sin": _function("sin"), "cos": _function("cos"), "asin": _function("asin"), "asinh": _function("asinh"),
    "atan2": _function("atan2"), "tanh": _function("tanh"), "hypot": _function("hypot"), "floor": _function("floor"),
    "sigmoid": lambda dtype, args, kwargs: ("1 / (1 + expf(-{0}))" if dtype == torch.float32 else "1 / (1 + exp(-{0}))", args),
    "abs": _function("fabs"), "maximum": "({0} > {1} ? {0} : {1})", "minimum": "({0} < {1} ? {0} : {1})",
    "clamp": _clamped, "clamp_min": _clamped, "relu": "({0} > 0 ? {0} : 0)", "where": "({0} ? {1} : {2})",
    "leaky_relu": lambda dtype, args, kwargs: ("({0} > 0 ? {0} : {1} * {0})", [args[0], (*args[1:], 0.01)[0]]),
    "eq": "{0} == {1}", "ne": "{0} != {1}", "lt": "{0} < {1}", "le": "{0} <= {1}", "gt": "{0} > {1}",
    "ge": "{0} >= {1}", "logical_not": "!{0}", "bitwise_not": "!{0}", "bitwise_and": "{0} & {1}",
    "bitwise_or": "{0} | {1}", "logical_and": "{0} && {1}", "logical_or": "{0} || {1}", "isnan": "isnan({0})",
    "isinf": "isinf({0})", "full_like": _filled, "ones_like": _one("1"), "zeros_like": _one("0"),
    "lerp": "{0} + {2} * ({1} - {0})", "copy": lambda dtype, args, kwargs: ("{0}", [args[1]]),
    "addcmul": lambda dtype, args, kwargs: ("{0} + {3} * {1} * {2}", [*args[:3], kwargs.get("value", 1)]),
}  # fmt: skip
CONVERT: dict[str, Any] = {"_to_copy": _one("{0}"), "clone": _one("{0}"), "contiguous": _one("{0}"), "lift_fresh_copy": _one("{0}")}
CONVERT["prims::copy_strided"] = _one("{0}")
# operations on a copy: which part of it becomes the second operand
IN_PLACE: dict[str, Any] = {
    "slice_scatter": lambda out, dim=0, start=None, end=None, step=1: torch.ops.aten.slice.Tensor(out, dim, start, end, step),
    "select_scatter": lambda out, dim, index: torch.ops.aten.select.int(out, dim, index),
}


def _cat(t: Translation, node: Node, parts: list, dim: int = 0) -> View:
    value = node.meta["val"]
    out, start = t.block.new(value.shape, value.dtype), 0
    for part in parts:
        shape = part.shape if isinstance(part, Tensor) else t.tensor(part).meta.shape
        view = t.tensor(part)
        if view.meta.numel():
            place = View(out.buffer, out.meta.narrow(dim, start, shape[dim]))
            t.block.over(place, "{0}", [view])
            start += shape[dim]
    return out


def _reduced(first: str, each: str) -> Any:
    def made(t: Translation, node: Node, x: Any, dims: Any = None, keepdim: bool = False, **kwargs: Any) -> View:
        value, view = node.meta["val"], t.tensor(x)
        dims = list(range(view.meta.ndim)) if dims in (None, []) else [dims] if isinstance(dims, int) else dims
        dims = [d % view.meta.ndim for d in dims]
        out = t.block.new(value.shape, value.dtype)
        t.block.over(out, first, [])
        target = out.meta
        if not keepdim:
            for d in sorted(dims):
                target = target.unsqueeze(d)
        order = [d for d in range(view.meta.ndim) if d not in dims]
        order = dims + order if view.meta.stride(-1) != 1 or view.meta.ndim - 1 not in dims else order + dims
        target = View(out.buffer, target.expand(view.meta.shape).permute(order))
        t.block.over(target, each, [target, View(view.buffer, view.meta.permute(order))])
        return out

    return made


def _norm(t: Translation, node: Node, x: Any, ord: float = 2, dims: Any = None, keepdim: bool = False, **kw: Any) -> View:
    if ord != 2:
        raise InputError(f"this filter uses a norm of order {ord}, which the C form of an exported filter does not know")
    out = _reduced("0", "{0} + {1} * {1}")(t, node, x, dims, keepdim)
    t.block.over(out, f"sqrt{'f' if out.meta.dtype == torch.float32 else ''}({{0}})", [out])
    return out


def _mean(t: Translation, node: Node, x: Any, dims: Any = None, keepdim: bool = False, **kwargs: Any) -> View:
    out = _reduced("0", "{0} + {1}")(t, node, x, dims, keepdim)
    n = t.tensor(x).meta.numel() // max(1, out.meta.numel())
    t.block.over(out, f"{{0}} / {n}", [out])
    return out


def _variance(t: Translation, node: Node, x: Any, dims: Any = None, *, correction: Any = 1, keepdim: bool = False) -> View:
    view, value = t.tensor(x), node.meta["val"]
    dims = [d % view.meta.ndim for d in ([dims] if isinstance(dims, int) else dims)]
    n = math.prod(view.meta.shape[d] for d in dims)
    mean = _mean(t, node, view, dims, keepdim)
    wide = mean.meta
    if not keepdim:
        for d in sorted(dims):
            wide = wide.unsqueeze(d)
    swing = t.block.new(view.meta.shape, value.dtype)
    t.block.over(swing, "{0} - {1}", [view, View(mean.buffer, wide.expand(view.meta.shape))])
    out = _reduced("0", "{0} + {1} * {1}")(t, node, swing, dims, keepdim)
    t.block.over(out, f"{{0}} / {n - (1 if correction is None else correction)}", [out])
    return out


def _repeated(t: Translation, node: Node, x: Any, times: list) -> View:
    view, value = t.tensor(x), node.meta["val"]
    out = t.block.new(value.shape, value.dtype)
    padded = view.meta.reshape(*(1,) * (len(times) - view.meta.ndim), *view.meta.shape)
    place = out.meta.view([n for pair in zip(times, padded.shape) for n in pair])
    for axis in range(len(times)):
        padded = padded.unsqueeze(2 * axis)
    t.block.over(View(out.buffer, place), "{0}", [View(view.buffer, padded.expand(place.shape))])
    return out


def _put(t: Translation, node: Node, x: Any, indices: list, values: Any, accumulate: bool = False) -> View:
    """x[…, i, j] = values, the tensors side by side."""
    view, value, source = t.tensor(x), node.meta["val"], t.tensor(values)
    out = t.block.new(value.shape, value.dtype)
    t.block.over(out, "{0}", [view])
    given = [(k, t.tensor(i)) for k, i in enumerate(indices) if i is not None]
    shape = torch.broadcast_shapes(*(i.meta.shape for _, i in given))
    first, ndim = given[0][0], view.meta.ndim - len(given) + len(shape)
    names = [f"i{k}" for k in range(ndim)]
    rest = iter(names[:first] + names[first + len(shape) :])
    chosen = {k: type(i)(i.buffer, i.meta.expand(shape)).at(names[first : first + len(shape)]) for k, i in given}
    target = [chosen[k] if k in chosen else next(rest) for k in range(view.meta.ndim)]
    sizes = [*view.meta.shape[:first], *shape, *view.meta.shape[given[-1][0] + 1 :]]
    wide = type(source)(source.buffer, source.meta.expand(sizes))
    loops = "".join(f"for (int {i} = 0; {i} < {n}; {i}++) " for i, n in zip(names, sizes))
    t.block.write(f"{loops}{out.at(target)} {'+' if accumulate else ''}= {wide.at(names)};", out, source, *(i for _, i in given))
    return out


def _product(t: Translation, node: Node, A: Any, B: Any, begin: Any = None, beta: float = 1, alpha: float = 1) -> View:
    """(b) m×k · k×n, on top of β · ``begin`` where there is one."""
    a, b = t.tensor(A), t.tensor(B)
    value = node.meta["val"]
    out = t.block.new(value.shape, value.dtype)
    given = None if begin is None else t.tensor(begin)
    batched = a.meta.ndim == 3
    m, k, n = a.meta.shape[-2], a.meta.shape[-1], b.meta.shape[-1]
    lead = ["b"] if batched else []
    outer = f"for (int b = 0; b < {a.meta.shape[0]}; b++) " if batched else ""
    at_a, at_b = a.at([*lead, "i", "k"]), b.at([*lead, "k", "j"])
    scale = "" if alpha == 1 else f"{literal(alpha, value.dtype)} * "
    if given is None:
        start, used = "0", []
    else:
        wide = View(given.buffer, given.meta.expand(value.shape))
        start = ("" if beta == 1 else f"{literal(beta, value.dtype)} * ") + wide.at([*lead, "i", "j"])
        used = [given]
    kind = C_TYPES[value.dtype]
    if b.meta.stride(-1) == 1 or n > 1 and b.meta.stride(-2) != 1:
        body = (
            f"{{ {kind} y[{n}]; for (int j = 0; j < {n}; j++) y[j] = {start}; "
            f"for (int k = 0; k < {k}; k++) {{ {kind} w = {scale}{at_a}; for (int j = 0; j < {n}; j++) y[j] += w * {at_b}; }} "
            f"for (int j = 0; j < {n}; j++) {out.at([*lead, 'i', 'j'])} = y[j]; }}"
        )
    else:
        body = (
            f"for (int j = 0; j < {n}; j++) {{ {kind} y = 0; for (int k = 0; k < {k}; k++) y += {at_a} * {at_b}; "
            f"{out.at([*lead, 'i', 'j'])} = {start} + {scale}y; }}"
        )
    t.block.write(f"{outer}for (int i = 0; i < {m}; i++) {body}", out, a, b, *used)
    return out


def _solved(t: Translation, node: Node, A: Any, B: Any, **kwargs: Any) -> list:
    """A symmetric and positive definite: by Cholesky's factors."""
    a, b = t.dense(A), t.dense(B)
    out = t.block.new(b.meta.shape, b.meta.dtype)
    work = t.block.new(a.meta.shape, a.meta.dtype)
    many = a.meta.shape[:-2].numel()
    m, n = b.meta.shape[-2:]
    t.block.write(
        f"for (int b = 0; b < {many}; b++) solve({m}, {n}, {a.at(['0'])}".replace(a.at(["0"]), f"&{a.buffer.name}[{a.meta.storage_offset()}+b*{m * m}]")
        + f", &{b.buffer.name}[{b.meta.storage_offset()}+b*{m * n}], &{work.buffer.name}[b*{m * m}], &{out.buffer.name}[b*{m * n}]);",
        a, b, out, work,
    )  # fmt: skip
    return [out, None, None, None]


def _factored(t: Translation, node: Node, A: Any, **kwargs: Any) -> list:
    a = t.dense(A)
    out = t.block.new(a.meta.shape, a.meta.dtype)
    m = a.meta.shape[-1]
    t.block.write(
        f"for (int b = 0; b < {a.meta.shape[:-2].numel()}; b++) factor({m}, &{a.buffer.name}[{a.meta.storage_offset()}+b*{m * m}], "
        f"&{out.buffer.name}[b*{m * m}]);", a, out,
    )  # fmt: skip
    return [out, None]


def _solved_by_factor(t: Translation, node: Node, B: Any, L: Any, upper: bool = False) -> View:
    b, f = t.dense(B), t.dense(L)
    out = t.block.new(b.meta.shape, b.meta.dtype)
    m, n = b.meta.shape[-2:]
    t.block.write(
        f"for (int b = 0; b < {b.meta.shape[:-2].numel()}; b++) back({m}, {n}, &{f.buffer.name}[{f.meta.storage_offset()}+b*{m * m}], "
        f"&{b.buffer.name}[{b.meta.storage_offset()}+b*{m * n}], &{out.buffer.name}[b*{m * n}]);", b, f, out,
    )  # fmt: skip
    return out


def _inverted(t: Translation, node: Node, A: Any, **kwargs: Any) -> list:
    a = t.dense(A)
    out = t.block.new(a.meta.shape, a.meta.dtype)
    t.block.write(
        f"for (int b = 0; b < {a.meta.shape[:-2].numel()}; b++) invert3(&{a.buffer.name}[{a.meta.storage_offset()}+b*9], "
        f"&{out.buffer.name}[b*9]);", a, out,
    )  # fmt: skip
    return [out, None]


def _crossed(t: Translation, node: Node, A: Any, B: Any, *, dim: int = -1) -> View:
    value = node.meta["val"]
    a, b = (View(v.buffer, v.meta.expand(value.shape)) for v in (t.tensor(A), t.tensor(B)))
    out = t.block.new(value.shape, value.dtype)
    for k in range(3):
        parts = [View(v.buffer, v.meta.select(dim, j % 3)) for v, j in ((a, k + 1), (b, k + 2), (a, k + 2), (b, k + 1))]
        t.block.over(View(out.buffer, out.meta.select(dim, k)), "{0} * {1} - {2} * {3}", parts)
    return out


def _summed_up(t: Translation, node: Node, x: Any, dim: int, **kwargs: Any) -> View:
    view = t.tensor(x)
    value = node.meta["val"]
    out = t.block.new(value.shape, value.dtype)
    n = value.shape[dim]
    first = [View(v.buffer, v.meta.narrow(dim, 0, 1)) for v in (out, view)]
    t.block.over(first[0], "{0}", first[1:])
    later = [View(v.buffer, v.meta.narrow(dim, s, n - 1).movedim(dim, 0)) for v, s in ((out, 1), (out, 0), (view, 1))]
    t.block.over(later[0], "{0} + {1}", later[1:])
    return out


def _picked(t: Translation, node: Node, x: Any, dim: int, index: Any) -> View:
    view, rows = t.tensor(x), t.dense(index)
    value = node.meta["val"]
    out = t.block.new(value.shape, value.dtype)
    index_names = [f"i{k}" for k in range(value.ndim)]
    loops = "".join(f"for (int {i} = 0; {i} < {n}; {i}++) " for i, n in zip(index_names, value.shape))
    source = [*index_names]
    source[dim] = rows.at([index_names[dim]])
    t.block.write(f"{loops}{out.at(index_names)} = {view.at(source)};", out, view, rows)
    return out


def _indexed(t: Translation, node: Node, x: Any, indices: list) -> View:
    """x[i, j, …] with tensors of one shape, None for a whole axis; the tensors side by side."""
    view = t.tensor(x)
    value = node.meta["val"]
    out = t.block.new(value.shape, value.dtype)
    given = [(k, t.tensor(i)) for k, i in enumerate(indices) if i is not None]
    shape = torch.broadcast_shapes(*(i.meta.shape for _, i in given))
    beside = given[-1][0] - given[0][0] == len(given) - 1
    first = given[0][0] if beside else 0
    names = [f"i{k}" for k in range(value.ndim)]
    inner = names[first : first + len(shape)]
    rest = iter(names[:first] + names[first + len(shape) :])
    chosen = {k: type(i)(i.buffer, i.meta.expand(shape)).at(inner) for k, i in given}
    source = [chosen[k] if k in chosen else next(rest) for k in range(view.meta.ndim)]
    loops = "".join(f"for (int {i} = 0; {i} < {n}; {i}++) " for i, n in zip(names, value.shape))
    t.block.write(f"{loops}{out.at(names)} = {view.at(source)};", out, view, *(i for _, i in given))
    return out


def _gathered(t: Translation, node: Node, x: Any, dim: int, index: Any, **kwargs: Any) -> View:
    view, rows = t.tensor(x), t.tensor(index)
    value = node.meta["val"]
    out = t.block.new(value.shape, value.dtype)
    names = [f"i{k}" for k in range(value.ndim)]
    source = [*names]
    source[dim % value.ndim] = rows.at(names)
    loops = "".join(f"for (int {i} = 0; {i} < {n}; {i}++) " for i, n in zip(names, value.shape))
    t.block.write(f"{loops}{out.at(names)} = {view.at(source)};", out, view, rows)
    return out


def _largest(t: Translation, node: Node, x: Any, dim: int = -1, keepdim: bool = False) -> View:
    view = t.tensor(x)
    value = node.meta["val"]
    out = t.block.new(value.shape, value.dtype)
    ndim = view.meta.ndim
    dim %= ndim
    names = [f"i{k}" for k in range(ndim)]
    outer = [i for k, i in enumerate(names) if k != dim]
    at = [("0" if k == dim else i) for k, i in enumerate(names)] if keepdim else outer
    loops = "".join(f"for (int {i} = 0; {i} < {view.meta.shape[k]}; {i}++) " for k, i in enumerate(names) if k != dim)
    now, best = view.at(names), view.at([("best" if k == dim else i) for k, i in enumerate(names)])
    n = view.meta.shape[dim]
    t.block.write(
        f"{loops}{{ int best = 0; for (int {names[dim]} = 1; {names[dim]} < {n}; {names[dim]}++) "
        f"if ({now} > {best}) best = {names[dim]}; {out.at(at)} = best; }}", out, view,
    )  # fmt: skip
    return out


def _convolved(t: Translation, node: Node, x: Any, w: Any, bias: Any, stride: list, padding: list, *rest: Any) -> View:
    """One axis, stride 1, zeros outside."""
    x, w = t.tensor(x), t.tensor(w)
    value = node.meta["val"]
    out = t.block.new(value.shape, value.dtype)
    (_, inward, M), (outward, _, taps), pad = x.meta.shape, w.meta.shape, padding[0]
    b = None if bias is None else t.tensor(bias)
    start = "0" if b is None else b.at(["o"])
    t.block.write(
        f"for (int o = 0; o < {outward}; o++) {{ for (int n = 0; n < {value.shape[2]}; n++) {out.at(['0', 'o', 'n'])} = {start}; "
        f"for (int c = 0; c < {inward}; c++) for (int k = 0; k < {taps}; k++) {{ {C_TYPES[value.dtype]} v = {w.at(['o', 'c', 'k'])}; "
        f"int low = {pad} > k ? {pad} - k : 0, high = {M} + {pad} - k < {value.shape[2]} ? {M} + {pad} - k : {value.shape[2]}; "
        f"for (int n = low; n < high; n++) {out.at(['0', 'o', 'n'])} += v * {x.at(['0', 'c', f'(n + k - {pad})'])}; }} }}",
        out, x, w, *([] if b is None else [b]),
    )  # fmt: skip
    return out


def _padded(t: Translation, node: Node, x: Any, pad: list, fill: float = 0.0) -> View:
    view, value = t.tensor(x), node.meta["val"]
    out = t.block.new(value.shape, value.dtype)
    t.block.over(out, literal(fill, value.dtype), [])
    part = out.meta
    for k in range(len(pad) // 2):
        axis = part.ndim - 1 - k
        part = part.narrow(axis, pad[2 * k], view.meta.shape[axis])
    t.block.over(View(out.buffer, part), "{0}", [view])
    return out


def _flipped(t: Translation, node: Node, x: Any, dims: list) -> View:
    view, value = t.tensor(x), node.meta["val"]
    out = t.block.new(value.shape, value.dtype)
    names = [f"i{k}" for k in range(value.ndim)]
    turned = [f"({n - 1} - {i})" if k in [d % value.ndim for d in dims] else i for k, (i, n) in enumerate(zip(names, value.shape))]
    loops = "".join(f"for (int {i} = 0; {i} < {n}; {i}++) " for i, n in zip(names, value.shape))
    t.block.write(f"{loops}{out.at(names)} = {view.at(turned)};", out, view)
    return out


WHOLE: dict[str, Any] = {
    "cat": _cat,
    "sum": _reduced("0", "{0} + {1}"),
    "any": _reduced("0", "{0} | ({1} != 0)"),
    "amax": _reduced("-INFINITY", "{0} > {1} ? {0} : {1}"),
    "mean": _mean,
    "var": _variance,
    "repeat": _repeated,
    "index_put": _put,
    "linalg_vector_norm": _norm,
    "mm": _product,
    "bmm": _product,
    "addmm": lambda t, node, c, a, b, beta=1, alpha=1: _product(t, node, a, b, c, beta, alpha),
    "baddbmm": lambda t, node, c, a, b, beta=1, alpha=1: _product(t, node, a, b, c, beta, alpha),
    "linalg_solve_ex": lambda t, node, A, B, **options: _solved(t, node, A, B)[:2],
    "_linalg_solve_ex": _solved,
    "linalg_cholesky_ex": _factored,
    "cholesky_solve": _solved_by_factor,
    "linalg_inv_ex": _inverted,
    "linalg_cross": _crossed,
    "cumsum": _summed_up,
    "index_select": _picked,
    "index": _indexed,
    "gather": _gathered,
    "argmax": _largest,
    "convolution": _convolved,
    "constant_pad_nd": _padded,
    "flip": _flipped,
}
