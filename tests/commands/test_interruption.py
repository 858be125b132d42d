"""A command that is stopped half-way leaves no half dataset, and the same command then goes through."""

from __future__ import annotations

import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from multiprocessing.context import ForkProcess
from pathlib import Path

import pandas as pd
import pytest

from dlkf.base.errors import InputError
from dlkf.base.files import PARTIAL, replace_folder, require_empty, restore_folder, write_into
from dlkf.data.tables import read_drives
from dlkf.data.validate import validate_dataset
from tests.shell import PATIENCE_S, start_command

pytestmark = pytest.mark.whole
SIMULATE = ("simulate", "dataset=one_imu", "out=made/town", "dataset.drive_minutes=1", "dataset.imu_rate_hz=50")
ENOUGH = "dataset.hours=100"  # hours of work that nobody waits for


def stopped(folder: Path, begun: str, how: signal.Signals, process: ForkProcess | subprocess.Popen, said: Path) -> int:
    """Send a process a signal when a file like ``begun`` is there, and return its exit code.

    Only then: a signal that comes before it would test something else.
    """
    ended = process.poll if isinstance(process, subprocess.Popen) else lambda: process.exitcode
    try:
        end = time.monotonic() + PATIENCE_S
        while not any(folder.glob(begun)):
            if ended() is not None or time.monotonic() > end:
                pytest.fail(f"{begun} never came (exit code {ended()}): {said.read_text()[-2000:]}")
            time.sleep(0.02)
        assert process.pid is not None
        os.kill(process.pid, how)
        process.wait(PATIENCE_S) if isinstance(process, subprocess.Popen) else process.join(PATIENCE_S)
        code = ended()
        assert code is not None
        return code
    finally:
        process.kill()


CODES = {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGKILL: -signal.SIGKILL}


@pytest.mark.parametrize("how", CODES)
def test_simulate(how, call, tmp_path):
    process = start_command(tmp_path, said := tmp_path / "said", *SIMULATE, ENOUGH)
    code = stopped(tmp_path, "made/.town.partial*/imu/*", how, process, said)
    assert code == CODES[how]
    assert not (tmp_path / "made" / "town").exists()
    if how != signal.SIGKILL:
        assert list((tmp_path / "made").iterdir()) == []
        return
    (left,) = (tmp_path / "made").iterdir()
    assert left.name.startswith(".town.partial-")
    done = call(*SIMULATE, "dataset.hours=0.02")
    assert done.code == 0, done.err
    assert len(validate_dataset(tmp_path / "made" / "town")) == 2
    assert [p.name for p in (tmp_path / "made").iterdir()] == ["town"]  # what the killed one had begun is gone


def test_ingest(town, tmp_path):
    """Many drives, so that there is time to stop between two of them."""
    source = next((town / "imu").iterdir()).name
    for kind in ("imu", "gnss"):
        table = pd.read_parquet(town / kind / source / "part-0.parquet", partitioning=None)
        table.to_csv(tmp_path / f"{kind}.csv", index=False)
    for k in range(30):
        (tmp_path / "logs" / f"drive-{k}").mkdir(parents=True)
        for kind in ("imu", "gnss"):
            os.link(tmp_path / f"{kind}.csv", tmp_path / "logs" / f"drive-{k}" / f"{kind}.csv")
    process = start_command(tmp_path, said := tmp_path / "said", "ingest", "reader=csv", "source=logs", "out=made/town")
    code = stopped(tmp_path, "made/.town.partial*/imu/*", signal.SIGINT, process, said)
    assert code == 130
    assert list((tmp_path / "made").iterdir()) == []


TRAIN = (
    "train", "name=town", "data=drives", "data.datasets=[town]", "data.batch_size=2", "data.length_s=20",
    "data.eval_length_s=24", "data.split=random", "model.network.lstm_hidden=4", "model.network.lstm_layers=1",
    "model.network.dense=[4,4]", "baselines.tune=false", "baselines.models=[mbkf15]", "baselines.segments=2",
    "trainer.max_epochs=100000", "trainer.accelerator=cpu", "scoring.outage={first_s:10,duration_s:10}",
)  # fmt: skip


@pytest.mark.commands
def test_train(town, template, tmp_path):
    """SIGTERM in the middle of a training in an interpreter of its own: the exit code says so, and MLflow's run is no
    longer running."""
    (tmp_path / "town").symlink_to(town)
    shutil.copy(template, tmp_path / "mlflow.db")
    with (said := tmp_path / "said").open("w") as says:
        words = [sys.executable, "-m", f"dlkf.{TRAIN[0]}", *TRAIN[1:]]
        process = subprocess.Popen(words, cwd=tmp_path, stdout=says, stderr=says)
    assert stopped(tmp_path, "outputs/train/town/*/last.ckpt", signal.SIGTERM, process, said) == 143
    with closing(sqlite3.connect(tmp_path / "mlflow.db")) as store:
        assert store.execute("select status from runs").fetchall() == [("KILLED",)]


