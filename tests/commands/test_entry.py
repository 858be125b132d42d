"""``dlkf <command>``, what it offers, ``doctor`` and ``compare``."""

from __future__ import annotations

import os
import pwd
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

import dlkf
from dlkf.__main__ import COMMANDS, _load, main
from dlkf.base.config import config_dir
from dlkf.command.arguments import move_options_first, quote_argument
from dlkf.data.schema import drive_file
from tests.shell import PATIENCE_S

EVALUATE = ("rate_hz=10", "length_s=60", "outage.first_s=20", "outage.duration_s=20", "injected_bias=null")
EVALUATE += ("tracking.log=false",)


def typed(monkeypatch, capsys, *words: str) -> tuple[int, str, str]:
    monkeypatch.setattr(sys, "argv", ["dlkf", *words])
    code = 0
    try:
        main()
    except SystemExit as end:
        code = int(end.code or 0)
    return code, *capsys.readouterr()


def test_what_there_is(monkeypatch, capsys):
    assert typed(monkeypatch, capsys, "--version") == (0, f"dlkf {dlkf.__version__}\n", "")
    code, out, _ = typed(monkeypatch, capsys)
    assert code == 0 and all(f"  {name}" in out for name in COMMANDS)
    code, _, err = typed(monkeypatch, capsys, "fly")
    assert code == 2 and err.startswith("dlkf: error: unknown command 'fly'; known: simulate") and err.count("\n") == 1


def test_handlers_of_signals_are_as_before(monkeypatch, capsys):
    before = signal.getsignal(signal.SIGTERM)
    typed(monkeypatch, capsys, "--version")
    assert signal.getsignal(signal.SIGTERM) is before


def test_threads_of_torch_sleep_but_in_a_training(monkeypatch):
    monkeypatch.setattr("dlkf.__main__.import_module", lambda name: SimpleNamespace(main=name))
    for command, policy in (("train", None), ("navigate", "PASSIVE")):
        monkeypatch.setenv("OMP_WAIT_POLICY", "given")
        monkeypatch.delenv("OMP_WAIT_POLICY")
        assert _load(command) == f"dlkf.{command}"
        assert os.environ.get("OMP_WAIT_POLICY") == policy


END = """
import atexit, sys, threading, time
from dlkf.base.own_process import end_at_once
atexit.register(print, "registered")
class Left:
    def __del__(self): print("taken apart")
left = Left()
before
print("done")
end_at_once()
print("went on")
"""


