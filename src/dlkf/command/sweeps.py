"""Points of a sweep: a folder for each; a failed point does not stop the others."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager

from hydra.conf import HydraConf

from dlkf.base.points import SWEPT, Failure, collect_failures, failures, report_failure, select_swept_overrides
from dlkf.command.faults import describe_fault

MISTAKES, FAULTS = 2, 1  # exit codes: all failed by mistakes of the user, some by faults of ours


def job_folder(hydra_config: HydraConf) -> str:
    """Folder of a point: its number and what it changes, as ``0-imu=consumer``; ``0`` where nothing is swept."""
    if os.environ.get(SWEPT) == "[]":
        return str(hydra_config.job.num)
    return f"{hydra_config.job.num}-{select_swept_overrides(hydra_config.overrides.task)}".replace("/", "-")[:100]


def record_failure(error: Exception, hydra_config: HydraConf) -> None:
    """Record that a job failed and continue the sweep; raises the error where no sweep collects it."""
    said = describe_fault(error)
    point = select_swept_overrides(hydra_config.overrides.task)
    failure = Failure(point, said or f"{type(error).__name__}: {error}", mistake=said is not None)
    if not report_failure(failure, hydra_config.job.num):
        raise error
    if said is None:
        traceback.print_exception(error)
    print(f"dlkf: error: {point}: {failure.why}", file=sys.stderr, flush=True)


@contextmanager
def collect_job_failures() -> Iterator[None]:
    """Round a command that may be a sweep: a last line names the points that failed, the exit code is then not 0."""
    with collect_failures():
        yield
        failed = failures()
    if failed:
        named = "; ".join(one.point for one in failed)
        print(f"dlkf: error: {len(failed)} of the points failed: {named}", file=sys.stderr)
        sys.exit(MISTAKES if all(one.mistake for one in failed) else FAULTS)
