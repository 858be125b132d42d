"""Compiled libraries in the user's cache (``$XDG_CACHE_HOME/dlkf``), of which only whole ones are loaded."""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

from dlkf.base.errors import InputError
from dlkf.base.files import PARTIAL, clear_dead, sync_file
from dlkf.base.processes import process_label
from dlkf.onboard.library import LIBRARY

CHECKSUM = f"{LIBRARY}.sha256"
Loaded = TypeVar("Loaded")


def find_cache() -> Path:
    """Where the libraries are."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "dlkf" / "compiled"


def load_cached(folder: Path, make: Callable[[Path], None], load: Callable[[Path], Loaded]) -> Loaded:
    """``load`` the library in a folder of the cache, after ``make`` of it into an empty one unless it is there whole.

    InputError where the cache cannot be written, or nothing loaded from it.
    """
    try:
        if is_whole(folder):
            with suppress(OSError):  # such as one that needs another libc
                return load(folder / LIBRARY)
            shutil.rmtree(folder)
        _put(folder, make)
        return load(folder / LIBRARY)
    except OSError as error:
        said = f"cannot keep compiled filters there ({error.strerror or error})"
        raise InputError(f"{folder.parent}: {said}; name another folder by XDG_CACHE_HOME=<folder>") from None


def is_whole(folder: Path) -> bool:
    """Whether a library is there as it was made: what is shorter would end the process that calls it."""
    library, checksum = folder / LIBRARY, folder / CHECKSUM
    return library.is_file() and checksum.is_file() and checksum.read_bytes() == _digest(library)


def seal(folder: Path) -> None:
    """Bring a library to the disk, and after it its checksum."""
    sync_file(folder / LIBRARY)
    (folder / CHECKSUM).write_bytes(_digest(folder / LIBRARY))
    sync_file(folder / CHECKSUM)


def _put(folder: Path, make: Callable[[Path], None]) -> None:
    """Made beside the folder and moved there; what killed processes had begun in the cache is removed."""
    cache = folder.parent
    clear_dead(cache, PARTIAL)
    ours = cache / f"{PARTIAL}{process_label()}"  # of all threads
    ours.mkdir(parents=True, exist_ok=True)
    beside = Path(tempfile.mkdtemp(dir=ours))
    try:
        make(beside)
        seal(beside)
        if not is_whole(folder):
            shutil.rmtree(folder, ignore_errors=True)
            try:
                os.replace(beside, folder)
            except OSError:
                if not is_whole(folder):  # else another process was faster
                    raise
    finally:
        shutil.rmtree(beside, ignore_errors=True)
        with suppress(OSError):
            ours.rmdir()


def _digest(file: Path) -> bytes:
    return hashlib.sha256(file.read_bytes()).hexdigest().encode()
