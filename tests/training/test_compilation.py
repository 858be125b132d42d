"""``trainer.compile``: the loop through torch's compiler gives the losses that it gives without."""

import json
import subprocess
import sys
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from dlkf.filters.integration import advance, integrate
from dlkf.filters.saved import learned_filter, learned_settings
from dlkf.training.compilation import Turn, compiled_turn
from dlkf.training.loss import weighted
from tests.cars import car_batch

from .test_device import LOSSES, SIZES

SCRIPT = "from tests.training import test_compilation as t; t.told({kind!r}, {backend!r})"


def trial(kind: str) -> tuple[torch.nn.Module, Callable[[Turn], Tensor]]:
    """A filter, and its loss over pieces of which some lose their fixes."""
    batch = car_batch(3, 5, 50)
    batch.available[1:, 3:4] = False
    torch.manual_seed(1)
    filter_ = learned_filter(learned_settings({"kind": kind, "network": SIZES[kind]})).double().train()

    def loss(turn: Turn) -> Tensor:
        filter_.zero_grad()
        torch.manual_seed(1)
        fresh = batch.to("cpu")  # whose frames have made nothing yet
        return weighted(LOSSES[kind](integrate(fresh, filter_, keep_covariances=kind == "plus", turn=turn), fresh), {})

    return filter_, loss


def gradients(filter_: torch.nn.Module) -> Tensor:
    return torch.cat([p.grad.flatten() for p in filter_.parameters() if p.grad is not None])


def told(kind: str, backend: str) -> None:
    """Whether it was compiled, the losses, and how far the gradients are apart."""
    filter_, loss = trial(kind)
    turn = compiled_turn(loss, filter_.parameters(), backend)
    value = loss(turn)
    value.backward()
    theirs, plain = gradients(filter_), loss(advance)
    plain.backward()
    ours = gradients(filter_)
    print(json.dumps([turn is not advance, value.item(), plain.item(), float((theirs - ours).norm() / ours.norm())]))


@pytest.mark.commands
@pytest.mark.parametrize(("kind", "backend"), [("dlkf", "aot_eager"), ("plus", "aot_eager"), ("dlkf", "inductor")])
def test_losses_and_gradients_are_those_of_the_loop(kind, backend, request):
    """The whole turn as one graph and its gradient by the compiler, to rounding in float64. In a process of its own:
    the compiler does not look through the checks of shapes that tests switch on."""
    script = [sys.executable, "-W", "ignore", "-c", SCRIPT.format(kind=kind, backend=backend)]
    out = subprocess.run(script, cwd=request.config.rootpath, capture_output=True, text=True, check=True)
    compiled, value, plain, apart = json.loads(out.stdout.splitlines()[-1])
    assert compiled, out.stderr
    assert value == pytest.approx(plain, rel=1e-9)
    assert apart < 1e-8


def test_what_cannot_be_compiled_runs_as_it_is_and_says_why(capfd):
    def loss(turn: Turn) -> Tensor:
        raise RuntimeError("no compiler is here\nand much more")

    assert compiled_turn(loss, []) is advance
    assert "could not be compiled (no compiler is here)" in capfd.readouterr().err
