"""What a command's process does beside its work: how it keeps memory, and how it ends."""

from __future__ import annotations

import atexit
import io
import os
import sys
import threading

TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3  # of glibc's mallopt
KEPT_BYTES = 1 << 28
NEEDS_TEARDOWN = ("mlflow", "multiprocessing.pool", "loky", "joblib", "distributed")  # with stores or workers to close


def end_at_once() -> None:
    """End this process with status 0 after what was registered for its end, without taking apart what is loaded: of
    torch and numba alone that takes a quarter of a second.

    Returns, so that the interpreter ends as usual, where a thread or a loaded library may have something to finish,
    where somebody traces the process, and where its output cannot be written.
    """
    traced = sys.gettrace() or sys.getprofile() or sys.flags.interactive
    if traced or threading.active_count() > 1 or any(name in sys.modules for name in NEEDS_TEARDOWN):
        return
    try:
        sys.stdout.flush()
        sys.stderr.flush()
    except (OSError, ValueError):
        return
    atexit._run_exitfuncs()
    os._exit(0)


def print_any_letter() -> None:
    """What the encoding of the output lacks, as σ in Latin-1, is printed as a question mark."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def keep_freed_memory() -> None:
    """Arrays that were freed are used again instead of given back, which spares the kernel to clear them each time;
    glibc alone knows how."""
    if "CS_GNU_LIBC_VERSION" not in getattr(os, "confstr_names", {}):
        return
    import ctypes  # not for the help

    mallopt = ctypes.CDLL(None).mallopt
    for parameter in (MMAP_THRESHOLD, TRIM_THRESHOLD):
        mallopt(parameter, KEPT_BYTES)
