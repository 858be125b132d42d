"""Draws that belong to a segment: the same whatever is drawn beside it."""

import math

import torch

from dlkf.data.draws import draw_per_segment, segment_generator


def normal(generator):
    return torch.randn(4000, generator=generator, dtype=torch.float64)


def test_a_segment_keeps_its_draws_in_any_company_and_order():
    names, t = ["a", "b", "a", "c"], torch.tensor([0.0, 0.0, 60.0, 1.7e9], dtype=torch.float64)
    drawn = draw_per_segment(normal, 1, "start", names, t)
    back = draw_per_segment(normal, 1, "start", names[::-1], t.flip(0)).flip(0)
    assert torch.equal(drawn, back)
    assert torch.equal(drawn[2:3], draw_per_segment(normal, 1, "start", ["a"], t[2:3] + 1e-5))  # a clock's rounding


def test_segments_seeds_and_purposes_are_independent_and_normal():
    """Correlation of 4000 independent pairs has a 1σ of 0.016: 0.08 is five of them, as for mean and spread."""
    keys = [(s, p, d, t) for s in (0, 1) for p in ("start", "bias") for d in ("a", "b") for t in (0.0, 1.0, 2.0)]
    rows = torch.stack([normal(segment_generator(*key)) for key in keys])
    correlation = torch.corrcoef(rows)
    assert (correlation - torch.eye(len(keys))).abs().max() < 0.08
    assert rows.mean(-1).abs().max() < 0.08 and (rows.std(-1) - 1).abs().max() < 0.08 / math.sqrt(2)