@pytest.mark.parametrize(
    ("before", "said"),
    [
        ("pass", ["done", "registered"]),
        ("threading.Thread(target=time.sleep, args=(0.2,)).start()", ["done", "went on", "registered", "taken apart"]),
        ("sys.modules['mlflow'] = sys", ["done", "went on", "registered", "taken apart"]),
    ],
)
def test_a_command_ends_without_taking_apart_what_is_loaded(before, said):
    """But what was registered for its end is done, and threads and stores end as usual."""
    done = subprocess.run([sys.executable, "-c", END.replace("before", before)], capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.splitlines() == said and not done.stderr


def test_output_that_cannot_be_written_ends_as_usual():
    """With Python's own line and status for a full disk."""
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full here")
    buffered = {key: value for key, value in os.environ.items() if key != "PYTHONUNBUFFERED"}
    program = "from dlkf.base.own_process import end_at_once; print(1); end_at_once()"
    with open("/dev/full", "w") as full:
        done = subprocess.run([sys.executable, "-c", program], stdout=full, stderr=subprocess.PIPE, env=buffered)
    assert done.returncode == 120


@pytest.mark.whole
@pytest.mark.parametrize(
    "given",
    [
        pytest.param({"PYTHONIOENCODING": "latin-1"}, marks=pytest.mark.commands),
        {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
    ],
    ids=["latin-1", "ascii"],
)
def test_an_encoding_without_some_letters_fails_no_command(given, town, tmp_path):
    """They are question marks on the screen, and as they are in files."""

    def run(*words: object) -> subprocess.CompletedProcess[bytes]:
        command = [sys.executable, "-m", *map(str, words)]
        return subprocess.run(command, cwd=tmp_path, env=os.environ | given, capture_output=True, timeout=PATIENCE_S)

    for words in (("dlkf",), ("dlkf", "navigate", "--help")):
        done = run(*words)
        assert done.returncode == 0 and b"key=value" in done.stdout and not done.stderr, done.stderr
    done = run("dlkf.navigate", "model=mbkf15", f"dataset={town}", "rate_hz=10", "out=made")
    assert done.returncode == 0 and b"final 1? " in done.stdout, done.stderr
    assert "final 1σ " in (tmp_path / "made" / "log.txt").read_text(encoding="utf-8")


def test_every_command_has_a_module_and_every_configured_one_is_listed():
    here = Path(dlkf.__file__).parent
    assert all((here / f"{name}.py").is_file() for name in COMMANDS)
    assert {p.stem for p in config_dir().glob("*.yaml")} - {"hydra_output"} <= set(COMMANDS)


@pytest.mark.whole
def test_modules_of_the_current_folder_are_found(tmp_path):
    """As ``python -m dlkf.evaluate`` finds them; one with the name of a library does not take its place."""
    (tmp_path / "blend.py").write_text("class Blend:\n    begin = 1\n")
    (tmp_path / "yaml.py").write_text("raise SystemExit('somebody else's file')")
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "dlkf").write_text("from dlkf.__main__ import main\nmain()\n")  # as pip makes it
    command = [sys.executable, "bin/dlkf", "navigate", "model=blend:Blend", "dataset=nowhere", "out=made"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE_S)
    assert done.returncode == 2 and "model=blend:Blend has no begin and step" in done.stderr, done.stderr


def test_settings_on_both_sides_of_an_option():
    words = ["dataset=a", "-m", "model=b,c", "--config-dir", "x=1", "out=d"]
    assert move_options_first(words) == ["-m", "--config-dir", "x=1", "dataset=a", "model=b,c", "out=d"]


@pytest.mark.parametrize(
    ("given", "taken"),
    [
        ("out=outputs/town", "out=outputs/town"),
        ("out=Straße", "out='Straße'"),
        ("out=a b (1)", "out='a b (1)'"),
        ("dataset=out/drive=7", "dataset='out/drive=7'"),
        ("model=[mbkf15,out/drive=7/best]", "model=[mbkf15,'out/drive=7/best']"),
        ("outage.first_s=[20,25]", "outage.first_s=[20,25]"),
        ("imu=consumer,bmi270", "imu=consumer,bmi270"),
        ("scoring.outage={first_s:10}", "scoring.outage={first_s:10}"),
        ("out=it's here", "out='it\\'s here'"),
        ("outage=none", "outage=null"),
        ("out=none", "out=none"),
        ("-m", "-m"),
        ("~baseline", "~baseline"),
    ],
)
def test_ordinary_paths_need_no_quotes(given, taken):
    assert quote_argument(given) == taken
    home = Path.home()
    assert quote_argument("out=~/x") == f"out={home}/x" and quote_argument("out=~") == f"out={home}"
    assert quote_argument("dataset=[~/a, b]") == f"dataset=[{home}/a,b]"
    user = pwd.getpwuid(os.getuid())
    assert quote_argument(f"out=~{user.pw_name}/x") == f"out={user.pw_dir}/x"


@pytest.mark.commands
@pytest.mark.whole
def test_in_a_shell(tmp_path, town):
    """The same command as ``python -m dlkf.navigate``, with a folder that Hydra's grammar does not take."""
    words = ["navigate", "model=ins", f"dataset={town}", "out=Straße (1)/drive=a", "rate_hz=10", "export=[gpx]"]
    done = subprocess.run(
        [sys.executable, "-m", "dlkf", *words], cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE_S
    )
    assert done.returncode == 0, done.stderr
    out = tmp_path / "Straße (1)" / "drive=a"
    assert (out / "report.html").is_file() and len(list(out.glob("drive=*/solution.gpx"))) == 2
    assert "dlkf navigate model=ins" in (out / "report.html").read_text()


def test_doctor_likes_a_simulated_drive(town, call):
    done = call("doctor", f"dataset={town}")
    assert done.code == 0, done.err
    assert "BAD" not in done.out and "100% RTK fixed" in done.out and "pose: the sensor is turned 0." in done.out


def test_doctor_sees_what_is_wrong(town, call, tmp_path):
    """A sensor turned by 90°, a saturated gyroscope."""
    copy = Path(shutil.copytree(town, tmp_path / "town"))
    first, second = sorted(p.name.removeprefix("drive=") for p in (copy / "imu").iterdir())

    def change(kind, drive, edit):
        path = drive_file(copy, kind, drive)
        table = pd.read_parquet(path, partitioning=None)
        edit(table)
        table.to_parquet(path, index=False)

    def turned(imu):
        for s in ("accel", "gyro"):
            imu[f"{s}_x"], imu[f"{s}_y"] = imu[f"{s}_y"].copy(), -imu[f"{s}_x"].copy()

    def saturated(imu):
        imu["gyro_z"] = np.clip(imu["gyro_z"], -0.05, 0.05)

    change("imu", first, turned)
    change("imu", second, saturated)
    done = call("doctor", "dataset=town", f"drives={first}")
    assert done.code == 1 and re.search(r"BAD .*yaw: 90", " ".join(done.out.split())), done.out
    done = call("doctor", "dataset=town", f"drives={second}")
    assert done.code == 1 and "gyro_z stays at 0.05" in done.out, done.out


@pytest.mark.whole
def test_compare(town, call, tmp_path):
    for name, models, imu in (("a", "[ins,mbkf15]", "bmi270"), ("b", "[mbkf15]", "consumer")):
        words = (f"model={models}", f"dataset={town}", f"out={name}", f"imu={imu}")
        done = call("evaluate", *words, *EVALUATE)
        assert done.code == 0, done.err
    (tmp_path / "b").rename(tmp_path / "1-imu=consumer")  # as a sweep names them
    done = call("compare", "a", "1-imu=consumer", "out=c")
    assert done.code == 0, done.err
    (tmp_path / "1-imu=consumer").rename(tmp_path / "b")
    assert "Innovation" in done.out and done.out.rstrip().endswith("Report: c/compare.html")
    assert all(f"\n{name}: " in done.out for name in ("a", "imu=consumer")) and "without GNSS" in done.out
    page = (tmp_path / "c" / "compare.html").read_text()
    assert "2 evaluations compared" in page and "<td>imu</td><td>bmi270</td><td>consumer</td>" in page
    assert page.count("class=figure") == 1
    whole = f"{tmp_path / '1-imu=consumer'}"
    assert f'<td title="{whole}">imu=consumer</td>' in page and f"<td>{whole}</td>" in page
    for words, said in (
        (["a"], "at least two"),
        (["a", str(town)], "no metrics.json"),
        (["a", "b", "out=c"], "overwrite=true"),
        (["a", "b", str(tmp_path / "a")], "given twice"),
    ):
        done = call("compare", *words, *([] if "out=c" in words else ["out=d"]))
        assert done.code == 2 and said in done.err and done.err.count("\n") == 1
