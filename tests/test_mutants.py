"""The list of faults that ``make mutants`` tries is about the code as it is."""

from __future__ import annotations

from tests.mutants import ROOT, read_mutants


def test_every_fault_can_be_made() -> None:
    """Its old text stands once in its file, its new one is Python, and its tests exist."""
    mutants = read_mutants()
    assert len(mutants) == len(set(mutants)) >= 40
    wrong = []
    for mutant in mutants:
        file = ROOT / "src" / "dlkf" / mutant.file
        if not file.is_file():
            wrong.append(f"{mutant.file}: no such file")
            continue
        text = file.read_text()
        if (n := text.count(mutant.old)) != 1:
            wrong.append(f"{mutant}: the old text stands {n} times")
        compile(text.replace(mutant.old, mutant.new), mutant.file, "exec")
        wrong += [f"{mutant}: no {test}" for test in mutant.tests if not exists(test)]
    assert not wrong, "\n".join(wrong)


def exists(test: str) -> bool:
    """Whether ``tests/room/test_file.py::test_name`` is there; nothing is imported."""
    file, _, name = test.partition("::")
    return (ROOT / file).is_file() and (not name or f"def {name}(" in (ROOT / file).read_text())


def test_the_rooms_of_the_core_are_there() -> None:
    rooms = {mutant.file.partition("/")[0] for mutant in read_mutants()}
    assert {"navigation", "filters", "running", "data", "evaluation", "training"} <= rooms
