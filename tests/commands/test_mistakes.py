"""Locked stores, older results, faults of the machine, points of a sweep: one line each, nothing half-written."""

from __future__ import annotations

import sqlite3
from contextlib import closing

import lightning as L
import pytest
import torch

from dlkf.command.faults import describe_fault
from dlkf.onboard.carried import Layout
from dlkf.tracking import runs
from tests.commands.refusals import FAST, SCORED, SOLVED, TRAINED, is_refused


@pytest.mark.parametrize("lock", ["IMMEDIATE", "EXCLUSIVE"])
@pytest.mark.parametrize(
    "given",
    [
        ("evaluate", *SCORED),
        ("train", *TRAINED),
        ("register", "run=" + "0" * 32, "name=town"),
        ("evaluate", "-m", *SCORED, "model=ins,mbkf15"),
    ],
    ids=["evaluate", "train", "register", "sweep"],
)
def test_a_locked_store_is_told_before_any_work(given, lock, copy, call, tmp_path, monkeypatch):
    """By another program that writes, as long as the command waits; and nothing was begun."""
    monkeypatch.setattr(runs, "LOCKED_S", 0.2)
    kept = tmp_path / "logs"
    kept.mkdir()
    store = kept / "store.db"
    with closing(sqlite3.connect(store)) as other:
        other.executescript(f"CREATE TABLE t (x); BEGIN {lock}")
        ended = call(*given, f"tracking.uri=sqlite:///{store}")
    is_refused(ended, "store.db is locked by another program", folder=tmp_path)


def test_a_training_without_a_word_is_not_begun(call, tmp_path):
    done = call("train")
    assert done.code == 2 and "give what to train: +experiment=outage" in done.err
    assert done.err.count("\n") == 1 and not (tmp_path / "outputs").exists() and not (tmp_path / "data").exists()


@pytest.mark.parametrize("command", FAST)
def test_an_older_result_is_not_written_over(command, copy, call, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "report.html").write_text("of last week")
    done = call(command, "model=ins", "dataset=town", "out=mine", *FAST[command])
    is_refused(done, "out=mine exists already", "overwrite=true", folder=tmp_path)
    assert (tmp_path / "mine" / "report.html").read_text() == "of last week"


@pytest.mark.parametrize(
    ("out", "said"),
    [
        ("a" * 300, "the name is too long for this disk"),
        ("logs/loop", "nowhere"),
        ("logs/loop/made", "nowhere"),
        ("logs/dangling", "/dangling points nowhere (to gone); give another"),
        ("logs/dangling/made", "/dangling points nowhere"),
    ],
    ids=["long", "loop", "in a loop", "dangling", "in a dangling one"],
)
def test_a_place_that_cannot_be_made(out, said, copy, call, tmp_path):
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "loop").symlink_to("loop")
    (tmp_path / "logs" / "dangling").symlink_to("gone")
    is_refused(call("navigate", "model=ins", "dataset=town", f"out={out}"), said, folder=tmp_path)
    is_refused(call("simulate", "dataset=one_imu", f"out={out}"), said, folder=tmp_path)
    assert len(list((tmp_path / "logs").iterdir())) == 2


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (OSError(28, "No space left on device", "/data/x"), "the disk is full"),
        (PermissionError(13, "Permission denied", "/data/x"), "/data/x: permission denied"),
        (OSError(30, "Read-only file system", "/data/x"), "read-only"),
        (OSError(27, "File too large", "/data/x"), "larger than is allowed here"),
        (MemoryError(), "the memory of this machine is full"),
        (RuntimeError("linalg.cholesky: The input is not positive-definite"), "the filter diverged"),
        (RuntimeError("(sqlite3.OperationalError) database is locked"), "locked by another program"),
        (RuntimeError("attempt to write a readonly database"), "cannot be written"),
        (RuntimeError("file is not a database"), "damaged"),
        (RuntimeError("Detected out-of-date database schema (found version a, but expected b)"), "another version"),
        (RuntimeError("No supported gpu backend found!"), "trainer.accelerator=cpu"),
        (RuntimeError("CUDA out of memory. Tried to allocate 2 GiB"), "smaller data.batch_size"),
    ],
)
def test_faults_of_the_machine_are_one_line(error, said):
    """Also from deep inside: what was raised is found in the chain of what it became."""
    try:
        try:
            raise error
        except Exception as inner:
            raise ValueError("Error in call to target") from inner
    except ValueError as outer:
        line = describe_fault(outer)
    assert line is not None and said in line and "\n" not in line
    assert describe_fault(ValueError("a fault of ours")) is None


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU here")
@pytest.mark.parametrize(("accelerator", "said"), [("gpu", "there is no GPU"), ("tpux", "accelerator is unknown")])
def test_a_gpu_that_is_not_there_is_one_line(accelerator, said):
    """Whatever words this version of Lightning finds for it; ``auto`` takes the CPU instead."""
    settings = {"devices": 1, "logger": False, "enable_checkpointing": False, "enable_progress_bar": False}
    with pytest.raises(Exception) as raised:
        L.Trainer(accelerator=accelerator, **settings)
    line = describe_fault(raised.value)
    assert line is not None and said in line and "\n" not in line
    assert L.Trainer(accelerator="auto", **settings).strategy.root_device.type == "cpu"


