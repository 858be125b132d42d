"""Programs round an exported filter, for this machine and others."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Iterable
from pathlib import Path

import pytest

from dlkf.onboard.library import CORE, FILTER
from tests.onboard.streams import Calls

HERE = Path(__file__).parent
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wconversion", "-pedantic", "-Werror")
SANITIZED = ("-g", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-fno-omit-frame-pointer")


def tool(name: str) -> str:
    """A program's path; skips where there is none."""
    found = shutil.which(name)
    if found is None:
        pytest.skip(f"no {name} here")
    return found


def compile_program(
    cc: str, folder: Path, main: Path, out: Path, flags: Iterable[str] = ("-O2",), of_filter: Iterable[str] = (),
    link: Iterable[str] = ("-lm",), filter_of: Path | None = None,
) -> Path:  # fmt: skip
    """``main`` with the core and the filter in ``folder``; ``of_filter`` are flags of the filter alone, ``filter_of`` a
    library that has it compiled."""
    out.parent.mkdir(parents=True, exist_ok=True)
    objects = []
    for source in (main, *(folder / name for name in (*CORE, *(() if filter_of else FILTER)))):
        objects.append(out.parent / f"{source.name}.o")
        own = [*flags, *(of_filter if source.name in FILTER else ())]
        run([cc, *own, f"-I{folder}", f"-I{main.parent}", "-c", source, "-o", objects[-1]])
    shared = (filter_of, f"-Wl,-rpath,{filter_of.parent}") if filter_of else ()
    run([cc, *flags, *objects, *shared, "-o", out, *link])
    return out


def stack_of_calls(cc: str, folder: Path, scratch: Path, flags: Iterable[str] = ("-O2",)) -> dict[str, int]:
    """Bytes on the stack of every function with all that it calls, by gcc's call graph; none may depend on data."""
    frames: dict[str, int] = {}
    called: dict[str, set[str]] = {}
    for name in (*CORE, *FILTER):
        run([cc, "-std=c99", *flags, "-fcallgraph-info=su", "-c", folder / name, "-o", scratch / f"{name}.o"])
        graph = (scratch / f"{name}.ci").read_text()
        assert "dynamic" not in graph
        frames |= {x: int(n) for x, n in re.findall(r'node: { title: "([^"]+)" label: "[^"]*?(\d+) bytes \(', graph)}
        for one, other in re.findall(r'sourcename: "([^"]+)" targetname: "([^"]+)"', graph):
            called.setdefault(one, set()).add(other)

    def depth(function: str) -> int:
        return frames.get(function, 0) + max(map(depth, called.get(function, ())), default=0)

    return {function: depth(function) for function in frames}


def run(command: list, **options) -> subprocess.CompletedProcess:
    """A command that must end well."""
    done = subprocess.run(command, capture_output=True, text=True, **options)
    assert done.returncode == 0, f"{command}: {done.stderr[-3000:]}"
    return done


def lines(sent: Calls) -> str:
    """Calls as lines for ``navigate``."""
    out = []
    for call in sent:
        flat = [x for part in call.arguments for x in (part if isinstance(part, list) else [part])]
        out.append(",".join([call.kind, *(f"{float(x):.17g}" for x in flat)]))
    return "\n".join(out) + "\n"
