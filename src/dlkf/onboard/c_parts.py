"""A long C function in parts: compilers take more than in proportion for long ones, and make them slower."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

from dlkf.onboard.c_memory import C_TYPES, Block

LINES = 120  # of a part; more where it would end within braces


def write_parts(name: str, arguments: Sequence[str], block: Block) -> list[str]:
    """The lines of ``name``, which calls its parts one after the other with its own arguments; the last is ``work``,
    in which the tensors lie."""
    parts, names = list(_cut(block.lines)), [argument.split("*restrict ")[1] for argument in arguments]
    listed, unused = ", ".join(arguments), " ".join(f"(void){x};" for x in names)
    if len(parts) < 2:
        return [f"void {name}({listed}) {{", f"  {unused}", *_indent(block, block.lines), "}"]
    written = []
    for k, lines in enumerate(parts):
        written += [f"static DLKF_APART void {name}_part{k}({listed}) {{", f"  {unused}", *_indent(block, lines), "}"]
    calls = [f"  {name}_part{k}({', '.join(names)});" for k in range(len(parts))]
    return [*written, f"void {name}({listed}) {{", *calls, "}"]


def _cut(lines: Sequence[str]) -> Iterator[list[str]]:
    part: list[str] = []
    depth = 0
    for line in lines:
        part.append(line)
        depth += line.count("{") - line.count("}")
        if depth == 0 and len(part) >= LINES:
            yield part
            part = []
    if part:
        yield part


def _indent(block: Block, lines: Sequence[str]) -> list[str]:
    """Lines behind the places of the tensors in them."""
    used = set(re.findall(r"\bx\d+\b", " ".join(lines)))
    places = [
        f"{C_TYPES[b.dtype]} *{b.name} = (void *)((unsigned char *)work + {block.places[b.name]});"
        for b in block.buffers
        if b.name in used
    ]
    return [f"  {line}" for line in (*places, *lines)]
