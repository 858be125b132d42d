"""A filter as C: the functions of :mod:`dlkf.onboard.functions`, Python's constants for the core, a description.

The core itself (``core/``) is written by hand and the same for every filter; ``step.c``, ``weights.c``, ``step.h`` and
``constants.h`` are generated.
"""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Container, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from dlkf.base.errors import InputError, first_line
from dlkf.data import aids, alignment, limits, resampling, spikes, velocity_fit
from dlkf.data.aid_tables import LAST
from dlkf.data.validate import LIMITS
from dlkf.filters.aids.attach import aid_columns, find_tables
from dlkf.filters.integration import Estimator
from dlkf.navigation import earth
from dlkf.onboard.c_code import Translation
from dlkf.onboard.c_memory import C_TYPES, Block
from dlkf.onboard.c_parts import write_parts
from dlkf.onboard.carried import Layout
from dlkf.onboard.functions import (
    OUTPUTS,
    ROW,
    START,
    Anchor,
    Begin,
    Bridge,
    Carry,
    Function,
    Grid,
    Row,
    Turn,
    count_fix_numbers,
    count_output_numbers,
    make_layout,
)  # fmt: skip
from dlkf.onboard.headings import Headings, heading_functions
from dlkf.onboard.meanings import describe_column
from dlkf.onboard.recording import export_mode, record
from dlkf.running import bridging, imu_stream, streaming
from dlkf.running.bridging import can_bridge
from dlkf.running.reanchoring import can_reanchor
from dlkf.running.start import LOOKBACK_S, bank, standstill

CORE = Path(__file__).parent / "core"
EXAMPLES = Path(__file__).parent / "examples"
CORE_FILES = ("dlkf.h", "dlkf.c", "samples.c", "spikes.c", "align.c", "search.c", "aids.c", "limits.c", "geometry.h")
IN_A_FILE = 4096  # constants of more numbers than that go to weights.c
COLUMNS = ("t", "revised", *ROW)  # of a row of the core; then those of further sensors
ANCHOR_M = {torch.float64: streaming.ANCHOR_M, torch.float32: 1000.0}  # where float resolves 0.1 mm


class Written(NamedTuple):
    """C of one function, its large constants, and the bytes that it works in."""

    code: str
    weights: str
    work: int


FINITE = """#if defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__
#error "NaN stands for an unknown value: compile without -ffast-math, -Ofast and -ffinite-math-only"
#endif"""
UNUSED = """#if defined(__GNUC__)
#define DLKF_UNUSED __attribute__((unused)) /* of helpers and constants that this filter does without */
#define DLKF_APART __attribute__((noinline)) /* a compiler takes more than twice as long for one long function */
#else
#define DLKF_UNUSED
#define DLKF_APART
#endif"""
VECTORS = """#if defined(__GNUC__)
#define DLKF_WITHIN inline __attribute__((always_inline)) /* with the sizes of a call, which are constants */
#if defined(__AVX512F__)
#define DLKF_VECTOR 64 /* bytes */
#define DLKF_ROWS 6 /* of a tile */
#define DLKF_TILE 24 /* vectors that leave room for others in the registers */
#elif defined(__AVX__) || defined(__SSE2__) || defined(__ARM_NEON)
#if defined(__AVX__)
#define DLKF_VECTOR 32
#else
#define DLKF_VECTOR 16
#endif
#define DLKF_ROWS 4
#define DLKF_TILE 12
#endif
#else
#define DLKF_WITHIN inline
#endif"""


