"""What the jobs of a sweep share across processes: what is swept, and which of them failed."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

SWEPT = "DLKF_SWEPT_KEYS"  # the keys that a sweep goes over, as JSON
FAILED = "DLKF_FAILED_POINTS"  # the folder in which jobs record that they failed


@dataclass(frozen=True)
class Failure:
    """A point that failed: what it changes, why, and whether that was a mistake of the user."""

    point: str
    why: str
    mistake: bool


def select_swept_overrides(overrides: Sequence[str]) -> str:
    """Of a point's overrides those that are swept: ``imu=consumer,seed=1``."""
    swept = json.loads(os.environ.get(SWEPT, "[]"))
    return ",".join(o for o in overrides if not swept or o.partition("=")[0] in swept)


def report_failure(failure: Failure, number: int) -> bool:
    """Set a failure down; False where nobody would read it (a machine that does not share the folder)."""
    place = os.environ.get(FAILED)
    if not place or not Path(place).is_dir():
        return False
    (Path(place) / f"{number:05d}").write_text(json.dumps(asdict(failure)))
    return True


def failures() -> list[Failure]:
    """The points of this sweep that failed so far."""
    place = os.environ.get(FAILED)
    return [Failure(**json.loads(file.read_text())) for file in sorted(Path(place).iterdir())] if place else []


@contextmanager
def collect_failures() -> Iterator[None]:
    """Jobs that run inside have a place to record failures."""
    with tempfile.TemporaryDirectory(prefix="dlkf-") as place:
        os.environ[FAILED] = place
        try:
            yield
        finally:
            os.environ.pop(FAILED, None)
