"""What becomes of the parts of a filter's memory where something happens to all of it, by their types."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

ANEW = None  # in the place of a field's rule: what a fresh filter has
# for the fields of a named tuple rule(event, field), for a whole part rule(event, part, fresh part)
Rules = dict[type, dict[str, Callable[[Any, Any], Any] | None] | Callable[[Any, Any, Any], Any]]


def change_memory(rules: Rules, event: Any, memory: Any, fresh: Any) -> Any:
    """A filter's memory after an ``event``; what has no rule stays. ``fresh`` is that of a filter that begins then.

    TypeError for a memory of a type without rules.
    """
    if memory is not None and type(memory) not in rules:
        raise TypeError(f"no rule for a memory of type {type(memory).__name__}")
    return _change_part(rules, event, memory, fresh)


def _change_part(rules: Rules, event: Any, part: Any, fresh: Any) -> Any:
    rule = rules.get(type(part), {})
    if callable(rule):
        return rule(event, part, fresh)
    if not (isinstance(part, tuple) and isinstance(fresh, tuple) and len(part) == len(fresh)):
        return part
    changed = []
    for name, old, new in zip(getattr(part, "_fields", range(len(part))), part, fresh):
        if name not in rule:
            changed.append(_change_part(rules, event, old, new))
        else:
            of_field = rule[name]
            changed.append(new if of_field is None else of_field(event, old))
    return type(part)(*changed) if hasattr(part, "_fields") else type(part)(changed)


def begin_anew(event: Any, part: Any, fresh: Any) -> Any:
    """The rule of a part that does not outlast an event."""
    return fresh
