"""Branches of a recorded graph: what only one ``torch.where`` takes, and that only where a truth value holds, is
computed where it holds.

A graph has no branches: everything is computed, and ``where(on, then, otherwise)`` chooses. With one drive ``on`` is
one truth value, and the operations that nothing but the ``then`` of such a choice uses are moved before it, for the C
code to put them in an ``if``. Values are the same.
"""

from __future__ import annotations

from collections import Counter
from typing import Any

from torch.fx import GraphModule, Node

from dlkf.onboard.c_places import RESHAPES, operation_name

LEAST = 3000  # elements, functions of them counted as SLOW, for which a branch is written
SLOW = 10
FUNCTIONS = ("exp", "log", "log1p", "sin", "cos", "tanh", "atan2", "asinh", "sigmoid", "erf", "sqrt", "div", "pow")
VIEWS = (*RESHAPES, "unsqueeze", "squeeze", "expand", "select", "slice", "permute", "alias")


def find_branches(graph: GraphModule) -> dict[Node, Node]:
    """The truth value on which a node depends, of nodes that are needed on that alone; they stand directly before the
    choices that need them."""
    on: dict[Node, Node] = {}
    for node in reversed(graph.graph.nodes):
        if node.op == "call_function" and node.users:
            conditions = {_find_condition(node, user, on) for user in node.users}
            if len(conditions) == 1 and (condition := conditions.pop()) is not None:
                on[node] = condition
    worth = Counter[Node]()
    for node, condition in on.items():
        worth[condition] += _count_work(node)
    on = {node: condition for node, condition in on.items() if worth[condition] >= LEAST}
    moved: set[Node] = set()
    for node in list(graph.graph.nodes):
        if (condition := find_choice(node, on)) is not None:
            for needed in _list_needed(node.args[1], on, condition, moved):
                node.prepend(needed)
    return on


def find_choice(node: Node, on: dict[Node, Node]) -> Node | None:
    """The truth value by which a node chooses something that is computed on that alone."""
    if node in on or operation_name(node) != "where":
        return None
    then: Any = node.args[1]
    return on.get(then) if isinstance(then, Node) and on.get(then) is _find_scalar(node.args[0]) else None


def _find_condition(node: Node, user: Node, on: dict[Node, Node]) -> Node | None:
    """On what a user needs a node."""
    if user in on:
        return on[user]
    if operation_name(user) != "where":
        return None
    if user.args[1] is node and user.args[0] is not node and user.args[2] is not node:
        return _find_scalar(user.args[0])
    return None


def _find_scalar(on: Any) -> Node | None:
    """The one truth value that is broadcast; None where there are several."""
    while on.op == "call_function" and operation_name(on) in VIEWS:
        on = on.args[0]
    return on if on.meta["val"].numel() == 1 else None


def _count_work(node: Node) -> int:
    value: Any = node.meta["val"]
    if not hasattr(value, "numel"):
        return 0
    name = operation_name(node)
    if name in ("mm", "bmm", "addmm", "baddbmm"):
        left: Any = node.args[-2]
        return value.numel() * left.meta["val"].shape[-1]
    return value.numel() * (SLOW if name in FUNCTIONS else 1)


def _list_needed(node: Any, on: dict[Node, Node], condition: Node, moved: set[Node]) -> list[Node]:
    """A node and all before it that are computed on a condition, in an order in which they can be; ``moved`` grows."""
    found: list[Node] = []
    waiting: list[tuple[Node, bool]] = [(node, False)]
    while waiting:
        x, ready = waiting.pop()
        if ready:
            found.append(x)
        elif x not in moved and on.get(x) is condition:
            moved.add(x)
            waiting.append((x, True))
            waiting.extend((y, False) for y in x.all_input_nodes)
    return found
