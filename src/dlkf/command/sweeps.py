"""A point of a sweep has a folder of its own, and one that fails does not take the others with it."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager

from hydra.conf import HydraConf

from dlkf.command.faults import fault
from dlkf.points import Failure, changed, failures, listened, tell

MISTAKES, FAULTS = 2, 1  # exit codes: all failed by mistakes of the user, some by faults of ours


def folder(hydra_config: HydraConf) -> str:
    """Folder of a point: its number and what it changes, as ``0-imu=consumer``."""
    return f"{hydra_config.job.num}-{changed(hydra_config.overrides.task)}".replace("/", "-")[:100]


def set_down(error: Exception, hydra_config: HydraConf) -> None:
    """Say that a point failed and let the sweep go on; raises the error where nobody would hear of it."""
    said = fault(error)
    point = changed(hydra_config.overrides.task)
    failure = Failure(point, said or f"{type(error).__name__}: {error}", mistake=said is not None)
    if not tell(failure, hydra_config.job.num):
        raise error
    if said is None:
        traceback.print_exception(error)
    print(f"dlkf: error: {point}: {failure.why}", file=sys.stderr, flush=True)


@contextmanager
def heard() -> Iterator[None]:
    """Round a command that may be a sweep: a last line names the points that failed, the exit code says so."""
    with listened():
        yield
        failed = failures()
    if failed:
        named = "; ".join(one.point for one in failed)
        print(f"dlkf: error: {len(failed)} of the points failed: {named}", file=sys.stderr)
        sys.exit(MISTAKES if all(one.mistake for one in failed) else FAULTS)
