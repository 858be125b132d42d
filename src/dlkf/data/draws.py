"""Seeds, and random draws that belong to a segment, so that a test is one and the same however it is run.

Every segment has a generator of its own per purpose, from (seed, purpose, drive, time of its start). What is drawn for
it depends neither on the segments beside it, nor on their order, batch size or IMU rate, nor on the seed of a training.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor


def combine_seed(*numbers: int) -> int:
    """One seed from several numbers, the same on every machine: of batches and segments."""
    return int(np.random.SeedSequence(numbers).generate_state(1, np.uint64)[0]) >> 1


def step_seed(*numbers: int) -> int:
    """One seed from several numbers: of masks and dropout in a training step."""
    return hash(numbers) % 2**63


def segment_generator(seed: int, purpose: str, drive: str, t_start: float) -> torch.Generator:
    """The generator of one segment; ``t_start`` [s] on the drive's own clock counts to the millisecond."""
    key = f"{seed}/{purpose}/{drive}/{round(1000 * t_start)}"
    digest = hashlib.blake2b(key.encode(), digest_size=8).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest, "big") >> 1)


def draw_per_segment(
    draw: Callable[[torch.Generator], Tensor], seed: int, purpose: str, drives: Sequence[str], t_start: Tensor
) -> Tensor:
    """``draw(generator)`` of every segment, one row each."""
    segments = zip(drives, t_start.tolist(), strict=True)
    return torch.stack([draw(segment_generator(seed, purpose, *segment)) for segment in segments])
