"""Drives on other processes: the same files, whoever made them, and whoever was lost on the way."""

from __future__ import annotations

import importlib
import json
import os
import signal
import threading
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from dlkf.base.errors import InputError
from dlkf.base.parallel import check_engine, parallel_map
from dlkf.command.composing import compose_command
from dlkf.data.tables import dataset_digest, read_drives
from tests.drives import drives_in
from tests.jobs import ended, half
from tests.numbers_in import numbers_in
from tests.shell import start_fork

COMMANDS = ("dlkf.simulate", "dlkf.navigate", "dlkf.evaluate", "dlkf.ingest")
DRIVES = 16
SHORT = (f"dataset.hours={DRIVES * 15 / 3600}", "dataset.drive_minutes=0.25", "dataset.imu_rate_hz=50", "seed=5")


def recipe(**more):
    return {**compose_command("simulate", "simulated@dataset=per_drive", "dataset.name=many", *SHORT), **more}


@pytest.fixture(scope="module")
def alone(tmp_path_factory) -> Path:
    return drives_in(recipe(workers=1), tmp_path_factory.mktemp("data") / "many")


@pytest.fixture(scope="module")
def cluster():
    """A scheduler and two workers, each a process, forked from one that has loaded what the commands need."""
    dask, distributed = pytest.importorskip("dask"), pytest.importorskip("distributed")
    with dask.config.set({"distributed.worker.multiprocessing-method": "forkserver"}):
        distributed.utils.get_mp_context().set_forkserver_preload(["distributed", *COMMANDS])
        with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as made:
            yield made


@pytest.fixture
def where(cluster) -> str:
    return cluster.scheduler_address.replace("tcp://", "dask://")


def test_results_come_in_order_and_a_mistake_ends_it():
    for where in (None, 2):
        assert list(parallel_map(half, range(10), where)) == [x / 2 for x in range(10)]
        with pytest.raises(InputError, match="drive 13: no luck"):
            list(parallel_map(half, range(20), where))
    assert list(parallel_map(half, range(10), threads=3)) == [x / 2 for x in range(10)]
    with pytest.raises(InputError, match="a process was killed, most likely because memory ran out"):
        list(parallel_map(ended, range(6), 2))


@pytest.mark.parametrize("after_s", np.linspace(0.02, 0.4, 4))
def test_an_interrupt_at_any_moment_ends_the_threads(after_s, tmp_path):
    """None waits for a lock that the interrupted thread took with it."""

    def work():
        signal.signal(signal.SIGINT, signal.default_int_handler)
        (tmp_path / "begun").touch()
        try:
            for _ in parallel_map(half, (x % 10 for x in range(10**7)), threads=2):
                pass
        except KeyboardInterrupt:
            os._exit(3)

    process = start_fork(tmp_path, tmp_path / "said", work)
    while not (tmp_path / "begun").exists():
        time.sleep(0.005)
    time.sleep(after_s)
    assert process.pid is not None
    os.kill(process.pid, signal.SIGINT)
    process.join(30)
    code = process.exitcode
    process.kill()
    assert code == 3


@pytest.mark.parametrize("where", [0, True, 1.5, "", "dask://", "grid", "ray"])
def test_odd_engines(where):
    with pytest.raises(InputError, match="must be a number of processes"):
        check_engine(where)
    with pytest.raises(InputError, match="do not see"):
        check_engine(2, "memory://town")


