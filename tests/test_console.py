"""How far long work has come, in a file as on a terminal."""

from __future__ import annotations

import dlkf.console
from dlkf.console import counting


def test_in_a_file_a_line_now_and_then(capsys, monkeypatch):
    """The stderr of a test is no terminal: nothing of quick work, of long work steps done, in all, time left."""
    with counting("Sorting") as progress:
        progress(1, 4)
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(dlkf.console, "SAY_EVERY_S", 0.0)
    with counting("Sorting") as progress:
        progress(1, 4)
        progress(5, None)
    first, second = capsys.readouterr().err.splitlines()
    assert first.startswith("Sorting: 1/4 after ") and first.endswith(" s left")
    assert second.startswith("Sorting: 5 after ")
