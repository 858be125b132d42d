"""The tutorials run from the first cell to the last, and their pages are of these notebooks."""

from __future__ import annotations

import os
import re
import shutil
import sys
from pathlib import Path

import pytest

from tests.docs.pages import ROOT

pytest.importorskip("jupytext")
sys.path.insert(0, str(ROOT / "docs" / "site"))
import tutorials

MOST_KB = 120  # of a page's picture


def pages() -> list[str]:
    return tutorials.tutorials()


@pytest.mark.commands
@pytest.mark.parametrize("name", pages())
def test_a_tutorial_runs_and_its_page_is_of_it(
    name: str, tmp_path: Path, template: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its cells, as many pictures, and the same words in what it prints (figures depend on the machine)."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join((str(ROOT / "src"), os.environ.get("PYTHONPATH", ""))))
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    shutil.copy(template, tmp_path)
    page, pictures = tutorials.page_of(tutorials.execute(name, tmp_path), name)
    committed = (tutorials.FOLDER / f"{name}.md").read_text()
    assert tutorials.code_blocks(page) == tutorials.code_blocks(committed), "run docs/site/tutorials.py"
    assert sorted(pictures) == sorted(p.name for p in tutorials.FIGURES.glob(f"{name}-*.png"))
    assert len(re.findall("^```text$", page, re.M)) == len(re.findall("^```text$", committed, re.M))


def test_pages_and_pictures_are_small_and_in_the_navigation() -> None:
    navigation = (ROOT / "mkdocs.yml").read_text()
    assert len(pages()) >= 2
    for name in pages():
        assert f"tutorials/{name}.md" in navigation
    assert not [p.name for p in tutorials.FIGURES.glob("*.png") if p.stat().st_size > 1000 * MOST_KB]
