"""``make docs``: the pages build without a warning and need nothing from elsewhere when they are read."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.commands  # `make docs` fails of a warning too
ROOT = Path(__file__).parents[2]
REMOTE = re.compile(r'<(?:script|link|img|iframe)\b[^>]*?(?:src|href)="(?:https?:)?//[^"]+"')


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("mkdocs")
    folder = tmp_path_factory.mktemp("site")
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(folder)],
        cwd=ROOT, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"}, capture_output=True, text=True,
    )  # fmt: skip
    assert built.returncode == 0, built.stdout + built.stderr
    assert "WARNING" not in built.stderr + built.stdout, built.stderr
    return folder


def test_every_page_and_every_room_is_there(site: Path) -> None:
    pages = {p.relative_to(ROOT / "docs").with_suffix(".html") for p in (ROOT / "docs").rglob("*.md")}
    rooms = {p.parent.name for p in (ROOT / "src" / "dlkf").glob("*/__init__.py")}
    expected = pages | {Path("index.html"), Path("results/index.html")} | {Path("api") / f"{r}.html" for r in rooms}
    assert not {str(p) for p in expected if not (site / p).is_file()}


def test_nothing_is_fetched_when_a_page_is_read(site: Path) -> None:
    for page in site.rglob("*.html"):
        assert not REMOTE.search(page.read_text()), page
    assert "@import" not in (site / "site" / "pages.css").read_text()


def test_equations_are_drawn(site: Path) -> None:
    text = (site / "algorithm.html").read_text()
    assert text.count('<svg class="equation"') > 100
    assert "arithmatex" not in text


def test_docstrings_and_names_are_linked(site: Path) -> None:
    assert 'id="dlkf.navigation.strapdown.strapdown"' in (site / "api" / "navigation.html").read_text()
    assert 'href="api/navigation.html#dlkf.navigation.strapdown.strapdown"' in (site / "algorithm.html").read_text()
    pages = {p.name: p.read_text() for p in site.rglob("*.html")}
    assert not [name for name, text in pages.items() if "][dlkf." in text]
    assert ":func:" not in "".join(p.read_text() for p in (site / "api").glob("*.html"))


def test_numbers_of_tables_break_in_whole_intervals_and_pictures_have_captions(site: Path) -> None:
    text = (site / "results" / "faulty_data.html").read_text()
    assert '<span class="joined">[0.41, 1.01]</span>' in text and '<span class="joined">4.6 / 2.45</span>' in text
    narrow = (site / "results" / "vibration.html").read_text()
    assert '<span class="joined">0.61 [0.40, 0.91]</span>' in narrow
    assert "<figcaption>Shapes of the spectrum over distance on real drives</figcaption>" in narrow
