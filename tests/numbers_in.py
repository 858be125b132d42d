"""What two results are compared by."""

from __future__ import annotations


def numbers_in(x) -> list[float]:
    """All numbers of a nested value, in their order."""
    if isinstance(x, dict):
        return [n for key in sorted(x) for n in numbers_in(x[key])]
    if isinstance(x, list):
        return [n for part in x for n in numbers_in(part)]
    return [float(x)] if isinstance(x, (int, float)) and not isinstance(x, bool) else []
