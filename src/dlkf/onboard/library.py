"""The C of a filter as a library of this machine, called from Python."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import sysconfig
from pathlib import Path

import torch
from torch import Tensor

from dlkf.errors import InputError
from dlkf.onboard.functions import ROW, TOLD

# NaN and infinity keep their meaning, sums may be taken in another order
FLAGS = ("-O3", "-march=native", "-fno-math-errno", "-fno-trapping-math", "-fno-signed-zeros", "-fassociative-math")
LIBRARY = "step.so"


def compiler() -> str | None:
    """The C compiler of this machine: ``$CC``, else cc, gcc or clang; None where there is none."""
    given = os.environ.get("CC", "").split()[:1]
    return next((found for name in (*given, "cc", "gcc", "clang") if (found := shutil.which(name))), None)


def build(folder: Path, into: Path | None = None) -> Path:
    """Compile ``step.c`` in a folder. Raises InputError where there is no compiler, or it fails."""
    cc = compiler()
    if cc is None:
        raise InputError("no C compiler found (cc, gcc, clang, or $CC); install one, such as apt-get install gcc")
    library = (into or folder).resolve() / LIBRARY
    made = subprocess.run(
        [cc, *FLAGS, "-fPIC", "-shared", "step.c", "-o", library, "-lm"], cwd=folder, capture_output=True, text=True
    )
    if made.returncode:
        said = (made.stderr.strip() or f"it ended with {made.returncode}").splitlines()[0]
        raise InputError(f"{cc} cannot compile {folder / 'step.c'}: {said}")
    return library


class Library:
    """``step.h`` on float64 tensors without gaps; calls let other threads run."""

    def __init__(self, path: Path, memory: int) -> None:
        self._library, self.memory = ctypes.CDLL(str(path.resolve())), memory
        self._told = sum(TOLD.values())

    def turn(self, memory: Tensor, imu: Tensor, fix: Tensor) -> tuple[Tensor, Tensor]:
        """One epoch of one drive: memory after it (1, K), what it told (1, T)."""
        after, told = torch.empty_like(memory), memory.new_empty(1, self._told)
        self._library.dlkf_turn(*map(_pointer, (memory, imu, fix, after, told)))
        return after, told

    def run(self, memory: Tensor, imu: Tensor, fixes: Tensor) -> tuple[Tensor, Tensor]:
        """Epochs (T, M, 6) with fixes (T, 19) of one drive from a memory (1, K): memory at the end, told (T, …)."""
        after, told = memory.clone(), memory.new_empty(len(imu), self._told)
        epochs = ctypes.c_int64(len(imu))
        self._library.dlkf_run(epochs, *map(_pointer, (after, imu, fixes, told)))
        return after, told

    def step(self, memory: Tensor, imu: Tensor, fix: Tensor) -> tuple[Tensor, Tensor]:
        """One epoch with a fix as a receiver gives it: memory after it and the row of the solution."""
        after, row = torch.empty_like(memory), memory.new_empty(1, len(ROW))
        self._library.dlkf_step(*map(_pointer, (memory, imu, fix, after, row)))
        return after, row

    def begin(self, imu: Tensor, fixes: Tensor, lever_arm_b: Tensor) -> tuple[Tensor, bool]:
        """A memory from a few epochs, and whether it may be used."""
        memory, ready = imu.new_empty(1, self.memory), imu.new_empty(1)
        self._library.dlkf_begin(*map(_pointer, (imu, fixes, lever_arm_b, memory, ready)))
        return memory, bool(ready)


def _pointer(x: Tensor) -> ctypes.c_void_p:
    return ctypes.c_void_p(x.data_ptr())


def machine() -> str:
    """What a library was made for."""
    return sysconfig.get_platform()
