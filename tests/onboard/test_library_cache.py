"""The cache of compiled filters: damage heals, what a kill leaves is cleared, another processor has its own."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

from dlkf.base.errors import InputError
from dlkf.onboard import library
from dlkf.onboard.library import LIBRARY, describe_machine
from dlkf.onboard.library_cache import CHECKSUM, find_cache, load_cached


@pytest.fixture
def cache(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return find_cache()


def make(folder: Path) -> None:
    (folder / LIBRARY).write_bytes(b"whole")


def refuse(folder: Path) -> None:
    pytest.fail("made again")


@pytest.mark.parametrize("name", [LIBRARY, CHECKSUM])
@pytest.mark.parametrize("left", [None, b"", b"who", b"wh\xffle"])
def test_what_is_damaged_is_made_again(name, left, cache):
    """It is not loaded: calls into a shorter file would end the process."""
    folder = cache / "0123"
    assert load_cached(folder, make, Path.read_bytes) == b"whole"
    assert load_cached(folder, refuse, Path.read_bytes) == b"whole"
    (folder / name).unlink() if left is None else (folder / name).write_bytes(left)
    assert load_cached(folder, make, Path.read_bytes) == b"whole"
    assert load_cached(folder, refuse, Path.read_bytes) == b"whole"
    assert [p.name for p in cache.iterdir()] == ["0123"]


def test_what_cannot_be_loaded_is_made_again_once(cache):
    """As after an update of the system's libraries."""
    folder, tries = cache / "0123", []
    load_cached(folder, make, Path.read_bytes)

    def load(path: Path) -> bytes:
        tries.append(path)
        raise OSError(f"{path}: version GLIBC_2.99 not found")

    with pytest.raises(InputError, match=r"GLIBC_2\.99 not found\); name another folder by XDG_CACHE_HOME"):
        load_cached(folder, make, load)
    assert len(tries) == 2


def test_a_cache_that_cannot_be_written_to_is_named(cache):
    cache.parent.write_text("a file where a folder should be")
    with pytest.raises(InputError, match=rf"^{cache}: cannot keep compiled filters there .*XDG_CACHE_HOME=<folder>$"):
        load_cached(cache / "0123", make, Path.read_bytes)


def test_what_a_killed_compilation_left_is_cleared(cache):
    """By the next one, of whatever filter; one that goes on is left alone."""
    program = f"""
import os, signal
from pathlib import Path
from dlkf.onboard.library_cache import load_cached
load_cached(Path({str(cache)!r}) / "0123", lambda folder: os.kill(os.getpid(), signal.SIGKILL), Path.read_bytes)
"""
    assert subprocess.run([sys.executable, "-c", program]).returncode == -signal.SIGKILL
    assert [p.name[:9] for p in cache.iterdir()] == [".partial-"]

    def make_both(folder: Path) -> None:
        load_cached(cache / "4567", make, Path.read_bytes)
        make(folder)

    load_cached(cache / "89ab", make_both, Path.read_bytes)
    assert sorted(os.listdir(cache)) == ["4567", "89ab"]


def test_a_processor_with_other_instructions_has_its_own_library(tmp_path, monkeypatch):
    """The code is made for this one alone (-march=native)."""
    described = set()
    for number, text in enumerate(
        ("flags\t: fma avx2\ncpu MHz\t: 1\n", "flags\t: fma\n", "flags\t: fma avx2\ncpu MHz\t: 2\n")
    ):
        (tmp_path / str(number)).write_text(text)
        monkeypatch.setattr(library, "CPUINFO", tmp_path / str(number))
        describe_machine.cache_clear()
        described.add(describe_machine())
    monkeypatch.setattr(library, "CPUINFO", tmp_path / "none")
    describe_machine.cache_clear()
    assert describe_machine().startswith(sysconfig.get_platform()) and len(described) == 2
    describe_machine.cache_clear()
