"""Wrong arguments of all commands: exit code 2, one line on stderr that says what and where, nothing half-written."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest

from tests.commands.refusals import FAST, SCORED, SOLVED, TRAINED, is_refused


@pytest.mark.parametrize("command", FAST)
@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["model=mbkf15", "dataset=nowhere"], ("nowhere", "no such folder")),
        (["model=mbkf16", "dataset=town"], ("unknown model 'mbkf16'", "mbkf15")),
        (["model=mbkf15_prior", "dataset=town"], ("prior.mean",)),
        (["model=mbkf15", "dataset=town", "imu=best"], ("imu/best", "consumer")),
        (["model=mbkf15", "dataset=town", "speed=1"], ("unknown config key 'speed'",)),
        (["model=mbkf15", "dataset=town", "tuning.fun=2"], ("unknown config key 'tuning.fun'",)),
        (["model=mbkf15", "dataset=town", "imu.gyro.noise_density=-1"], ("noise_density", "-1")),
        (["model=mbkf15", "dataset=town", "imu.gyro.noise_density=low"], ("noise_density", "'low'")),
        (["model=mbkf15", "dataset=town", "rate_hz=0"], ("rate_hz",)),
        (["model=mbkf15", "dataset=town", "drives=[nobody]"], ("nobody",)),
        (["model=mbkf15", "dataset=town", "drives=[]"], ("drives", "null")),
        (["model=mbkf15", "dataset=town", "drives=[car-00,car-00]"], ("car-00", "twice")),
        (["model=mbkf15", "dataset"], ("dataset",)),
        (["model=mbkf15"], ("dataset is missing",)),
    ],
    ids=lambda x: " ".join(x),
)
def test_wrong_arguments(command, arguments, said, copy, call, tmp_path):
    done = call(command, *arguments, "out=made")
    is_refused(done, *said, folder=tmp_path)


CONSTANTS = {
    "$SCORED": SCORED,
    "$SOLVED": SOLVED,
    "$TRAINED": TRAINED,
    "$NOWHERE": ("tracking.uri=sqlite:///nowhere.db",),
}
LINES = [
    line
    for line in Path(__file__).with_name("wrong_words.txt").read_text().splitlines()
    if line and not line.startswith("#")
]


@pytest.mark.parametrize("line", LINES)
def test_of_all_commands(line, copy, call, tmp_path):
    words, said = line.split(" -> ")
    command, *arguments = (x for word in shlex.split(words) for x in CONSTANTS.get(word, (word,)))
    (tmp_path / "logs").mkdir()
    is_refused(call(command, *arguments), said, folder=tmp_path)