@pytest.mark.parametrize(
    ("command", "arguments"),
    [
        ("export", ("model=plus", "rate_hz=10", "out=made here", "dataset=town")),
        ("navigate", (*SOLVED, "compiled=true")),
    ],
    ids=["export", "compiled step"],
)
def test_without_a_c_compiler(command, arguments, copy, call, tmp_path, monkeypatch):
    """A filter is exported unchecked, and says so, and its rate is too low; a compiled step cannot be made."""
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "logs"))
    if command == "export":  # which the tests of onboard do at length
        monkeypatch.setattr("dlkf.export.write_source", lambda folder, *_: Layout(torch.zeros(1, 3)))
    ended = call(command, *arguments)
    if command == "navigate":
        is_refused(ended, "no C compiler found", folder=tmp_path)
    else:
        assert ended.code == 0 and "not checked: no C compiler here" in ended.out, ended.err
        assert "plus as C in made here: " in ended.out
        assert "Try it: cd 'made here' && cmake" in ended.out  # as a shell takes it
        assert "plus needs samples at 50 Hz or more" in ended.out
        made = tmp_path / "made here"
        assert (made / "drive.csv").is_file() and (made / "CMakeLists.txt").is_file()


@pytest.mark.whole
def test_what_was_said_lies_beside_the_report(copy, call, tmp_path):
    """The answer, the tables, the drives, as they stood on the screen."""
    for command in FAST:
        ended = call(command, "model=mbkf15", "dataset=town", f"out={command}", *FAST[command])
        assert ended.code == 0, ended.err
        said = (tmp_path / command / "log.txt").read_text().splitlines()
        assert len(said) > 3 and set(said) <= set(ended.out.splitlines())


@pytest.mark.whole
def test_a_point_that_fails_leaves_the_others(copy, call, tmp_path):
    """It is named, twice: when it fails and at the end; the others have their folders and the page beside them."""
    points = ("model=ins,mbkf99,mbkf15", "tracking.log=false")
    done = call("evaluate", "-m", *points, "dataset=town", "out=made", *FAST["evaluate"])
    assert done.code == 2, done.err
    lines = [line for line in done.err.splitlines() if line.startswith("dlkf: error: ")]
    assert lines[0].startswith("dlkf: error: model=mbkf99: unknown model 'mbkf99'")
    assert lines[1] == "dlkf: error: 1 of the points failed: model=mbkf99"
    assert {p.name for p in (tmp_path / "made").iterdir()} == {"0-model=ins", "2-model=mbkf15", "compare.html"}
