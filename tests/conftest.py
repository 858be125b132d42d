"""Which tests are ``whole``, in what order they run, and where their fixtures are: :mod:`tests.worlds`.

Tests that need a compiler, MLflow, a training or a process of their own are marked ``whole``, by hand or because they
ask for a fixture that does: ``make check`` leaves them out.
"""

from __future__ import annotations

import gc
import os
from pathlib import Path

import pytest

pytest.register_assert_rewrite("tests.worlds")
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # else each of the processes that tests start compiles all it imports

FIRST_CASE = pytest.StashKey[bool]()
LONG_ROOMS = ("training", "tuning", "tracking", "pipelines", "onboard", "docs")  # begin first, so that none ends last

WHOLE_FIXTURES = {"uri", "exported", "site", "trained", "cluster", "alone", "server"}
WHOLE_ROOMS = {"onboard", "pipelines"}
WHOLE_FILES = {  # that take five seconds and more
    "test_aid_logs.py", "test_aid_stream.py", "test_bank.py", "test_chassis.py", "test_configuration.py",
    "test_consistency.py", "test_datamodule.py", "test_faulty_data.py", "test_foreign_tables.py", "test_formats.py",
    "test_noise_fit.py", "test_receiver.py", "test_recorders.py", "test_recovery.py", "test_refusals.py",
    "test_silent_cars.py", "test_stationarity.py", "test_stores.py", "test_streaming.py", "test_tuning.py",
    "test_wheel_faults.py", "test_wrong_words.py",
}  # fmt: skip


def pytest_configure(config: pytest.Config) -> None:
    """A process that only hands tests to others needs no fixtures, and not torch, which takes seconds to load."""
    if getattr(config.option, "dist", "no") == "no" or config.option.collectonly:
        config.pluginmanager.import_plugin("tests.worlds")


def room(item: pytest.Item) -> str:
    """The folder, or file, below tests/ that a test is in."""
    return item.path.relative_to(Path(__file__).parent).parts[0]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """What needs a compiler, MLflow, a server or a training by its fixtures or its room is ``whole``; rooms of long
    tests come first."""
    seen: set[tuple[Path, str]] = set()
    for item in items:
        long = room(item) in WHOLE_ROOMS or item.path.name in WHOLE_FILES
        if long or WHOLE_FIXTURES.intersection(getattr(item, "fixturenames", ())):
            item.add_marker(pytest.mark.whole)
        test = item.path, getattr(item, "originalname", item.name)
        item.stash[FIRST_CASE] = test not in seen
        seen.add(test)
    rank = {name: k for k, name in enumerate(LONG_ROOMS)}
    items.sort(key=lambda item: rank.get(room(item), len(rank)))


def pytest_collection_finish() -> None:
    """What the imports of all tests have made stays; the garbage collector need not look at it again and again, nor
    after every 700 objects: recording a filter makes millions."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(100_000, 20, 50)
