"""The floors of the house: a room imports from rooms below it only, and nothing goes in a circle."""

from __future__ import annotations

import ast
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

SRC = Path(__file__).parents[1] / "src"
FLOORS = (
    {"", "base"},
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
    {"command"},
    {"allan", "compare", "consistency", "doctor", "evaluate", "export", "ingest", "navigate", "register"}
    | {"simulate", "train", "tune", "ui"},
    {"frames"},
    {"__main__"},
)
FLOOR = {room: n for n, rooms in enumerate(FLOORS) for room in rooms}
GLUE = {"hydra", "mlflow", "lightning", "omegaconf"}
GLUED = {"command", "training", "tracking", *FLOORS[-3]}  # rooms that may import the glue
GLUE_FILES = {"dlkf.data.datamodule"}


@cache
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


def test_imports_from_below() -> None:
    wrong = []
    for module, targets in sorted(modules().items()):
        mine = FLOOR[_room(module)]
        for target in sorted(t for t in targets if t.startswith("dlkf")):
            if FLOOR[_room(target)] > mine:
                wrong.append(f"{module} imports upward: {target}")
            elif mine and FLOOR[_room(target)] == mine and _room(target) != _room(module):
                wrong.append(f"{module} imports from a room of its own floor: {target}")
    assert not wrong, "\n".join(wrong)


def test_no_circle_between_files() -> None:
    inside = {m: {t for t in targets if t in modules() and t != m and "." in t} for m, targets in modules().items()}
    list(TopologicalSorter(inside).static_order())


def test_floors_below_the_glue_do_without_it() -> None:
    plain = {m: t for m, t in modules().items() if _room(m) not in GLUED and m not in GLUE_FILES}
    wrong = {m: glue for m, targets in plain.items() if (glue := {t.partition(".")[0] for t in targets} & GLUE)}
    assert not wrong, wrong


def test_navigating_needs_neither_scoring_nor_training() -> None:
    reached, todo = set(), ["dlkf.navigate"]
    while todo:
        module = todo.pop()
        if module not in reached and module in modules():
            reached.add(module)
            todo += modules()[module]
    rooms = {_room(m) for m in reached}
    assert not rooms & {"evaluation", "training", "tuning", "diagnosis", "simulation"}, rooms


def test_what_reads_drives_loads_no_simulator() -> None:
    """Lazy imports count too."""
    simulating = {}
    for command in ("evaluate", "tune", "navigate", "compare", "register"):
        loaded, todo = set(), [f"dlkf.{command}"]
        while todo:
            module = todo.pop()
            if module in modules() and module not in loaded:
                loaded.add(module)
                todo += modules()[module]
        simulating[command] = [m for m in loaded if m.startswith("dlkf.simulation") or len(loaded) < 20]
    assert not any(simulating.values()), simulating
