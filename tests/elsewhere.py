"""A device that is not there: computes as the CPU does, but its tensors do not mix with the CPU's.

What runs on it follows the device of its tensors, as on a GPU. What the host has to wait for there is counted.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

DEVICE = torch.device("meta")
CPU = torch.device("cpu")
WAITS = {"_local_scalar_dense", "is_nonzero", "nonzero", "masked_select", "unique", "equal"}
COPIES = {"_to_copy", "copy_", "lift_fresh"}
VIEWS = {  # no work for a device
    "view", "_unsafe_view", "t", "transpose", "permute", "expand", "unsqueeze", "squeeze", "select", "slice", "split",
    "split_with_sizes", "unbind", "alias", "detach", "as_strided", "diagonal",
}  # fmt: skip


def mapped(function: Callable[[Tensor], Any], value: Any) -> Any:
    """``value`` with ``function`` of every tensor in it; an operation nests no more than lists, in a third of the time
    of torch's own tree_map."""
    if isinstance(value, Tensor):
        return function(value)
    if isinstance(value, (tuple, list)):
        return type(value)([mapped(function, x) for x in value])
    return value


class There(Tensor):
    """A tensor of that device; its values lie on the CPU."""

    values: Tensor

    @staticmethod
    def __new__(cls, values: Tensor):
        """Of the same shape and strides."""
        there = Tensor._make_wrapper_subclass(
            cls, values.shape, strides=values.stride(), dtype=values.dtype, device=DEVICE,
            storage_offset=values.storage_offset(), requires_grad=values.requires_grad,
        )  # fmt: skip
        there.values = values
        return there

    def __repr__(self) -> str:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Its values."""
        return f"There({self.values})"

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        """Only inside :class:`Elsewhere`."""
        raise AssertionError(f"{func} outside of the device")


def values_of(tensor: Tensor) -> Tensor:
    """On the CPU."""
    return tensor.values if isinstance(tensor, There) else tensor


class FromNumbers(TorchFunctionMode):
    """``torch.tensor`` of numbers for that device, and rows named by a list, which torch would make without values."""

    def __torch_function__(self, func, types, args=(), kwargs=None):
        """On the CPU first."""
        kwargs = kwargs or {}
        if func in (Tensor.__getitem__, Tensor.__setitem__) and isinstance(args[0], There):
            key = args[1] if isinstance(args[1], tuple) else (args[1],)
            key = tuple(torch.tensor(k).to(DEVICE) if isinstance(k, list) else k for k in key)
            return func(args[0], key, *args[2:])
        if func not in (torch.tensor, torch.as_tensor, Tensor.new_tensor):
            return func(*args, **kwargs)
        device = torch.device(kwargs.get("device") or (args[0].device if func is Tensor.new_tensor else CPU))
        if func is Tensor.new_tensor:
            return torch.tensor(*args[1:], **{"dtype": args[0].dtype, **kwargs, "device": CPU}).to(device)
        return func(*args, **{**kwargs, "device": CPU}).to(device)


class Elsewhere(TorchDispatchMode):
    """Inside, ``device="meta"`` means this device. ``waits`` counts what the host waited for, by operation, and
    ``work`` all that it had to begin there."""

    def __init__(self) -> None:
        super().__init__()
        self.waits: Counter[str] = Counter()
        self.work = 0
        self.numbers = FromNumbers()

    def __enter__(self) -> Elsewhere:
        """Both modes."""
        self.numbers.__enter__()
        return super().__enter__()

    def __exit__(self, *of) -> None:
        """Both modes."""
        super().__exit__(*of)
        self.numbers.__exit__(*of)

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        """On the CPU, refusing tensors of both devices together."""
        kwargs = kwargs or {}
        name = func._schema.name.split("::")[1]
        tensors: list[Tensor] = []
        mapped(tensors.append, (args, tuple(kwargs.values())))
        there = any(isinstance(x, There) for x in tensors)
        if there and name not in COPIES:
            here = [x for x in tensors if not isinstance(x, There) and x.ndim > 0]
            if here:
                raise RuntimeError(f"{name}: tensors on both devices, on the CPU {[tuple(x.shape) for x in here]}")
        asked = kwargs.get("device")
        to_cpu = asked is not None and torch.device(asked).type == "cpu"
        if there and (name in WAITS or (name == "_to_copy" and to_cpu)):
            self.waits[name] += 1
        self.work += there and name not in VIEWS
        inner = mapped(values_of, args)
        given: dict[str, Any] = {key: mapped(values_of, x) for key, x in kwargs.items()}
        if asked is not None:
            given = given | {"device": CPU}
            there = not to_cpu
        out = func(*inner, **given)
        if not there:
            return out
        if name.endswith("_") and not name.startswith("_") and isinstance(args[0], There):
            return args[0]
        return mapped(There, out)
