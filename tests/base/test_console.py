"""How far long work has come, in a file as on a terminal."""

from __future__ import annotations

import dlkf.base.console
from dlkf.base.console import show_progress


def test_in_a_file_a_line_now_and_then(capsys, monkeypatch):
    """The stderr of a test is no terminal: nothing of quick work, of long work steps done, in all, time left."""
    with show_progress("Sorting") as progress:
        progress(1, 4)
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(dlkf.base.console, "SAY_EVERY_S", 0.0)
    with show_progress("Sorting") as progress:
        progress(1, 4)
        progress(5, None)
    first, second = capsys.readouterr().err.splitlines()
    assert first.startswith("Sorting: 1/4 after ") and first.endswith(" s left")
    assert second.startswith("Sorting: 5 after ")