def test_engines_that_are_not_there(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("dlkf.base.parallel.PATIENCE_S", 0.5)
    with pytest.raises(InputError, match="no scheduler answers"):
        list(parallel_map(half, [1], "dask://127.0.0.1:9"))


@pytest.mark.commands
def test_a_dask_worker_is_killed_in_the_middle(alone, cluster, where, tmp_path):
    """What the lost worker had is done again by the other: the bytes of every file are those of one process."""
    done = []
    settings = recipe(parallel=where)
    work = threading.Thread(target=lambda: done.append(drives_in(settings, tmp_path / "many")))
    before = {worker.pid for worker in cluster.workers.values()}
    work.start()
    end = time.monotonic() + 120
    while len(list(tmp_path.glob(".many.partial*/reference/*/*.parquet"))) < 3 and time.monotonic() < end:
        time.sleep(0.005)
    victim = min(before)
    os.kill(victim, signal.SIGKILL)
    assert len(list(tmp_path.glob(".many.partial*/reference/*/*.parquet"))) < DRIVES, "it was done already"
    work.join(120)
    assert not work.is_alive() and len(done) == 1
    assert [row.name for row in read_drives(done[0])] == [row.name for row in read_drives(alone)]
    assert dataset_digest(done[0]) == dataset_digest(alone)
    files = [sorted(p.relative_to(f).as_posix() for p in f.rglob("*")) for f in (done[0], alone)]
    assert files[0] == files[1]  # nor is anything left that the killed one had begun


def solutions(folder: Path) -> dict[str, np.ndarray]:
    found = {p.parent.name: pd.read_parquet(p, partitioning=None) for p in sorted(folder.glob("*/solution.parquet"))}
    return {name: table.select_dtypes("number").to_numpy(float) for name, table in found.items()}


@pytest.mark.commands
def test_navigated_by_workers(alone, where, call, tmp_path):
    """Each drive by itself, so to the bit; the dataset by a path that the workers, who stand elsewhere, lack."""
    Path("many").symlink_to(alone)
    named = ",".join(row.name for row in read_drives(alone)[:3])
    given = ("dataset=many", "model=mbkf15", "streaming=true", f"drives=[{named}]")
    for k, parallel in enumerate(("null", where)):
        done = call("navigate", *given, f"parallel={parallel}", f"out=out-{k}")
        assert done.code == 0, done.err
    one, other = (solutions(tmp_path / f"out-{k}") for k in range(2))
    assert len(one) == 3 and one.keys() == other.keys()
    assert all(np.array_equal(one[name], other[name], equal_nan=True) for name in one)


@pytest.mark.commands
def test_evaluated_by_workers_of_which_one_is_killed(alone, cluster, where, call, tmp_path, monkeypatch):
    """Every drive a share of its own; segments run alone, so the numbers are those of one process to rounding."""
    monkeypatch.setattr(importlib.import_module("dlkf.evaluate"), "SAMPLES_AT_ONCE", 4)
    given = ("model=mbkf15", f"dataset={alone}", "mode=segments", "length_s=12", "stride_s=12", "outage.first_s=4")
    given += ("outage.duration_s=5", "settle_s=2", "tracking.log=false")
    results = []
    for k, parallel in enumerate(("null", where)):
        if k:
            victim = min(worker.pid for worker in cluster.workers.values())
            threading.Timer(0.5, os.kill, (victim, signal.SIGKILL)).start()
        done = call("evaluate", *given, f"parallel={parallel}", f"out=out-{k}")
        assert done.code == 0, done.err
        results.append(json.loads((tmp_path / f"out-{k}" / "metrics.json").read_text())["results"])
    assert numbers_in(results[0]) == pytest.approx(numbers_in(results[1]), rel=1e-9, abs=1e-12)
    assert len(numbers_in(results[0])) > 20


@pytest.mark.commands
def test_ingested_by_workers(alone, where, call, tmp_path):
    for row in read_drives(alone)[:4]:
        for kind in ("imu", "gnss"):
            table = pd.read_parquet(alone / kind / f"drive={row.name}" / "part-0.parquet", partitioning=None)
            (tmp_path / "logs" / row.name).mkdir(parents=True, exist_ok=True)
            table.to_csv(tmp_path / "logs" / row.name / f"{kind}.csv", index=False)
    said = []
    for k, parallel in enumerate(("null", where)):
        done = call("ingest", "reader=csv", "source=logs", f"out=made/{k}", f"parallel={parallel}")
        assert done.code == 0, done.err
        said.append(done.out.replace(f"made/{k}", "made"))
    assert said[0] == said[1] and said[0].count(" GNSS 1 Hz, ") == 4
    assert said[0].count("columns of gnss.csv that are not used: std_pos_n, ") == 4
    assert len({dataset_digest(tmp_path / "made" / str(k)) for k in range(2)}) == 1
    (tmp_path / "logs" / row.name / "imu.csv").write_text("")
    done = call("ingest", "reader=csv", "source=logs", "out=made/bad", f"parallel={where}")
    assert done.code == 2 and "is empty" in done.err and not (tmp_path / "made" / "bad").exists()
