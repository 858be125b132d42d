"""End of runs in MLflow: normal, by a signal, or by a kill, which the next run on the same machine records."""

from __future__ import annotations

import gc
import logging
import os
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import TYPE_CHECKING

from dlkf.base.processes import MACHINE, is_gone
from dlkf.base.signals import delay_signals

if TYPE_CHECKING:
    from mlflow import MlflowClient

PROCESS_TAG = "dlkf.process"  # the one that writes a run
TRACKING_URI = "MLFLOW_TRACKING_URI"


def mlflow_module() -> ModuleType:
    """MLflow with little output, without usage reports, unable to load a pickle. Imported on use: it takes seconds."""
    os.environ["MLFLOW_ALLOW_PICKLE_DESERIALIZATION"] = "false"
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    os.environ.setdefault("MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR", "false")
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "3")
    import mlflow

    for name in ("mlflow", "alembic"):
        logging.getLogger(name).setLevel(logging.WARNING)
    logging.getLogger("mlflow.store.db.utils").setLevel(logging.CRITICAL)  # it prints what it then raises
    return mlflow


def end_run(status: str, error: BaseException | None = None) -> None:
    """Close the active run, if there is one, with a second try.

    A signal that came while MLflow wrote or read leaves SQLite's cursor, and with it a lock of the store, alive in what
    the exception's traceback holds; the lock would outlast MLflow's patience. So that is let go first.
    """
    mlflow = mlflow_module()
    if error is not None:
        _release_frames(error)
    with delay_signals():
        run = mlflow.active_run()
        try:
            mlflow.end_run(status)
        except Exception:
            if run is None:
                raise
            mlflow.MlflowClient().set_terminated(run.info.run_id, status)


def _release_frames(error: BaseException) -> None:
    """Variables of the frames that an exception and its causes hold; of an interrupt the frames too, whose functions
    keep what they closed over (a list comprehension over the rows of a cursor)."""
    links: list[BaseException | None] = [error]
    seen: set[int] = set()
    while links:
        if (link := links.pop()) is not None and id(link) not in seen:
            seen.add(id(link))
            links += [link.__cause__, link.__context__]
            entry = link.__traceback__
            traceback.clear_frames(entry)
            while entry is not None and isinstance(error, KeyboardInterrupt):
                following, entry.tb_next = entry.tb_next, None
                entry = following
    gc.collect()


@contextmanager
def use_store(uri: str) -> Iterator[None]:
    """MLflow's own functions write to this store inside the block, and so do the processes started there.

    ``mlflow.set_tracking_uri`` alone also leaves ``MLFLOW_TRACKING_URI`` in the environment for good: whatever this
    process starts later would write to a store that it was never given.
    """
    mlflow = mlflow_module()
    before = os.environ.get(TRACKING_URI)
    mlflow.set_tracking_uri(uri)
    try:
        yield
    finally:
        mlflow.set_tracking_uri(before)


def close_killed_runs(client: MlflowClient, experiment: str) -> None:
    """Set runs with the status RUNNING to KILLED where their process, of this machine, is gone."""
    running = f"attributes.status = 'RUNNING' and tags.`{PROCESS_TAG}` LIKE '{MACHINE}-%'"
    for run in client.search_runs([experiment], running, max_results=1000):
        if is_gone(run.data.tags[PROCESS_TAG]):
            client.set_terminated(run.info.run_id, "KILLED")
