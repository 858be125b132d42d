"""Core ATen operations that go element by element, as C expressions over the elements of their operands.

``{0}``, ``{1}``, … stand for the operands, ``{f}`` for the :func:`suffix` of a function. Where keywords or the type
decide, a function gives pattern and operands.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

MANY = 16  # elements from which on a loop that can be vectorised is faster than calls
Pattern = str | Callable[[torch.dtype, list, dict], tuple[str, list]]


def literal(x: Any, dtype: torch.dtype) -> str:
    """A number in C."""
    if isinstance(x, bool):
        return str(int(x))
    if isinstance(x, int):
        return f"{x}.0{suffix(dtype)}" if dtype.is_floating_point else str(x)
    if math.isnan(x):
        return "NAN"
    if math.isinf(x):
        return "INFINITY" if x > 0 else "(-INFINITY)"
    return f"{x!r}f" if dtype == torch.float32 else repr(x)


def suffix(dtype: torch.dtype) -> str:
    """Of the functions in <math.h> for a precision."""
    return "f" if dtype == torch.float32 else ""


def vectorise(pattern: str, elements: int) -> str:
    """A pattern of many elements, with the functions of ``elementary.c.in`` for those of <math.h> where it has them."""
    return re.sub(r"\b(expf?|tanhf|log|log1p|asinh|sin|cos)\(", r"each_\1(", pattern) if elements >= MANY else pattern


def _make_sum(sign: str) -> Pattern:
    """a ± alpha b."""

    def add_scaled(dtype: torch.dtype, args: list, kwargs: dict) -> tuple[str, list]:
        alpha = kwargs.get("alpha", 1)
        return ("{0} " + sign + " {1}", args[:2]) if alpha == 1 else ("{0} " + sign + " {2} * {1}", [*args[:2], alpha])

    return add_scaled


def _clamp(dtype: torch.dtype, args: list, kwargs: dict) -> tuple[str, list]:
    low, high = ([*args[1:], None, None])[:2]
    low, high = kwargs.get("min", low), kwargs.get("max", high)
    end = suffix(dtype) if dtype.is_floating_point else "_int"
    if low is None:
        return f"at_most{end}({{0}}, {{1}})", [args[0], high]
    if high is None:
        return f"at_least{end}({{0}}, {{1}})", [args[0], low]
    return f"at_most{end}(at_least{end}({{0}}, {{1}}), {{2}})", [args[0], low, high]


def _power(dtype: torch.dtype, args: list, kwargs: dict) -> tuple[str, list]:
    x, n = args[:2]
    if not isinstance(n, Tensor) and n in (2, 3):
        return f"{'square' if n == 2 else 'cube'}{suffix(dtype)}({{0}})", [x]
    return f"pow{suffix(dtype)}({{0}}, {{1}})", [x, n]


def _leaky_relu(dtype: torch.dtype, args: list, kwargs: dict) -> tuple[str, list]:
    return "({0} > 0 ? {0} : {1} * {0})", [args[0], (*args[1:], 0.01)[0]]


def _addcmul(dtype: torch.dtype, args: list, kwargs: dict) -> tuple[str, list]:
    return "{0} + {3} * {1} * {2}", [*args[:3], kwargs.get("value", 1)]


def _rad2deg(dtype: torch.dtype, args: list, kwargs: dict) -> tuple[str, list]:
    return "{1} * {0}", [args[0], math.degrees(1)]


def _take_second(dtype: torch.dtype, args: list, kwargs: dict) -> tuple[str, list]:
    return "{0}", [args[1]]


def _apply_to_first(pattern: str) -> Pattern:
    return lambda dtype, args, kwargs: (pattern, args[:1])


BY_ELEMENT: dict[str, Pattern] = {
    "add": _make_sum("+"), "sub": _make_sum("-"), "mul": "{0} * {1}", "div": "{0} / {1}", "neg": "-{0}",
    "reciprocal": "1 / {0}", "pow": _power, "square": "square{f}({0})", "rsqrt": "1 / sqrt{f}({0})",
    "sqrt": "sqrt{f}({0})", "exp": "exp{f}({0})", "erf": "erf{f}({0})", "log": "log{f}({0})",
    "log1p": "log1p{f}({0})", "rad2deg": _rad2deg,
    "sin": "sin{f}({0})", "cos": "cos{f}({0})", "asin": "asin{f}({0})", "asinh": "asinh{f}({0})",
    "atan2": "atan2{f}({0}, {1})", "tanh": "tanh{f}({0})", "hypot": "hypot{f}({0}, {1})",
    "floor": "floor{f}({0})", "abs": "fabs{f}({0})", "sigmoid": "1 / (1 + exp{f}(-{0}))",
    "leaky_relu": _leaky_relu, "relu": "({0} > 0 ? {0} : 0)",
    "maximum": "({0} > {1} ? {0} : {1})", "minimum": "({0} < {1} ? {0} : {1})", "clamp": _clamp,
    "clamp_min": _clamp, "where": "({0} ? {1} : {2})", "lerp": "{0} + {2} * ({1} - {0})", "addcmul": _addcmul,
    "eq": "{0} == {1}", "ne": "{0} != {1}", "lt": "{0} < {1}", "le": "{0} <= {1}", "gt": "{0} > {1}",
    "ge": "{0} >= {1}", "logical_not": "!{0}", "bitwise_not": "!{0}", "bitwise_and": "{0} & {1}",
    "bitwise_or": "{0} | {1}", "logical_and": "{0} && {1}", "logical_or": "{0} || {1}", "isnan": "isnan({0}) != 0",
    "isinf": "isinf({0}) != 0",
    "full_like": _take_second, "ones_like": _apply_to_first("1"), "zeros_like": _apply_to_first("0"),
    "copy": _take_second, "_to_copy": _apply_to_first("{0}"), "clone": _apply_to_first("{0}"),
    "lift_fresh_copy": _apply_to_first("{0}"), "prims::copy_strided": _apply_to_first("{0}"),
}  # fmt: skip
COPIES = ("clone", "lift_fresh_copy", "_to_copy", "prims::copy_strided")
# operations that change a part of a copy: which part of it becomes the second operand
PARTS: dict[str, Callable[..., Tensor]] = {
    "slice_scatter": torch.ops.aten.slice.Tensor,
    "select_scatter": torch.ops.aten.select.int,
    "diagonal_scatter": torch.ops.aten.diagonal.default,
}
