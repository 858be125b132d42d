"""A command that is stopped half-way leaves no half dataset, and the same command then goes through."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import pytest

from dlkf.data.validate import validate_dataset

SIMULATE = (
    "simulate",
    "dataset=one_imu",
    "out=made/town",
    "dataset.drive_minutes=1",
    "dataset.imu_rate_hz=50",
)
ENOUGH = "dataset.hours=100"  # hours of work that nobody waits for


def stopped(folder: Path, begun: str, how: signal.Signals, *command: str) -> int:
    """Start a command, send it a signal when a file like ``begun`` is there, and return its exit code."""
    process = subprocess.Popen(
        [sys.executable, "-m", f"dlkf.{command[0]}", *command[1:]],
        cwd=folder,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        preexec_fn=_heed_interrupts,
    )
    end = time.monotonic() + 60
    while not any(folder.glob(begun)) and time.monotonic() < end and process.poll() is None:
        time.sleep(0.02)
    process.send_signal(how)
    try:
        return process.wait(timeout=60)
    finally:
        process.kill()


def _heed_interrupts() -> None:
    """A shell's background job, and all that it starts, ignores SIGINT; a command at a prompt does not."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_simulate(how, call, tmp_path):
    code = stopped(tmp_path, "made/.town.partial*/imu/*", how, *SIMULATE, ENOUGH)
    assert code == (130 if how == signal.SIGINT else -how)
    assert not (tmp_path / "made" / "town").exists()
    if how == signal.SIGINT:
        assert list((tmp_path / "made").iterdir()) == []
        return
    done = call(*SIMULATE, "dataset.hours=0.02")
    assert done.code == 0, done.err
    assert len(validate_dataset(tmp_path / "made" / "town")) == 2


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
