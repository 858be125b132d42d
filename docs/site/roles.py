"""Docstrings as Markdown: ``:func:`dlkf.x.y``` becomes a link to where y is documented."""

from __future__ import annotations

import re
from typing import Any

import griffe

ROLE = re.compile(r":(?:func|class|meth|mod|data|attr):`~?([\w.]+)`")


class Roles(griffe.Extension):
    """Rewrites the roles of every docstring, once all names are known."""

    def on_package(self, *, pkg: griffe.Module, **kwargs: Any) -> None:
        """After the package was read."""
        rewrite(pkg)


def rewrite(obj: griffe.Object) -> None:
    """The docstrings of an object and of all that is in it."""
    if obj.docstring:
        obj.docstring.value = ROLE.sub(lambda found: link(found[1], obj), obj.docstring.value)
    for member in obj.members.values():
        if not member.is_alias:
            rewrite(member)


def _is_value(member: griffe.Object | griffe.Alias) -> bool:
    """Whether a name stands for a value; an alias of another package's, or of what is not read yet, counts as one."""
    try:
        return member.is_attribute
    except griffe.AliasResolutionError:
        return True


def link(name: str, obj: griffe.Object) -> str:
    """A cross-reference to a full name, or to one in the same class or module, imported ones too; else code."""
    if name.startswith("dlkf"):
        return f"[`{name}`][{name}]"
    first, _, rest = name.partition(".")
    for scope in (obj, obj.parent, obj.module):
        member = None if scope is None or scope.is_alias else scope.members.get(first)
        if member is not None and not _is_value(member):  # values have no place of their own
            full = member.target_path if member.is_alias else member.path
            return f"[`{name}`][{full}{'.' + rest if rest else ''}]"
    return f"`{name}`"
