"""Scores of batches at hand."""

from __future__ import annotations

import torch

from dlkf.evaluation.run import score_scenes


def score(filters, batches, *, outages=None, **options):
    """Of every filter over the same batches; ``outages`` has a mask (B, T) for each, or none is withheld."""
    masks = [torch.zeros(b.size[:2], dtype=torch.bool) for b in batches] if outages is None else outages
    total = sum(b.size[0] for b in batches)
    return score_scenes(filters, zip(batches, masks, strict=True), total=total, **options)
