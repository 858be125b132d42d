"""Small functions as C, compiled into one library and called on tensors."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor, nn

from dlkf.onboard.c_source import translate_function, write_preamble
from dlkf.onboard.library import build
from dlkf.onboard.recording import export_mode
from tests.onboard.conftest import QUICK

HEADER = "#include <stdint.h>\n"


class Translated:
    """A module with an ``example()``, and what C makes of it."""

    def __init__(self, module: nn.Module, code: str, work: int, call: Callable) -> None:
        self.module, self.code, self._work, self._call = module, code, work, call

    def __call__(self, *args: Tensor) -> Tensor:
        """By C, as one row of numbers."""
        got, room = torch.empty_like(self.wanted(*args)), torch.empty(self._work)
        self._call(*(ctypes.c_void_p(x.data_ptr()) for x in (*(x.contiguous() for x in args), got, room)))
        return got

    def wanted(self, *args: Tensor) -> Tensor:
        """By torch."""
        with torch.no_grad():
            return self.module(*args).reshape(-1)


def translate(folder: Path, *modules: nn.Module) -> list[Translated]:
    """Each module as a function of one library in a folder."""
    with export_mode():
        written = [translate_function(f"tested{k}", module.eval()) for k, module in enumerate(modules)]
    (folder / "step.h").write_text(HEADER)
    (folder / "step.c").write_text(write_preamble() + "".join(w.code for w in written))
    (folder / "weights.c").write_text(HEADER + "".join(w.weights for w in written))
    library = ctypes.CDLL(str(build(folder, flags=QUICK)))
    return [
        Translated(module, w.code, w.work, getattr(library, f"tested{k}"))
        for k, (module, w) in enumerate(zip(modules, written, strict=True))
    ]


def lines_within(code: str, begin: str) -> Sequence[str]:
    """Lines that stand in the braces of lines that begin with some words, those lines among them."""
    found, depth = [], 0
    for line in code.splitlines():
        if depth or line.strip().startswith(begin):
            found.append(line)
            depth += line.count("{") - line.count("}")
    return found