def write_source(
    folder: Path, estimator: Estimator, grid: Grid, name: str, made: dict[str, Any], *, loop_alone: bool = False
) -> Layout:
    """``step.c``, ``weights.c``, ``step.h``, and with them the core and ``step.json``, which describes the numbers.

    ``loop_alone`` leaves out what turns fixes and solutions into those of a vehicle, which takes most of the time.
    Raises InputError for a filter that cannot be exported.
    """
    with export_mode():
        layout = make_layout(estimator, grid)
        functions: dict[str, type[Function]] = {"turn": Turn}
        if not loop_alone:
            functions |= {"start": Begin, "row": Row, "carry": Carry}
            if can_reanchor(layout.like.memory):
                functions["anchor"] = Anchor
            if can_bridge(layout.like.memory):
                functions["bridge"] = Bridge
        modules = {f: kind(estimator, grid, layout).eval() for f, kind in functions.items()}
        done = {f: translate_function(f"dlkf_{f}", module) for f, module in modules.items()}
    without = [(CORE / f"no_{f}.c.in").read_text() for f in ("anchor", "bridge") if f not in done]
    loop = (CORE / "run.c.in").read_text()
    parts = [write_preamble(), *(x.code for x in done.values()), loop, *without]
    (folder / "step.c").write_text("\n".join(parts))
    large = "".join(x.weights for x in done.values())
    head = "/* Weights of the filter, made by dlkf.export. */\n#include <math.h>\n#include <stdint.h>\n"
    (folder / "weights.c").write_text(head + large)
    of_search = Headings.none() if loop_alone else _translate_headings(grid.samples, grid.dt)
    values = _sizes(estimator, layout, grid, name, max(x.work for x in done.values()), done)
    room = max(int(values["WORK"]), -(-of_search.work // 8) + 2 * of_search.size)
    values |= {"WORK": room, **of_search.sizes(), **_aids(estimator)}
    (folder / "step.h").write_text(_fill((CORE / "step.h.in").read_text(), values), encoding="utf-8")
    if loop_alone:
        return layout
    (folder / "heading.c").write_text(write_preamble() + of_search.code)
    (folder / "constants.h").write_text(constants())
    for file in CORE_FILES:
        (folder / file).write_text((CORE / file).read_text())
    described = {
        "model": name, "rate_hz": 1 / grid.dt, "epoch_s": grid.epoch_s,
        "row": [{"name": c, "place": k, "meaning": describe_column(c)} for k, c in enumerate(list_columns(estimator))],
        "memory": {"numbers": layout.size, "type": "float64", "fields": [f.as_dict() for f in layout.fields]}, **made,
    }  # fmt: skip
    (folder / "step.json").write_text(json.dumps(described, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    return layout


@lru_cache
def _translate_headings(samples: int, dt: float) -> Headings:
    """``heading.c``, which is the same for every filter of a grid."""
    with export_mode():
        layout, functions = heading_functions(Grid(samples, dt))
        done = [translate_function(f"dlkf_heading_{name}", x) for name, x in functions.items()]
    return Headings.of(layout, "\n".join(x.code for x in done), max(x.work for x in done))


def write_preamble() -> str:
    """What stands before the functions of ``step.c``."""
    algebra = (CORE / "algebra.c.in").read_text()
    kinds = ({"REAL": "double", "F": ""}, {"REAL": "float", "F": "f"})
    include = "\n".join(f"#include {name}" for name in ("<math.h>", "<stdint.h>", "<string.h>", '"step.h"'))
    made = "/* Made by dlkf.export; do not edit: the equations are in the Python package. */"
    elementary = (CORE / "elementary.c.in").read_text()
    twice = (_fill(text, kind) for text in (algebra, (CORE / "products.c.in").read_text()) for kind in kinds)
    return "\n".join((made, include, FINITE, UNUSED, VECTORS, "", elementary, *twice))


def _sizes(
    estimator: Estimator, layout: Layout, grid: Grid, name: str, work: int, done: Container[str]
) -> dict[str, Any]:
    """What ``step.h`` is filled with."""
    place = {f.name: f.offset for f in layout.fields}
    window_s, columns = alignment.SEARCH.window_s, list_columns(estimator)
    lookback = math.ceil(max(LOOKBACK_S, window_s + velocity_fit.READ_S) / grid.epoch_s) + 2
    layout_of = f"{name} {grid} {layout.size} {[(f.name, f.shape) for f in layout.fields]} {columns}"
    return {
        "NAME": name, "MEMORY": layout.size, "SAMPLES": grid.samples, "RATE_HZ": repr(1 / grid.dt),
        "RATE_MILLIHZ": round(1e3 / grid.dt), "LOOKBACK": lookback,
        "LEVELLED": max(1, round(window_s / grid.epoch_s)), "FITTED": max(2, round(velocity_fit.FIT_S / grid.epoch_s)),
        "CONFIRMED": max(1, round(velocity_fit.CONFIRMED_S / grid.epoch_s)),
        "REACH": round(velocity_fit.REACH_S / grid.epoch_s),
        "REST": round(LOOKBACK_S / grid.epoch_s), "STILL": max(1, round(standstill.SHORTEST_REST_S / grid.epoch_s)),
        "TAIL": max(1, min(grid.samples, round(alignment.RATE_AVERAGE_S / grid.dt))),
        "FIX": count_fix_numbers(estimator), "START": START, "OUTPUTS": count_output_numbers(estimator),
        "POSTERIOR": OUTPUTS["prior"], "COLUMNS": len(columns),
        "WORK": -(-work // 8) + max(layout.size, 6 * grid.samples),
        "INNOVATION": sum(OUTPUTS[k] for k in ("prior", "posterior", "error", "std")),
        "AT_ORIGIN": place["frame.origin_e"], "AT_AXES": place["frame.C_en"], "AT_HEIGHT": place["frame.height"],
        "ANCHOR_M": f"{ANCHOR_M[grid.dtype] if 'anchor' in done else 1e12:g}",
        "BRIDGES": int("bridge" in done),
        "FINGERPRINT": f"0x{zlib.crc32(layout_of.encode()):08x}u",
        "STRINGS": ", ".join(f'"{c}"' for c in columns),
        "NAMES": ", ".join(f"DLKF_{c.upper()}" for c in columns),
    }  # fmt: skip


def list_columns(estimator: Estimator) -> tuple[str, ...]:
    """Of a row: :data:`COLUMNS`, and what the filter says of further sensors."""
    return (*COLUMNS, *aid_columns(estimator))


def _aids(estimator: Estimator) -> dict[str, object]:
    """What ``step.h`` says of further sensors."""
    tables = find_tables(estimator)
    return {
        "AIDS": len(tables), "AID_NAMES": ", ".join(f'"{t.name}"' for t in tables) or '""',
        "AID_LAST": ", ".join(str(int(t.reduce == LAST)) for t in tables) or "0",
    }  # fmt: skip


def constants() -> str:
    """``constants.h``: what the core shares with the Python stream, from there."""
    rows = []
    for quality in range(max(resampling.DEFAULT_STD) + 1):
        std = resampling.default_std(quality) if quality in resampling.DEFAULT_STD else (0.0,) * 6
        rows.append("{" + ", ".join(map(repr, std)) + "}")
    values: dict[str, float] = {
        "PI": math.pi,
        "GAP_S": LIMITS.gap_s, "GAP_SAMPLES": LIMITS.gap_samples,
        "FULL_SCALE_ACCEL": limits.FULL_SCALE[0], "FULL_SCALE_GYRO": limits.FULL_SCALE[1],
        "LOWEST_M": limits.HEIGHTS_M[0], "HIGHEST_M": limits.HEIGHTS_M[1],
        "ESTIMATE_LOWEST_M": limits.ESTIMATE_HEIGHTS_M[0], "ESTIMATE_HIGHEST_M": limits.ESTIMATE_HEIGHTS_M[1],
        "ASTRAY_S": imu_stream.ASTRAY_S, "USUAL_S": imu_stream.USUAL_S,
        "LONGEST_BRIDGE_S": bridging.LONGEST_BRIDGE_S, "BEFORE": imu_stream.BEFORE, "SETTLE_S": streaming.SETTLE_S,
        "FIRST_OF_FIXES": streaming.FIRST_OF_FIXES, "FIRST_OF_AIDS": streaming.FIRST_OF_AIDS,
        "ON_BOUNDARY_S": resampling.ON_BOUNDARY_S, "SMALLEST_STD": resampling.SMALLEST_STD,
        "MIN_SPEED": alignment.SEARCH.min_speed, "RATE_AVERAGE_S": alignment.RATE_AVERAGE_S,
    }  # fmt: skip
    values |= {"SPIKE_ACCEL": spikes.FLOOR[0], "SPIKE_GYRO": spikes.FLOOR[1]}
    names = ("RATIO", "SHARE", "STEADY", "STEADY_FLOOR", "BEFORE", "QUARTILE")
    values |= {f"SPIKE_{name}": getattr(spikes, name) for name in names}
    values |= {"REST_SPREAD_ACCEL": standstill.REST_SPREAD[0], "REST_SPREAD_GYRO": standstill.REST_SPREAD[1]}
    for module, names in (
        (aids, ("LARGEST_VALUE", "SEA_LEVEL_PA", "SCALE_M", "EXPONENT")),
        (bank, ("RING", "REVERSE_PRIOR", "REVERSE_SPEED", "RING_PRIOR", "COARSE", "NIS_CAP", "DECIDED", "OTHER",
                "READY_STD", "OVERBOUND", "BIAS_OVERBOUND", "LEAST_BIAS_STD")),
        (standstill, ("REST_RATE", "REST_SPEED", "REST_POSITION_STD", "RATE_STD", "RATE_DRIFT_STD", "RATE_SCALE_STD")),
        (alignment, ("SIDESLIP_STD", "AXLE_STD", "ACCEL_BIAS_STD", "JERK_STD", "SPREAD_STD")),
        (velocity_fit, ("UNKNOWN_VELOCITY_STD", "UNKNOWN_SLOPE_STD", "ACCELERATION_STD", "GYRO_BIAS_STD", "FIT_STD",
                        "OUTLIER_SIGMAS", "MOST_OUTLIERS", "LEAST_SHARE", "OVERDETERMINED", "MOTION_SIGMAS",
                        "CHANGE_SIGMAS", "MOST_ACCELERATION", "JOLT_STD", "LEAST_DIFFERENCES", "SECOND_DIFFERENCE",
                        "DIFFERENCE", "LEAST_FITTED", "UNKNOWN_STD")),
        (earth, ("SEMI_MAJOR", "SEMI_MINOR", "ECCENTRICITY_SQ", "EARTH_RATE", "GRAVITY_EQUATOR", "SOMIGLIANA",
                 "GRAVITATIONAL_CONSTANT", "STANDARD_GRAVITY")),
        (limits, ("FASTEST_M_S", "STEEPEST_M_S", "JUMP_M", "JUMP_SIGMAS", "MOST_JUMP_STD_M", "LARGEST_STD",
                  "NOWHERE_DEG", "FROZEN_SPEED_M_S", "FROZEN_M", "FROZEN_IMU_S", "AGREEING_FIXES", "AGREEING_S",
                  "ESTIMATE_M_S", "LOST_M", "LOST_SIGMAS", "LOST_FIXES", "LOST_S", "LOST_SHARE", "EARTH_M")),
    ):  # fmt: skip
        values |= {name: getattr(module, name) for name in names}
    lines = [f"#define {name} ({value!r})" for name, value in values.items()]
    said = "/* Constants of the Python package, made by dlkf.export; do not edit. */"
    head = f"{said}\n#ifndef DLKF_CONSTANTS_H\n#define DLKF_CONSTANTS_H\n"
    table = f"#define QUALITIES {len(rows)}\n#define DEFAULT_STD_ROWS {{{', '.join(rows)}}}"
    return "\n".join((head, FINITE, *lines, table, "\n#endif\n"))


def _fill(text: str, values: Mapping[str, object]) -> str:
    for key, value in values.items():
        text = text.replace(f"@{key}@", str(value))
    return text


def translate_function(name: str, function: Function) -> Written:
    """C of a function that works in memory it is given."""
    try:
        done = Translation(record(function))
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"this filter cannot be exported: {first_line(error)}") from error
    block, inputs = done.block, done.inputs
    arguments = [f"const {C_TYPES[b.dtype]} *restrict {b.name}" for b in inputs]
    for k, view in enumerate(done.outputs):
        arguments.append(f"{C_TYPES[view.meta.dtype]} *restrict out{k}")
        if view.buffer.name == f"out{k}":
            continue
        dense = done.dense(view)
        start = dense.meta.storage_offset()
        block.write(
            f"for (int i = 0; i < {dense.meta.numel()}; i++) out{k}[i] = {dense.buffer.name}[{start}+i];", dense
        )
    size = block.lay_out()
    arguments.append("double *restrict work")
    own, large = _declare_constants(name, block)
    forget = [f"#undef {buffer.name}" for buffer, _ in block.constants]
    code = "\n".join((*own, *write_parts(name, arguments, block), *forget, ""))
    return Written(code, "".join(f"{line}\n" for line in large), size)


def _declare_constants(name: str, block: Block) -> tuple[list[str], list[str]]:
    """Those that stand beside the function, and those that are weights."""
    own, large = [], []
    for buffer, values in block.constants:
        kind, label = C_TYPES[buffer.dtype], f"{name}_{buffer.name}"
        head = f"const {kind} {label}[{max(1, values.size)}]"
        numbers = ", ".join(map(_format_number, values)) or "0"
        if values.size > IN_A_FILE:
            own.append(f"extern {head};")
            large += [f"extern {head};", f"{head} = {{{numbers}}};"]
        else:
            own.append(f"DLKF_UNUSED static {head} = {{{numbers}}};")
        own.append(f"#define {buffer.name} {label}")
    return own, large


def _format_number(x: np.generic) -> str:
    if x.dtype.kind in "biu":
        return str(int(x))
    value = float(x)
    if not np.isfinite(value):
        return "NAN" if np.isnan(value) else f"{'-' if value < 0 else ''}INFINITY"
    return f"{x!s}f" if x.dtype == np.float32 else repr(value)
