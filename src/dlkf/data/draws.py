"""Random draws that belong to a piece of a drive, so that a test is one and the same however it is run.

Every piece has a generator of its own per purpose, from (seed, purpose, drive, time of its start). What is drawn for
it depends neither on the pieces beside it, nor on their order, batch size or IMU rate, nor on the seed of a training.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence

import torch
from torch import Tensor


def piece_generator(seed: int, purpose: str, drive: str, t_start: float) -> torch.Generator:
    """The generator of one piece; ``t_start`` [s] on the drive's own clock counts to the millisecond."""
    key = f"{seed}/{purpose}/{drive}/{round(1000 * t_start)}"
    digest = hashlib.blake2b(key.encode(), digest_size=8).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest, "big") >> 1)


def drawn_per_piece(
    draw: Callable[[torch.Generator], Tensor], seed: int, purpose: str, drives: Sequence[str], t_start: Tensor
) -> Tensor:
    """``draw(generator)`` of every piece, one row each."""
    pieces = zip(drives, t_start.tolist(), strict=True)
    return torch.stack([draw(piece_generator(seed, purpose, *piece)) for piece in pieces])
