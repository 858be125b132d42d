"""A long function of C in parts does what the whole does."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from dlkf.filters.branches import select_branch
from dlkf.onboard import c_parts
from dlkf.onboard.c_memory import Block
from dlkf.onboard.library import find_compiler
from tests.onboard.translated import translate

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler here")
PARTS = "static DLKF_APART void"


class Long(nn.Module):
    """Sixty steps, of which each reads one from long before; a branch of many lines among them."""

    def example(self):
        return torch.tensor([1.0]).double(), torch.linspace(-1, 1, 36, dtype=torch.float64).view(1, 6, 6)

    def forward(self, on, x):
        made, first = [x], x.cumsum(1)
        for k in range(60):
            made.append((made[-1] @ made[k // 2]).tanh() + first)
        then = made[-1]
        for k in range(30):
            then = (then @ made[k]).tanh().cumsum(2)
        return torch.cat((select_branch(on > 0, then, first), made[-1], made[33]))


def test_values_and_braces_of_parts(tmp_path, monkeypatch):
    """Three lengths of a part: the same numbers to the bit of one function and of many."""
    functions = {}
    for lines in (10**9, 120, 7):
        monkeypatch.setattr(c_parts, "LINES", lines)
        (tmp_path / str(lines)).mkdir()
        (functions[lines],) = translate(tmp_path / str(lines), Long())
    on, x = Long().example()
    for u in (on, -on):
        torch.testing.assert_close(functions[10**9](u, x), functions[10**9].wanted(u, x), rtol=1e-12, atol=1e-12)
        assert all(functions[lines](u, x).equal(functions[10**9](u, x)) for lines in (120, 7))
    counts = {lines: function.code.count(PARTS) for lines, function in functions.items()}
    assert counts[10**9] == 0 and 2 <= counts[120] <= counts[7] // 2
    for function in functions.values():
        depth = 0
        for line in function.code.splitlines():
            assert depth == 0 or PARTS not in line
            depth += line.count("{") - line.count("}")
        assert depth == 0


def test_a_part_ends_outside_braces_only(monkeypatch):
    monkeypatch.setattr(c_parts, "LINES", 3)
    block = Block()
    x = block.new((4,), torch.float64)
    lines = ["x0[0] = 1;", "if (in0[0]) {", *(f"x0[{k}] = {k};" for k in range(4)), "}", "out0[0] = x0[3];"]
    for line in lines:
        block.write(line, x)
    block.lay_out()
    code = c_parts.write_parts(
        "f", ["const double *restrict in0", "double *restrict out0", "double *restrict work"], block
    )
    written = [line.strip() for line in code]
    starts = [k for k, line in enumerate(written) if line.startswith(PARTS)]
    assert len(starts) == 2
    assert [*lines[:7], "}"] == [line for line in written[starts[0] : starts[1]] if line in lines]
    assert written[-4:] == ["void f(const double *restrict in0, double *restrict out0, double *restrict work) {",
                            "f_part0(in0, out0, work);", "f_part1(in0, out0, work);", "}"]  # fmt: skip
    # both know where x0 lies
    assert sum(line.startswith("double *x0 = ") for line in written) == 2