@pytest.mark.parametrize(("signal_", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interrupt_that_became_another_error_is_one(signal_, code, call, monkeypatch):
    """pandas' reader calls back to Python for its bytes, and says "read failed" of what is raised there."""

    def cut_off(*_):
        os.kill(os.getpid(), signal_)
        raise AssertionError("the handler has not raised")

    def read(*_):
        try:
            cut_off()
        except KeyboardInterrupt:
            raise InputError("x.csv: cannot be read") from None

    monkeypatch.setattr("dlkf.doctor.drive_rows", read)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
    try:
        ended = call("doctor", "dataset=x")
    finally:
        signal.signal(signal.SIGINT, before)
    assert ended.code == code and "cannot be read" not in ended.err


@pytest.mark.commands
def test_a_reader_that_has_gone_ends_a_command_without_a_word(town, tmp_path):
    """As ``dlkf navigate … | head -1`` does."""
    command = (sys.executable, "-m", "dlkf.navigate", "model=ins", f"dataset={town}", f"out={tmp_path}/solved")
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stderr is not None
        process.stdout.close()
        assert (process.stderr.read(), process.wait(PATIENCE_S)) == ("", 141)
    assert (tmp_path / "solved" / "report.html").exists()


@pytest.mark.commands
@pytest.mark.parametrize("command", [("dlkf.ingest", "--help"), ("dlkf", "ingest", "--help")], ids=" ".join)
def test_a_reader_of_the_help_that_has_gone_ends_it_without_a_word(command):
    with subprocess.Popen((sys.executable, "-m", *command), stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stderr is not None
        process.stdout.close()
        assert (process.stderr.read(), process.wait(PATIENCE_S)) == (b"", 141)


def killed(program: str) -> None:
    """Run a program that ends itself by SIGKILL."""
    done = subprocess.run([sys.executable, "-c", f"import os, pathlib, signal\n{program}"], timeout=PATIENCE_S)
    assert done.returncode == -signal.SIGKILL


DIES = "os.kill(os.getpid(), signal.SIGKILL)"


def two_files(program: str, out: Path) -> str:
    """A program that puts two files into a folder by ``write_into``, of which ``program`` changes the means."""
    writes = f"with write_into({str(out)!r}) as f:\n (f / 'a').write_text('new')\n (f / 'b').write_text('new')\n"
    return f"from dlkf.base.files import write_into, replace_folder\n{program}\n{writes}"


@pytest.mark.parametrize("at", ["in the block", "as it moves"])
def test_what_a_kill_left_does_not_stand_in_the_way(at, tmp_path):
    """Nobody cleans up after SIGKILL: none or all of the files are there, and the same command goes through at once."""
    out = tmp_path / "made"
    moves = f"os.replace = pathlib.Path.rename = lambda *_: {DIES}"
    killed(two_files(moves, out) if at == "as it moves" else two_files("", out) + f" {DIES}")
    assert not out.exists() and len(list(tmp_path.iterdir())) == 1
    require_empty(out, overwrite=False)
    with write_into(out) as folder:
        (folder / "report.html").write_text("whole")
    assert [p.name for p in tmp_path.iterdir()] == ["made"] and [p.name for p in out.iterdir()] == ["report.html"]
    with pytest.raises(InputError, match="exists already"):
        require_empty(out, overwrite=False)


def test_what_a_kill_left_in_a_folder_is_cleared(tmp_path):
    """Where other things lie, files move one by one: the same command, with overwrite=true, makes it whole."""
    (tmp_path / "other").write_text("stays")
    killed(two_files("", tmp_path) + f" {DIES}")
    assert len(list(tmp_path.iterdir())) == 2
    with write_into(tmp_path) as folder:
        (folder / "a").write_text("new")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a", "other"]


def test_a_kill_between_two_renames_loses_nothing(tmp_path):
    """The old dataset waits beside; whoever writes or reads there next puts it back."""
    town = tmp_path / "town"
    program = "import sys\nfrom dlkf.base.files import replace_folder\nrename = pathlib.Path.rename\n"
    program += "def once(self, other):\n rename(self, other)\n " + DIES + "\n"
    program += f"pathlib.Path.rename = once\nwith replace_folder({str(town)!r}) as f:\n (f / 'x').write_text('new')"
    for reads in (False, True):
        town.mkdir(exist_ok=True)
        (town / "x").write_text("old")
        killed(program)
        assert not town.exists()
        if reads:
            with pytest.raises(InputError, match="is missing"):
                read_drives(town)
        else:
            restore_folder(town)
        assert (town / "x").read_text() == "old" and [p.name for p in tmp_path.iterdir()] == ["town"]
    with replace_folder(town) as folder:
        (folder / "x").write_text("new")
    assert (town / "x").read_text() == "new" and [p.name for p in tmp_path.iterdir()] == ["town"]


def test_what_another_machine_left_or_is_at_stays(tmp_path):
    theirs = tmp_path / f"{PARTIAL}elsewhere-1234-5"
    theirs.mkdir()
    with write_into(tmp_path) as folder:
        (folder / "report.html").write_text("ours")
    assert sorted(p.name for p in tmp_path.iterdir()) == [theirs.name, "report.html"]


def test_of_two_commands_with_one_folder_the_second_is_refused(tmp_path):
    """Neither clears the other's files away, and what is there first stays."""
    target = tmp_path / "town"
    alive = f"from dlkf.base.files import replace_folder\nwith replace_folder({str(target)!r}) as f:\n"
    alive += " (f / 'imu').write_text('other'); print('there', flush=True); input()"
    pipe = subprocess.PIPE
    other = subprocess.Popen([sys.executable, "-c", alive], stdin=pipe, stdout=pipe, stderr=pipe, text=True)
    assert other.stdout is not None and other.stdout.readline() == "there\n"
    with replace_folder(target) as folder:
        (folder / "imu").write_text("this")
    assert (target / "imu").read_text() == "this"
    _, said = other.communicate("\n", timeout=PATIENCE_S)
    assert other.returncode == 1 and "another command wrote there in the meantime" in said
    assert (target / "imu").read_text() == "this" and [p.name for p in tmp_path.iterdir()] == ["town"]
