"""Everything that a running filter carries from epoch to epoch, as one vector of numbers with a layout."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from dlkf.base.errors import InputError
from dlkf.navigation.error_model import WindowModel
from dlkf.onboard.meanings import describe_field

OF_THE_DRIVE = {WindowModel: ("still", "density")}  # the rest of it is the same for every drive of a filter
RECURRENT = "recurrent"  # cells of a network: the batch is their second axis


@dataclass(frozen=True)
class Field:
    """A tensor in the vector: ``shape`` of one drive, numbers from ``offset`` on."""

    name: str
    shape: tuple[int, ...]
    dtype: torch.dtype
    offset: int

    @property
    def size(self) -> int:
        """How many numbers."""
        return torch.Size(self.shape).numel()

    @property
    def batch_axis(self) -> int:
        """Where the drives are."""
        return 1 if RECURRENT in self.name else 0

    def as_dict(self) -> dict[str, Any]:
        """For a file."""
        meaning = describe_field(self.name)
        return {
            "name": self.name, "offset": self.offset, "shape": list(self.shape), "type": str(self.dtype)[6:],
            **({"meaning": meaning} if meaning else {}),
        }  # fmt: skip


class Layout:
    """Where each tensor of a nested structure lies in a vector of float64; ``like`` has all tensors that ever come.

    Truth values are 0 and 1, what a filter does not have yet is 0. InputError for a memory of anything but tensors.
    """

    def __init__(self, like: Any) -> None:
        self.like = like
        self.fields: list[Field] = []
        offset = 0
        for name, x in _leaves(like):
            if not isinstance(x, Tensor):
                raise InputError(
                    f"{name} of this filter's memory is a {type(x).__name__}; only tensors can be exported"
                )
            batch = 1 if RECURRENT in name else 0
            shape = tuple(s for axis, s in enumerate(x.shape) if axis != batch)
            self.fields.append(Field(name, shape, x.dtype, offset))
            offset += self.fields[-1].size
        self.size = offset

    def pack(self, structure: Any) -> Float[Tensor, "B K"]:
        """The vectors of a structure."""
        given = dict(_leaves(structure))
        drives = max(x.shape[f.batch_axis] for f in self.fields if (x := given.get(f.name)) is not None)
        parts = []
        for f in self.fields:
            x = given.get(f.name)
            if x is None:
                parts.append(torch.zeros(drives, f.size, dtype=torch.float64))
            else:
                parts.append(x.movedim(f.batch_axis, 0).expand(drives, *f.shape).reshape(drives, f.size).double())
        return torch.cat(parts, -1)

    def field(self, name: str, vector: Float[Tensor, "B K"]) -> Tensor | None:
        """One tensor out of vectors, None where the filter has none of that name."""
        found = next((f for f in self.fields if f.name == name), None)
        return None if found is None else self._part(found, vector)

    def _part(self, f: Field, vector: Tensor) -> Tensor:
        x = vector[:, f.offset : f.offset + f.size].reshape(len(vector), *f.shape).movedim(0, f.batch_axis)
        return x > 0.5 if f.dtype == torch.bool else x.to(f.dtype)

    def unpack(self, vector: Float[Tensor, "B K"]) -> Any:
        """The structure of vectors."""
        return _rebuild(self.like, iter([self._part(f, vector) for f in self.fields]))


def _children(x: Any) -> list[tuple[str, Any]] | None:
    """Named parts of a structure, None for a leaf."""
    for kind, names in OF_THE_DRIVE.items():
        if isinstance(x, kind):
            return [(name, getattr(x, name)) for name in names]
    if isinstance(x, tuple):
        return list(zip(getattr(x, "_fields", map(str, range(len(x)))), x))
    if is_dataclass(x):
        return [(f.name, getattr(x, f.name)) for f in fields(x)]
    return None


def _leaves(x: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    children = _children(x)
    if children is None:
        if x is not None:
            yield name, x
    else:
        for child, part in children:
            yield from _leaves(part, f"{name}.{child}" if name else child)


def _rebuild(x: Any, parts: Iterator[Tensor]) -> Any:
    children = _children(x)
    if children is None:
        return None if x is None else next(parts)
    new = {name: _rebuild(part, parts) for name, part in children}
    if hasattr(x, "_replace"):
        return x._replace(**new)
    return tuple(new.values()) if isinstance(x, tuple) else replace(x, **new)
