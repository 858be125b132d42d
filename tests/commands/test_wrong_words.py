"""Wrong arguments of all commands: exit code 2, one line on stderr that says what and where, nothing half-written."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest

from tests.commands.refusals import SCORED, SOLVED, TRAINED, is_refused, read_wrong

CONSTANTS = {
    "$SCORED": SCORED,
    "$SOLVED": SOLVED,
    "$TRAINED": TRAINED,
    "$NOWHERE": ("tracking.uri=sqlite:///nowhere.db",),
}


@pytest.mark.parametrize("line", read_wrong(Path(__file__).with_name("wrong_words.txt")))
def test_of_all_commands(line, copy, call, tmp_path):
    words, said = line.split(" -> ")
    command, *arguments = (x for word in shlex.split(words) for x in CONSTANTS.get(word, (word,)))
    (tmp_path / "logs").mkdir()
    is_refused(call(command, *arguments), said, folder=tmp_path)
