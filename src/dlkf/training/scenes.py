"""The test side of a split as scenes to score: fixed pieces, fixed outages, the same for every filter."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, replace
from typing import Any

import torch

from dlkf.data.datamodule import DriveDataModule
from dlkf.data.drive import Batch
from dlkf.data.segments import make_batch
from dlkf.evaluation.outages import OutagePlan
from dlkf.evaluation.run import Scene


class SplitScenes:
    """Pieces of one side of a data module's split with an outage plan; iterating gives the same again.

    ``limit`` keeps that many pieces, spread evenly over the side.
    """

    mode = "pieces"

    def __init__(
        self, data: DriveDataModule, side: str, plan: OutagePlan, seed: int, limit: int | None = None
    ) -> None:
        self.data, self.side, self.outage, self.seed = data, side, plan, seed
        pieces = data.pieces(side)
        step = 1 if limit is None else max(1, len(pieces) // limit)
        self.pieces = pieces[::step][:limit]
        self.runs = len(self.pieces)

    def __iter__(self) -> Iterator[Scene]:
        generator = torch.Generator().manual_seed(self.seed)
        for k in range(0, self.runs, self.data.batch_size):
            part = self.pieces[k : k + self.data.batch_size]
            batch = make_batch(
                self.data.stack, part, dtype=torch.float64, start=self.data.start, generator=generator
            )
            for mask in self.outage.masks(batch, generator):
                yield batch, mask

    def withheld(self) -> list[Batch]:
        """The batches with the outages already applied."""
        return [replace(batch, available=batch.available & ~mask) for batch, mask in self]

    def described(self) -> dict[str, Any]:
        """The rules as plain values."""
        return {
            "split": self.side,
            "pieces": self.runs,
            "length_s": self.data.eval_length_s,
            "start": asdict(self.data.start),
            "outage": asdict(self.outage),
            "seed": self.seed,
        }
