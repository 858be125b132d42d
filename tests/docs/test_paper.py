"""What docs/paper.md says of the package holds: names are in the code, figures stand on the pages that it leads to."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import yaml

from tests.docs.pages import ROOT
from tests.docs.test_citations import anchor, requirements

PAGE = ROOT / "docs" / "paper.md"
ROWS = [
    (requirements(found[1]), found[2])
    for found in re.finditer(r"^\| (R[^|]+) \| [^|]+ \| ([^|]+) \|$", PAGE.read_text(), re.M)
]
MEASURED = re.compile(r"\[measured\]\((results/\w+\.md)(#[^)]+)?\)")
FIGURE = re.compile(r"(?<![\w.#-])-?\d+(?:\.\d+|\d)(?![\w.]*\w)")  # 0.27, -0.0011, 500; not the 3 of "set 3", not R052


def section(page: Path, place: str) -> str:
    """The text under the heading of a place (#anchor), with the parts below it; the whole page without one."""
    text = page.read_text()
    if not place:
        return text
    for found in re.finditer(r"^(#+) (.+)$", text, re.M):
        if place == f"#{anchor(found[2])}":
            rest = text[found.end() :]
            end = re.search(rf"^#{{1,{len(found[1])}}} ", rest, re.M)
            return rest[: end.start()] if end else rest
    raise AssertionError(f"{page.name} has no {place}")


def figures(text: str) -> list[str]:
    """Numbers of two digits or more in a text, code and the numbers of readings (", 4.5") left out."""
    plain = re.sub(r"`[^`]*`|\]\([^)]*\)|(?:, |paper\.md )[1-4]\.\d{1,2}(?=[\s;,]|$)", " ", text)
    return [figure.replace("−", "-") for figure in FIGURE.findall(plain.replace("−", "-"))]


def stands_in(figure: str, text: str) -> bool:
    return re.search(rf"(?<![\w.-]){re.escape(figure)}(?!\.?\d)", text.replace("−", "-")) is not None


def lost_figures(here: str) -> list[str]:
    """Figures of a cell that are not in the sections which it calls measured."""
    places = [section(PAGE.parent / page, place) for page, place in MEASURED.findall(here)]
    return [figure for figure in figures(here) if not any(stands_in(figure, text) for text in places)]


def test_figures_called_measured_stand_on_the_page_of_results() -> None:
    measured = [(cited, here) for cited, here in ROWS if MEASURED.search(here)]
    assert len(measured) > 10 and sum(len(figures(here)) for _, here in measured) > 30
    wrong = [f"R{min(cited):03}: {figure}" for cited, here in measured for figure in lost_figures(here)]
    assert not wrong, wrong


def test_a_wrong_figure_would_be_found() -> None:
    link = "[measured](results/paper.md#52-gains)"
    assert lost_figures(f"{link}: yes, 0.826 → 0.0379 → 0.0361") == []
    assert lost_figures(f"{link}: 0.826 → 0.0503, −0.178 and 12 × `mbkf15`, 4.5") == ["0.0503", "12"]
    assert lost_figures("[measured](results/paper.md#51-imu-errors): 0.0379") == ["0.0379"]  # of another section


def test_what_a_page_of_results_measured_is_not_called_unmeasured() -> None:
    """A requirement that a page of results cites has a link to that page; one said to be missing is cited by none."""
    wrong = []
    for page in sorted((ROOT / "docs" / "results").glob("*.md")):
        cited = requirements(page.read_text())
        for numbers, here in ROWS:
            if numbers & cited and f"results/{page.name}" not in here:
                wrong.append(f"R{min(numbers):03} is measured on {page.name}, but its row has no link there: {here}")
    wrong += [
        f"R{min(numbers):03}: {here}"
        for numbers, here in ROWS
        if re.search(r"\bnot (measured|run)\b", here) and "results/" in here
    ]
    assert not wrong, "\n".join(wrong)


@cache
def identifiers() -> tuple[frozenset[str], dict[str, set[str]]]:
    """Every name that the package defines or its configuration has as a key or file, and the members of each class."""
    names: set[str] = set()
    members: dict[str, set[str]] = {}
    for file in (ROOT / "src").rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.ClassDef | ast.FunctionDef):
                names.add(node.name)
            if isinstance(node, ast.ClassDef):
                members.setdefault(node.name, set()).update(
                    x for child in node.body for x in (getattr(child, "name", None), target(child)) if x
                )
            names |= {x for x in (target(node),) if x}
    for file in (ROOT / "conf").rglob("*.yaml"):
        names.add(file.stem)
        names |= keys(yaml.safe_load(file.read_text()))
    return frozenset(names.union(*members.values())), members


def target(node: ast.AST) -> str | None:
    """The name that an assignment or a field gives."""
    first = node.targets[0] if isinstance(node, ast.Assign) else getattr(node, "target", None)
    return first.id if isinstance(first, ast.Name) else None


def keys(values: object) -> set[str]:
    """The keys of nested mappings."""
    if isinstance(values, list):
        return set().union(*map(keys, values))
    return {str(k) for k in values}.union(*map(keys, values.values())) if isinstance(values, dict) else set()


def test_names_in_the_tables_are_names_in_the_code() -> None:
    names, members = identifiers()
    filters = set(re.findall(r"`(\w+)`", (ROOT / "docs" / "filters.md").read_text()))
    lost = []
    for numbers, here in ROWS:
        for name in re.findall(r"`(\w+|[A-Z]\w*\.\w+)`", here):  # settings with a dot: test_commands
            owner, _, member = name.partition(".")
            known = member in members.get(owner, ()) if member else owner in names | filters
            lost += [] if known else [f"R{min(numbers):03}: {name}"]
    assert not lost, lost
