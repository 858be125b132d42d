"""The turn of the loop as few large operations: ``torch.compile`` of strapdown, network, Kalman filter and feedback.

A GPU spends an epoch on launching some thousand small kernels; fused they are fewer. On a CPU the loops that numba
compiles and products in oneDNN's order are faster than what is made here (docs/results/speed.md).
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterable

import torch
from torch import Tensor

from dlkf.console import warned
from dlkf.filters.integration import Step, advance

Turn = Callable[..., tuple[object, Step]]
MOST_FORMS = 64  # of a turn: the first and the others, each size of a batch, with late fixes, with a lever arm


def compiled_turn(trial: Callable[[Turn], Tensor], weights: Iterable[Tensor], backend: str = "inductor") -> Turn:
    """:func:`advance`, compiled; as it is, with a line that says why, where that cannot be done.

    ``trial`` gives the loss of a run with a turn. It is run once, with its gradient in the ``weights``, for that is
    when torch compiles.
    """
    print("the filter's loop is being compiled, which takes minutes", file=sys.stderr, flush=True)
    torch._dynamo.config.recompile_limit = MOST_FORMS
    turn = torch.compile(advance, backend=backend, fullgraph=True)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=UserWarning)  # that it looks through lru_cache
        try:
            torch.autograd.grad(trial(turn), tuple(weights), allow_unused=True)
        except Exception as error:  # of dynamo, of Inductor, of a compiler that is not there: torch names no common one
            said = str(error).strip().partition("\n")[0][:200] or type(error).__name__
            warned(f"the filter's loop could not be compiled ({said}); the training goes on without trainer.compile")
            return advance
    return turn
