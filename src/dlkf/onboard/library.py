"""The C of a filter as a library of this machine, called from Python."""

from __future__ import annotations

import ctypes
import os
import platform
import shutil
import subprocess
import sysconfig
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import torch
from torch import Tensor

from dlkf.base.errors import InputError
from dlkf.onboard.functions import OUTPUTS

# NaN and infinity keep their meaning; of the filter, not of the core round it. Not -fassociative-math: with it gcc 12
# makes a sum over k of a product that skips zeros, and a filter that was right without it ends in NaN
# nor gcc's partial redundancy elimination, which keeps loops over exp and log from being vectorised
FLAGS = (
    "-O3", "-march=native", "-fno-math-errno", "-fno-trapping-math", "-fno-signed-zeros", "-fno-tree-pre", "-fno-gcse",
    "-ffp-contract=fast",
)  # fmt: skip
CORE_FLAGS = ("-O2",)
FILTER = ("step.c", "weights.c", "heading.c")
CORE = ("dlkf.c", "samples.c", "spikes.c", "align.c", "search.c", "aids.c", "limits.c")
LIBRARY = "step.so"
CPUINFO = Path("/proc/cpuinfo")
OF_PROCESSOR = ("model name", "flags", "CPU implementer", "CPU part", "Features", "isa")  # lines of it


def find_compiler() -> str | None:
    """The C compiler of this machine: ``$CC``, else cc, gcc or clang; None where there is none."""
    given = os.environ.get("CC", "").split()[:1]
    return next((found for name in (*given, "cc", "gcc", "clang") if (found := shutil.which(name))), None)


def require_compiler() -> str:
    """:func:`find_compiler`. InputError where there is none."""
    if (cc := find_compiler()) is None:
        raise InputError("no C compiler found (cc, gcc, clang, or $CC); install one, such as apt-get install gcc")
    return cc


def build(folder: Path, into: Path | None = None, flags: Sequence[str] | None = None) -> Path:
    """Compile what was exported to a folder, the filter with ``flags``; default: :data:`FLAGS`.

    Raises InputError where there is no compiler, or it fails.
    """
    cc = require_compiler()
    into = (into or folder).resolve()
    objects = []
    for names, own in ((FILTER, FLAGS if flags is None else flags), (CORE, CORE_FLAGS)):
        for name in names:
            if (folder / name).is_file():
                objects.append(into / f"{name}.o")
                _run([cc, "-std=c99", *own, "-fPIC", "-c", name, "-o", objects[-1]], folder, name)
    _run([cc, "-shared", *objects, "-o", into / LIBRARY, "-lm"], folder, LIBRARY)
    for path in objects:
        path.unlink()
    return into / LIBRARY


def _run(command: list, folder: Path, name: str) -> None:
    made = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    if made.returncode:
        said = (made.stderr.strip() or f"it ended with {made.returncode}").splitlines()[0]
        raise InputError(f"{command[0]} cannot compile {folder / name}: {said}")


class Library:
    """``step.h`` on float64 tensors without gaps; calls let other threads run."""

    def __init__(self, path: Path, memory: int, outputs: int = sum(OUTPUTS.values())) -> None:
        self.path = path.resolve()
        self._library, self.memory = ctypes.CDLL(str(self.path)), memory
        self._outputs = outputs
        self._work = ctypes.c_int64.in_dll(self._library, "dlkf_work_numbers").value

    def turn(self, memory: Tensor, imu: Tensor, fix: Tensor) -> tuple[Tensor, Tensor]:
        """One epoch of one drive: memory after it (1, K), what it outputs (1, T)."""
        after, outputs = torch.empty_like(memory), memory.new_empty(1, self._outputs)
        work = memory.new_empty(self._work)
        self._library.dlkf_turn(*map(_pointer, (memory, imu, fix, after, outputs, work)))
        return after, outputs

    def run(self, memory: Tensor, imu: Tensor, fixes: Tensor) -> tuple[Tensor, Tensor]:
        """Epochs (T, M, 6) with fixes (T, …) of one drive from a memory (1, K): memory at the end, outputs (T, …)."""
        after, outputs = memory.clone(), memory.new_empty(len(imu), self._outputs)
        other, work = torch.empty_like(memory), memory.new_empty(self._work)
        epochs = ctypes.c_int64(len(imu))
        self._library.dlkf_run(epochs, *map(_pointer, (after, imu, fixes, outputs, other, work)))
        return after, outputs


def _pointer(x: Tensor) -> ctypes.c_void_p:
    return ctypes.c_void_p(x.data_ptr())


@cache
def describe_machine() -> str:
    """What a library was made for: system, and by ``-march=native`` the processor with its instructions."""
    try:
        lines = CPUINFO.read_text(errors="replace").splitlines()
    except OSError:
        return f"{sysconfig.get_platform()} {platform.processor()}"
    return "\n".join([sysconfig.get_platform(), *sorted({line for line in lines if line.startswith(OF_PROCESSOR)})])
