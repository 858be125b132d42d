"""``--help`` says what a command does, its presets, and the keys that matter most."""

import subprocess
import sys

import pytest

import dlkf
from dlkf import ui
from dlkf.base.config import config_dir
from dlkf.command import GROUPS
from dlkf.command.help import MOST, describe_key, help_text, list_groups, list_keys

COMMANDS = sorted(path.stem for path in config_dir().glob("*.yaml") if path.stem != "hydra_output")


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_a_page(name):
    page = help_text(name, GROUPS.get(name, {}))
    text = (config_dir() / f"{name}.yaml").read_text()
    assert f"python -m dlkf.{name}" in page and max(map(len, page.splitlines())) < 160
    for group in list_groups(text):
        assert f"={group['choice']}" in page
    for key in MOST[name]:
        assert f"  {key}=" in page
    keys = [k for k, (value, _) in list_keys(text).items() if value[:1] not in ("", "{") and not k.startswith("hydra")]
    assert len(MOST[name]) == min(5, len(keys))


def test_a_preset_of_one_command_is_on_no_other_page():
    pages = {name: help_text(name, GROUPS.get(name, {})) for name in COMMANDS}
    assert {name for name, page in pages.items() if " auto, automotive_mems" in page} == {"navigate"}
    assert sum("automotive_mems, bmi" in page for page in pages.values()) > 5


def test_a_command_prints_it_and_does_nothing_else(call):
    done = call("evaluate", "--help")
    assert done.code == 0 and "model=…" in done.out and "aligned, coarse" in done.out and not done.err


def test_a_command_says_the_version_of_this_package(call):
    done = call("evaluate", "--version")
    assert done.code == 0 and done.out == f"dlkf {dlkf.__version__}\n"


def test_keys_are_read_with_value_and_comment():
    text = "defaults:\n  - start: aligned # how\n  - _self_\n\na: 1 # one\nb: # two\n  c: [1, 2] # three\n"
    text += "d: {e: x, f: 2} # four\n"
    assert list_keys(text) == {
        "a": ("1", "one"), "b": ("", "two"), "b.c": ("[1, 2]", "three"), "d": ("{e: x, f: 2}", "four"),
        "d.e": ("x", "four"), "d.f": ("2", "four"),
    }  # fmt: skip
    assert describe_key(text, "start.yaw_deg")[0] == "2.0"
    with pytest.raises(KeyError):
        describe_key(text, "none")


@pytest.mark.parametrize("option", ["--help", "-h"])
def test_mlflows_pages_say_their_keys(option, capsys, monkeypatch):
    """``dlkf --help`` promises it for every command; this one has no file in ``conf/``."""
    monkeypatch.setattr(sys, "argv", ["dlkf", option])
    ui.main()
    said = capsys.readouterr()
    assert all(f"  {key}=" in said.out for key in ("port", "host", "uri")) and not said.err


@pytest.mark.parametrize("word", ["null", "none", "off"])
def test_no_outage_is_a_word_away(word, call, town):
    """Hydra takes a preset out with ~outage alone; nobody has to know."""
    size = ("model=ins", f"dataset={town}", "length_s=60", "stride_s=60", "injected_bias=null", "tracking.log=false")
    done = call("evaluate", f"outage={word}", "out=seen", *size, "--cfg", "job")
    assert done.code == 0 and "first_s" not in done.out and "length_s: 60" in done.out, done.err


@pytest.mark.whole
def test_help_of_a_command_loads_no_torch():
    """Torch takes seconds to load; ``dlkf train --help`` answers at once."""
    asks = "import sys; from dlkf.__main__ import main; sys.argv = ['dlkf', 'train', '--help']; main(); "
    heavy = "print(sorted({'torch', 'pandas', 'numba', 'lightning', 'mlflow'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", asks + heavy], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]" and "trainer.max_epochs" in done.stdout
