"""Training strategy without a Trainer: curriculum, weights, decimation, outages, guard; all resume from state."""

import math
from itertools import pairwise
from types import SimpleNamespace

import pytest
import torch

from dlkf.errors import InputError
from dlkf.training.callbacks.curriculum import LengthCurriculum
from dlkf.training.callbacks.guard import StepGuard
from dlkf.training.callbacks.loss_weights import AdaptiveLossWeights
from dlkf.training.callbacks.masking import GnssDecimation, OutageInjection
from tests.filters.scene import scene


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_curriculum_is_the_paper_s():
    """R071: 20 s for the first 20 epochs, then linear growth to the full length at epoch 40."""
    law = LengthCurriculum(20, 60, 20, 40).length_s
    assert [law(e) for e in (0, 19, 20, 30, 39, 40, 499)] == [20, 20, 20, 40, 58, 60, 60]
    data = SimpleNamespace(length_law=None)
    LengthCurriculum(20, 60, 1, 2).setup(SimpleNamespace(datamodule=data), None, "fit")
    assert data.length_law(0) == 20 and data.length_law(2) == 60


def test_weights_start_at_one_and_follow_the_losses():
    """Velocity and attitude weigh more while position loss dominates, within 1 … w_max (R066)."""
    weights = AdaptiveLossWeights(w_max=10, memory=0.5)
    assert weights.weights() == {"position": 1.0, "velocity": 1.0, "attitude": 1.0}
    first = weights.update({"position": 8.0, "velocity": 2.0, "attitude": 0.01})
    assert first == {"position": 1.0, "velocity": 4.0, "attitude": 10.0}
    later = weights.update({"position": 1.0, "velocity": 2.0, "attitude": 9.0})
    assert later["velocity"] == pytest.approx(4.5 / 2.0) and later["attitude"] == 1.0
    again = AdaptiveLossWeights(w_max=10, memory=0.5)
    again.load_state_dict(weights.state_dict())
    assert again.weights() == weights.weights()


def test_weights_ignore_a_diverged_epoch():
    weights = AdaptiveLossWeights()
    before = weights.update({"position": 4.0, "velocity": 2.0, "attitude": 1.0})
    assert weights.update({"position": math.inf, "velocity": math.nan, "attitude": math.inf}) == before


def test_decimation_keeps_every_nth_fix_per_piece():
    batch = scene(200, 60)
    kept = GnssDecimation(2, 5).transform(batch, 0, generator()).available
    intervals = set()
    for row in kept:
        at = (row.nonzero().flatten() + 1).tolist()
        gaps = {b - a for a, b in pairwise(at)}
        assert len(gaps) == 1 and at[0] == next(iter(gaps))
        intervals |= gaps
    assert intervals == {2, 3, 4, 5}
    assert GnssDecimation(2, 5, start_epoch=3).transform(batch, 2, generator()) is batch


def test_outages_have_the_paper_s_lengths_and_leave_room():
    """R070: 10–30 s; ≥ 10 s with GNSS before, ≥ 5 s after (paper.md 4.14); none in warm-up (R072)."""
    batch = scene(300, 60)
    hidden = ~OutageInjection(start_epoch=40).transform(batch, 40, generator()).available
    length = hidden.sum(-1)
    assert length.min() >= 9 and length.max() <= 31 and length.float().mean().sub(20).abs() < 1.5
    assert not hidden[:, :10].any() and not hidden[:, -5:].any()
    assert (hidden.int().diff(dim=1).abs().sum(-1) == 2).all()
    assert OutageInjection(start_epoch=40).transform(batch, 39, generator()) is batch
    short = scene(3, 20)
    assert OutageInjection(start_epoch=0).transform(short, 50, generator()) is short


def test_random_masks_depend_on_the_step_alone():
    batch = scene(20, 60)
    a, b, c = (OutageInjection().transform(batch, 99, generator(s)).available for s in (1, 1, 2))
    assert torch.equal(a, b) and not torch.equal(a, c)


def test_guard_skips_nan_and_explosions_and_gives_up_at_last():
    guard = StepGuard(factor=100, window=20, limit=3)
    assert all(guard.accepts(1.0 + 0.1 * k) for k in range(12))
    assert not guard.accepts(math.nan) and not guard.accepts(math.inf) and guard.in_a_row == 2
    assert guard.accepts(50.0) and guard.in_a_row == 0
    assert not guard.accepts(1e6) and guard.skipped == 3
    again = StepGuard(factor=100, window=20, limit=3)
    again.load_state_dict(guard.state_dict())
    assert again.norms == guard.norms and again.skipped == 3

    parameter = torch.nn.Parameter(torch.ones(2))
    module = SimpleNamespace(parameters=lambda: [parameter], log=lambda *a: None)
    optimizer = torch.optim.AdamW([parameter])
    parameter.grad = torch.full((2,), math.nan)
    again.on_before_optimizer_step(None, module, optimizer)
    optimizer.step()
    assert torch.equal(parameter.detach(), torch.ones(2))
    with pytest.raises(InputError, match="exploding"):
        for _ in range(3):
            parameter.grad = torch.full((2,), math.inf)
            again.on_before_optimizer_step(None, module, optimizer)


@pytest.mark.parametrize(
    "make",
    [
        lambda: LengthCurriculum(60, 20),
        lambda: LengthCurriculum(20, 60, 40, 20),
        lambda: AdaptiveLossWeights(w_max=0.5),
        lambda: GnssDecimation(5, 2),
        lambda: OutageInjection(30, 10),
        lambda: StepGuard(factor=0.5),
    ],
)
def test_settings_that_make_no_sense(make):
    with pytest.raises(InputError):
        make()
