"""The blocks of docs/python.md run as they stand, one after the other."""

from __future__ import annotations

import pytest

from tests.docs.pages import ROOT, blocks


@pytest.mark.commands
@pytest.mark.whole
def test_the_blocks_run(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    space: dict = {"__name__": "page"}
    for block in blocks(ROOT / "docs" / "python.md"):
        exec(compile(block.text.replace("minutes=6", "minutes=2"), "python.md", "exec"), space)
    assert "30 s without GNSS, " in capsys.readouterr().out
    assert (tmp_path / "map.html").is_file() and (tmp_path / "solution.csv").is_file()
