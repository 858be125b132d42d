"""The floors of the house: a room imports from rooms below it only, and nothing goes in a circle."""

from __future__ import annotations

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

SRC = Path(__file__).parents[1] / "src"
FLOORS = (
    {"", "errors"},
    {"classes", "settings", "files", "console", "config", "parallel", "points", "provenance", "ranges", "colours"},
    {"navigation"},
    {"data", "networks"},
    {"filters", "simulation"},
    {"running"},
    {"onboard"},
    {"evaluation"},
    {"report"},
    {"tuning", "diagnosis"},
    {"tracking"},
    {"training"},
    {"models"},
    {"command"},
    {"allan", "compare", "consistency", "doctor", "evaluate", "export", "ingest", "navigate", "register"}
    | {"simulate", "train", "tune", "ui"},
    {"__main__"},
)
FLOOR = {room: n for n, rooms in enumerate(FLOORS) for room in rooms}
GLUE = {"hydra", "mlflow", "lightning", "omegaconf"}
GLUED = {"command", "training", "tracking", *FLOORS[-2]}  # rooms that may import the glue
GLUE_FILES = {"dlkf.data.datamodule"}


def modules() -> dict[str, set[str]]:
    """Every module of the package and all that it imports, lazily too; ``__init__`` under its package's name."""
    files = {_name(f): f for f in SRC.glob("dlkf/**/*.py")}
    return {name: {_known(t, files) for t in _targets(ast.parse(f.read_text()))} for name, f in files.items()}


def _name(file: Path) -> str:
    return ".".join(file.relative_to(SRC).with_suffix("").parts).removesuffix(".__init__")


def _known(target: str, files: dict[str, Path]) -> str:
    return target if target in files or not target.startswith("dlkf") else target.rpartition(".")[0]


def _targets(tree: ast.Module) -> set[str]:
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def _room(module: str) -> str:
    return (module.split(".") + [""])[1]


IMPORTS = modules()


@pytest.mark.parametrize("module", sorted(IMPORTS))
def test_imports_from_below(module: str) -> None:
    mine = FLOOR[_room(module)]
    ours = [t for t in IMPORTS[module] if t.startswith("dlkf")]
    above = [t for t in ours if FLOOR[_room(t)] > mine]
    beside = [t for t in ours if FLOOR[_room(t)] == mine and _room(t) != _room(module)]
    assert not above, f"{module} imports upward: {above}"
    if mine > 1:
        assert not beside, f"{module} imports from a room of its own floor: {beside}"


def test_no_circle_between_files() -> None:
    inside = {m: {t for t in targets if t in IMPORTS and t != m and "." in t} for m, targets in IMPORTS.items()}
    list(TopologicalSorter(inside).static_order())


def test_floors_below_the_glue_do_without_it() -> None:
    for module, targets in IMPORTS.items():
        if _room(module) not in GLUED and module not in GLUE_FILES:
            assert not {t.partition(".")[0] for t in targets} & GLUE, module


def test_navigating_needs_neither_scoring_nor_training() -> None:
    reached, todo = set(), ["dlkf.navigate"]
    while todo:
        module = todo.pop()
        if module not in reached and module in IMPORTS:
            reached.add(module)
            todo += IMPORTS[module]
    rooms = {_room(m) for m in reached}
    assert not rooms & {"evaluation", "training", "tuning", "diagnosis", "simulation"}, rooms
