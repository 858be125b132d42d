"""A sum over samples in pieces is the plain one, in Python and in C."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from dlkf.filters import pieces
from dlkf.filters.pieces import LONGEST, sum_pieces
from dlkf.onboard.library import find_compiler
from dlkf.onboard.recording import export_mode
from tests.onboard.translated import lines_within, translate

SAMPLES = (1, 2, LONGEST - 1, LONGEST, LONGEST + 1, 2 * LONGEST + 1, 61, 100)  # 61 leaves a gap in each of four pieces


def add_products(begin, x, y):
    """Something that is linear in nothing but adds nothing of samples that are zero."""
    return torch.baddbmm(begin, x.mT, y.sin().unsqueeze(-1) * x) + (y * y).sum(1)[:, None, None]


def numbers(drives, samples):
    g = torch.Generator().manual_seed(samples)
    x = torch.randn(drives, samples, 3, generator=g, dtype=torch.float64)
    return torch.ones(drives, 3, 3).double(), x, torch.randn(drives, samples, generator=g, dtype=torch.float64)


class Sum(nn.Module):
    """Of one drive, with what was before and what comes after."""

    def __init__(self, samples):
        super().__init__()
        self.samples = samples

    def example(self):
        return numbers(1, self.samples)

    def forward(self, begin, x, y):
        first = sum_pieces(add_products, 2 * begin, x - 1, y.mT.mT)
        return torch.cat((first, sum_pieces(add_products, first, x, 2 * y), begin), 1)


@pytest.mark.skipif(find_compiler() is None, reason="no C compiler here")
def test_c_has_the_plain_sum(tmp_path):
    for function in translate(tmp_path, *(Sum(samples) for samples in SAMPLES)):
        example = function.module.example()
        # products are summed in another order
        torch.testing.assert_close(function(*example), function.wanted(*example), rtol=1e-12, atol=1e-12)
        turns = -(-function.module.samples // LONGEST)
        assert f"t < {turns}; t++" in function.code and "sin" in "".join(lines_within(function.code, "for (int t"))


@pytest.mark.parametrize("samples", SAMPLES)
@pytest.mark.parametrize("drives", [1, 50])
def test_python_has_the_plain_sum(samples, drives, monkeypatch):
    begin, x, y = numbers(drives, samples)
    want = add_products(begin, x, y)
    for at_once in (0, 10**9):
        monkeypatch.setattr(pieces, "AT_ONCE", at_once)
        torch.testing.assert_close(sum_pieces(add_products, begin, x, y), want, rtol=1e-12, atol=1e-12)
    with export_mode():
        torch.testing.assert_close(sum_pieces(add_products, begin, x, y), want, rtol=1e-12, atol=1e-12)
