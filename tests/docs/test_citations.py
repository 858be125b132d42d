"""What code and pages cite is there: requirements and readings of docs/paper.md, files, links."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import dlkf

ROOT = Path(__file__).parents[2]
PAPER = (ROOT / "docs" / "paper.md").read_text()
CITING = [
    file
    for folder in ("src", "conf", "pipelines", "tests", "docs")
    for file in sorted((ROOT / folder).rglob("*"))
    if file.suffix in (".py", ".yaml", ".md") and file != ROOT / "docs" / "paper.md"
]
PAGES = [ROOT / "README.md", ROOT / "RESULTS.md", *sorted((ROOT / "docs").rglob("*.md"))]

REQUIREMENT = re.compile(r"\bR(\d{3})(?:\s?[–-]\s?R?(\d{3}))?\b")  # R085, R085–R088, R085-088
READING = re.compile(r"paper\.md\s+((?:\d+(?:\.\d+)?(?:\s+[A-Z]\d)?(?:,\s+|\s?–\s?|\s+and\s+)?)+)")
LINK = re.compile(r"\]\(([^)#\s]+)(#[^)\s]*)?\)")
FILE = re.compile(r"`((?:[a-z_]+/)+[a-z_0-9]+\.(?:py|yaml|md))`")


def requirements(text: str) -> set[int]:
    """The numbers behind R…, ranges in full."""
    return {n for a, b in REQUIREMENT.findall(text) for n in range(int(a), int(b or a) + 1)}


def readings(text: str) -> set[str]:
    """The numbers behind "paper.md", ranges in full."""
    found: set[str] = set()
    for listed in READING.findall(text):
        for low, high in re.findall(r"(\d+(?:\.\d+)?)(?:\s?–\s?(\d+\.\d+))?", re.sub(r"[A-Z]\d", "", listed)):
            found.add(low)
            if high:
                chapter, first = low.split(".")
                found |= {f"{chapter}.{n}" for n in range(int(first), int(high.split(".")[1]) + 1)}
    return found


STATED = {n for row in re.findall(r"^\| (R[^|]+) \|", PAPER, re.M) for n in requirements(row)}
READ = set(re.findall(r"^### (\d+(?:\.\d+)?) ", PAPER, re.M))


def test_the_ways_of_citing_are_understood() -> None:
    assert requirements("(R085–R088, R090; R012)") == {85, 86, 87, 88, 90, 12}
    assert readings("(paper.md 4.10 G0, 4.11 E0): x 5.1") == {"4.10", "4.11"}
    assert readings("paper.md 2.1, 2.5–2.7)") == {"2.1", "2.5", "2.6", "2.7"}
    assert readings("see paper.md\n    4.7 and 4.9.") == {"4.7", "4.9"}


def test_every_cited_requirement_and_reading_is_in_the_page_of_the_paper() -> None:
    assert len(STATED) > 100 and len(READ) > 20
    missing = []
    for file in CITING:
        text = file.read_text()
        lost = {f"R{n:03}" for n in requirements(text) - STATED} | (readings(text) - READ)
        missing += [f"{file.relative_to(ROOT)}: {', '.join(sorted(lost))}"] if lost else []
    assert not missing, missing


def test_the_page_of_the_paper_cites_its_own_readings() -> None:
    of_tables = "\n".join(line for line in PAPER.splitlines() if line.startswith("| R"))
    cited = set(re.findall(r", ([124]\.\d{1,2})(?= \|)", of_tables))
    assert cited and cited <= READ


def test_no_source_outside_the_project_is_cited() -> None:
    outside = re.compile(r"\b[Cc]hecklist \d|\bDESIGN\b|paper,? line \d")
    citing = [str(f.relative_to(ROOT)) for f in CITING if f != Path(__file__) and outside.search(f.read_text())]
    assert not citing, citing


def test_links_and_named_files_exist() -> None:
    lost = [f"{page.relative_to(ROOT)}: {target}" for page in PAGES for target in lost_targets(page)]
    assert not lost, "\n".join(lost)


def lost_targets(page: Path) -> list[str]:
    """Links, anchors and files that a page names and that are not there."""
    text = page.read_text()
    lost = [t for t, _ in LINK.findall(text) if "://" not in t and not (page.parent / t).exists()]
    homes = (ROOT, ROOT / "src" / "dlkf")
    lost += [f for f in FILE.findall(text) if not f.startswith("mine/") and not any((h / f).exists() for h in homes)]
    lost += [a for a in re.findall(r"\]\((#[^)\s]*)\)", text) if a[1:] not in anchors(page)]
    places = [(t, a) for t, a in LINK.findall(text) if a and t.endswith(".md")]
    return lost + [f"{t}{a}" for t, a in places if a[1:] not in anchors(page.parent / t)]


@cache
def anchors(page: Path) -> set[str]:
    """Anchors of a page's headings, as GitHub and MkDocs make them."""
    heads = re.findall(r"^#+ (.+)$", page.read_text(), re.M) if page.exists() else []
    return set(map(anchor, heads))


def anchor(heading: str) -> str:
    """That of one heading."""
    return re.sub(r"[^\w\- ]", "", heading.replace("`", "").lower()).strip().replace(" ", "-")


def test_named_objects_exist() -> None:
    dotted = re.compile(r"`(dlkf(?:\.\w+)+)(?:\(\))?`")
    named = {(str(page.relative_to(ROOT)), name) for page in PAGES for name in dotted.findall(page.read_text())}
    lost = [f"{page}: {name}" for page, name in sorted(named) if not name.endswith((".c", ".h")) and not found(name)]
    assert not lost, "\n".join(lost)


@cache
def found(name: str) -> bool:
    """Whether a dotted name leads to a module, or to a function, class or value in one; nothing is imported."""
    place, parts = ROOT / "src", name.split(".")
    while parts and (place / parts[0]).is_dir():
        place /= parts.pop(0)
    if parts and (place / f"{parts[0]}.py").is_file():
        place = place / f"{parts.pop(0)}.py"
    body = ast.parse((place / "__init__.py" if place.is_dir() else place).read_text()).body
    for part in parts:
        inside = next((node for node in body if part in named_by(node)), None)
        if inside is None:
            home = dlkf.PUBLIC.get(name.removeprefix("dlkf."))  # imported when first used
            return home is not None and found(f"{home}.{part}")
        body = getattr(inside, "body", [])
    return True


def named_by(node: ast.stmt) -> set[str]:
    """The names that a statement gives."""
    if isinstance(node, ast.ClassDef | ast.FunctionDef):
        return {node.name}
    targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
    return {target.id for target in targets if isinstance(target, ast.Name)}
