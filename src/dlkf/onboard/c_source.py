"""A filter as C: the functions of :mod:`dlkf.onboard.functions` in one file, its header, and what made them."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dlkf.errors import InputError
from dlkf.filters.integration import Estimator
from dlkf.navigation import compiled
from dlkf.onboard.c_code import KEPT, Translation
from dlkf.onboard.c_memory import C_TYPES, Block
from dlkf.onboard.carried import Layout
from dlkf.onboard.functions import FIX, ROW, TOLD, Anchor, Begin, Function, Grid, Read, Row, Turn, carried_by
from dlkf.onboard.meanings import of_column
from dlkf.running.reanchoring import can_reanchor
from dlkf.running.streaming import ANCHOR_M

CPP = Path(__file__).parent / "cpp"
IN_A_FILE = 4096  # constants of more numbers than that lie beside the source


def write_source(
    folder: Path, estimator: Estimator, grid: Grid, name: str, made: dict[str, Any], *, loop_alone: bool = False
) -> Layout:
    """``step.c``, ``step.h``, the large constants, and ``step.json``, which describes them.

    ``loop_alone`` leaves out what turns fixes and solutions into those of a vehicle, which takes most of the time.
    Raises InputError for a filter that cannot be exported.
    """
    with exporting():
        layout = carried_by(estimator, grid)
        functions: dict[str, type[Function]] = {"turn": Turn}
        if not loop_alone:
            functions |= {"begin": Begin, "read": Read, "row": Row}
            if can_reanchor(layout.like.memory):
                functions["anchor"] = Anchor
        parts = [(CPP / "algebra.h").read_text()]
        for function, kind in functions.items():
            parts.append(function_in_c(f"dlkf_{function}", kind(estimator, grid, layout).eval(), folder))
    parts.append((CPP / "run.c.in").read_text())
    if not loop_alone:
        parts.append((CPP / "step.c.in").read_text())
    header = (CPP / "step.h.in").read_text()
    values = {
        "NAME": name, "MEMORY": layout.size, "SAMPLES": grid.samples, "RATE_HZ": repr(1 / grid.dt),
        "EPOCHS": Begin(estimator, grid, layout).epochs, "FIX": len(FIX), "ROW": len(ROW), "TOLD": sum(TOLD.values()),
        "ANCHOR_M": f"{ANCHOR_M if 'anchor' in functions else 1e12:g}",
        "FIX_COLUMNS": ", ".join(f"DLKF_FIX_{c.upper()}" for c in FIX),
        "ROW_COLUMNS": ", ".join(f"DLKF_{c.upper()}" for c in ROW),
        "ANCHOR": "void dlkf_anchor(const double *memory, double *memory_out);" if "anchor" in functions else
        "static inline void dlkf_anchor(const double *memory, double *memory_out) { (void)memory; (void)memory_out; }",
    }  # fmt: skip
    for key, value in values.items():
        header = header.replace(f"@{key}@", str(value))
    (folder / "step.c").write_text("\n".join(parts))
    (folder / "step.h").write_text(header)
    fix, row = ([{"name": c, "place": k, "meaning": of_column(c)} for k, c in enumerate(cs)] for cs in (FIX, ROW))
    described = {
        "model": name, "rate_hz": 1 / grid.dt, "epoch_s": grid.epoch_s, "fix": fix, "row": row,
        "memory": {"numbers": layout.size, "type": "float64", "fields": [f.plain() for f in layout.fields]}, **made,
    }  # fmt: skip
    (folder / "step.json").write_text(json.dumps(described, indent=1, ensure_ascii=False) + "\n")
    return layout


def function_in_c(name: str, function: Function, folder: Path) -> str:
    """C of a function; its large constants become files in ``folder``."""
    try:
        program = torch.export.export(function, function.example(), strict=False)
    except Exception as error:
        raise InputError(f"this filter cannot be exported: {str(error).splitlines()[0]}") from error
    table: dict[Any, Any] = dict(torch.export.default_decompositions())
    done = Translation(program.run_decompositions({o: f for o, f in table.items() if o._schema.name not in KEPT}))
    block, inputs = done.block, done.inputs
    arguments = [f"const {C_TYPES[b.dtype]} *restrict {b.name}" for b in inputs]
    for k, view in enumerate(done.outputs):
        dense = done.dense(view)
        arguments.append(f"{C_TYPES[view.meta.dtype]} *restrict out{k}")
        start = dense.meta.storage_offset()
        block.write(
            f"for (int i = 0; i < {dense.meta.numel()}; i++) out{k}[i] = {dense.buffer.name}[{start}+i];", dense
        )
    size = block.laid_out()
    places = [
        f"{C_TYPES[b.dtype]} *{b.name} = ({C_TYPES[b.dtype]} *)(block + {block.places[b.name]});" for b in block.buffers
    ]
    body = [f"unsigned char block[{size}] __attribute__((aligned(64)));", *places, *block.lines]
    head = f"void {name}({', '.join(arguments)}) {{"
    constants = list(_constants(name, block, folder))
    forget = [f"#undef {buffer.name}" for buffer, _ in block.constants]
    return "\n".join((*constants, head, *(f"  {line}" for line in body), "}", *forget, ""))


def _constants(name: str, block: Block, folder: Path) -> Iterator[str]:
    for buffer, values in block.constants:
        kind, own = C_TYPES[buffer.dtype], f"{name}_{buffer.name}"
        if values.size > IN_A_FILE:
            values.tofile(folder / f"{own}.bin")
            yield f"extern const {kind} {own}[{values.size}];"
            yield (
                f'__asm__(".section .rodata\\n.balign 64\\n.hidden {own}\\n.globl {own}\\n{own}:\\n'
                f'.incbin \\"{own}.bin\\"\\n.previous\\n");'
            )
        else:
            numbers = ", ".join(map(_number, values)) or "0"
            yield f"static const {kind} {own}[{max(1, values.size)}] = {{{numbers}}};"
        yield f"#define {buffer.name} {own}"


def _number(x: np.generic) -> str:
    if isinstance(x, (np.bool_, np.integer)):
        return str(int(x))
    value = float(x)
    return repr(value) if np.isfinite(value) else "NAN" if np.isnan(value) else f"{'-' if value < 0 else ''}INFINITY"


@contextmanager
def exporting() -> Iterator[None]:
    """Inside the block filters run as ``torch.export`` can record them."""
    with compiled.tensor_forms(), torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # of torch about torch
        yield
