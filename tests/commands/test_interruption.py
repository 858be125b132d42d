"""A command that is stopped half-way leaves no half dataset, and the same command then goes through."""

from __future__ import annotations

import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from contextlib import closing
from pathlib import Path

import pandas as pd
import pytest

from dlkf.data.validate import validate_dataset
from dlkf.errors import InputError
from dlkf.files import PARTIAL, staged, vacant, whole_folder
from tests.shell import PATIENCE_S

SIMULATE = (
    "simulate",
    "dataset=one_imu",
    "out=made/town",
    "dataset.drive_minutes=1",
    "dataset.imu_rate_hz=50",
)
ENOUGH = "dataset.hours=100"  # hours of work that nobody waits for


def stopped(folder: Path, begun: str, how: signal.Signals, *command: str) -> int:
    """Start a command, send it a signal when a file like ``begun`` is there, and return its exit code.

    Only then: a signal that comes before it would test something else.
    """
    with tempfile.TemporaryFile() as said:
        process = subprocess.Popen(
            [sys.executable, "-m", f"dlkf.{command[0]}", *command[1:]],
            cwd=folder,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            stdout=said,
            stderr=said,
            preexec_fn=_heed_interrupts,
        )
        try:
            end = time.monotonic() + PATIENCE_S
            while not any(folder.glob(begun)):
                if process.poll() is not None or time.monotonic() > end:
                    said.seek(0)
                    pytest.fail(f"{begun} never came (exit code {process.poll()}): {said.read()[-2000:].decode()}")
                time.sleep(0.02)
            process.send_signal(how)
            return process.wait(timeout=PATIENCE_S)
        finally:
            process.kill()


def _heed_interrupts() -> None:
    """A shell's background job, and all that it starts, ignores SIGINT; a command at a prompt does not."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


CODES = {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGKILL: -signal.SIGKILL}


@pytest.mark.parametrize("how", CODES)
def test_simulate(how, call, tmp_path):
    code = stopped(tmp_path, "made/.town.partial*/imu/*", how, *SIMULATE, ENOUGH)
    assert code == CODES[how]
    assert not (tmp_path / "made" / "town").exists()
    if how != signal.SIGKILL:
        assert list((tmp_path / "made").iterdir()) == []
        return
    (left,) = (tmp_path / "made").iterdir()
    os.utime(left, (0, 0))  # as if it had been some seconds ago
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
    code = stopped(
        tmp_path,
        "made/.town.partial*/imu/*",
        signal.SIGINT,
        "ingest",
        "reader=csv",
        "source=logs",
        "out=made/town",
    )
    assert code == 130
    assert list((tmp_path / "made").iterdir()) == []


TRAIN = (
    "train", "name=town", "data=drives", "data.datasets=[town]", "data.batch_size=2", "data.length_s=20",
    "data.eval_length_s=24", "data.split=random", "model.network.lstm_hidden=4", "model.network.lstm_layers=1",
    "model.network.dense=[4,4]", "baselines.tune=false", "baselines.models=[mbkf15]", "baselines.pieces=2",
    "trainer.max_epochs=100000", "trainer.accelerator=cpu", "scoring.outage={first_s:10,duration_s:10}",
)  # fmt: skip


def test_train(town, template, tmp_path):
    """SIGTERM in the middle of the training: the exit code says so, and MLflow's run is no longer running."""
    (tmp_path / "town").symlink_to(town)
    shutil.copy(template, tmp_path / "mlflow.db")
    assert stopped(tmp_path, "outputs/train/town/*/last.ckpt", signal.SIGTERM, *TRAIN) == 143
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


def test_what_a_kill_left_does_not_stand_in_the_way(tmp_path):
    """Nobody cleans up after SIGKILL: the files that wait beside the folder's own are not a result."""
    out = tmp_path / "made"
    killed = f"from dlkf.files import staged; import os, signal\nwith staged({str(out)!r}) as f:\n"
    killed += " (f / 'report.html').write_text('half'); os.kill(os.getpid(), signal.SIGKILL)"
    assert subprocess.run([sys.executable, "-c", killed], timeout=PATIENCE_S).returncode == -signal.SIGKILL
    (left,) = out.iterdir()
    os.utime(left, (0, 0))  # as if it had been some seconds ago
    vacant(out, overwrite=False)
    with staged(out) as folder:
        (folder / "report.html").write_text("whole")
    assert [p.name for p in out.iterdir()] == ["report.html"] and (out / "report.html").read_text() == "whole"
    with pytest.raises(InputError, match="exists already"):
        vacant(out, overwrite=False)


def test_what_another_machine_left_or_is_at_stays(tmp_path):
    """Not every file system tells a machine of the locks of others."""
    theirs = tmp_path / f"{PARTIAL}elsewhere-1234"
    theirs.mkdir()
    os.utime(theirs, (0, 0))
    with staged(tmp_path) as folder:
        (folder / "report.html").write_text("ours")
    assert sorted(p.name for p in tmp_path.iterdir()) == [theirs.name, "report.html"]


def test_what_another_command_is_at_is_not_taken_for_dead(tmp_path):
    """Two commands with one target at a time: neither clears the other's files away, however old they are."""
    target = tmp_path / "town"
    alive = f"from dlkf.files import whole_folder\nwith whole_folder({str(target)!r}) as f:\n"
    alive += " (f / 'imu').write_text('other'); print('there', flush=True); input()"
    other = subprocess.Popen([sys.executable, "-c", alive], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert other.stdout is not None and other.stdout.readline() == "there\n"
    for beside in tmp_path.iterdir():
        os.utime(beside, (0, 0))
    with whole_folder(target) as folder:
        (folder / "imu").write_text("this")
    assert (target / "imu").read_text() == "this"
    other.communicate("\n", timeout=PATIENCE_S)
    assert other.returncode == 0 and (target / "imu").read_text() == "other"
    assert [p.name for p in tmp_path.iterdir()] == ["town"]
