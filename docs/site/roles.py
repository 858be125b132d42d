"""Docstrings as Markdown: ``:func:`dlkf.x.y``` becomes a link to where y is documented."""

from __future__ import annotations

import re
from typing import Any

import griffe

ROLE = re.compile(r":(?:func|class|meth|mod|data|attr):`~?([\w.]+)`")


class Roles(griffe.Extension):
    """Rewrites the roles of every docstring."""

    def on_object(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        """After an object was read."""
        if obj.docstring:
            obj.docstring.value = ROLE.sub(lambda found: link(found[1], obj), obj.docstring.value)


def link(name: str, obj: griffe.Object) -> str:
    """A cross-reference to a full name, or to one in the same module."""
    full = name if name.startswith("dlkf") else f"{obj.module.path}.{name}"
    return f"[`{name}`][{full}]"
