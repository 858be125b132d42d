"""Training strategy without a Trainer: curriculum, weights, decimation, outages, guard; all resume from state."""

import copy
import math
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import torch.optim.lr_scheduler as schedules

from dlkf.base.errors import InputError
from dlkf.training.callbacks.curriculum import LengthCurriculum
from dlkf.training.callbacks.guard import StepGuard
from dlkf.training.callbacks.history import LossHistory, read_losses
from dlkf.training.callbacks.loss_weights import AdaptiveLossWeights
from dlkf.training.callbacks.masking import GnssDecimation, OutageInjection, SensorLoss
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


def test_callbacks_hand_their_rules_to_the_module():
    module, masks = SimpleNamespace(transforms=[], loss_weights=None), [GnssDecimation(), OutageInjection()]
    for callback in (*masks, weights := AdaptiveLossWeights()):
        callback.setup(None, module, "validate")
        callback.setup(None, module, "fit")
    assert module.transforms == [mask.transform for mask in masks] and module.loss_weights == weights.weights


def test_weights_are_large_early_and_fall_with_the_position_loss():
    """R065, R066: unweighted pilot, then position loss over the pilot's velocity and attitude losses, within bounds."""
    weights = AdaptiveLossWeights(pilot_epochs=2, w_max=10, memory=0.5)
    ones = {"position": 1.0, "velocity": 1.0, "attitude": 1.0}
    assert weights.weights() == ones and weights.update({"position": 8.0, "velocity": 2.0, "attitude": 0.1}) == ones
    first = weights.update({"position": 8.0, "velocity": 2.0, "attitude": 0.1})
    assert first == {"position": 1.0, "velocity": 4.0, "attitude": 10.0}
    seen = [weights.update({"position": p, "velocity": 1.0, "attitude": 0.05}) for p in (4.0, 2.0, 1.0, 0.5, 0.2, 0.1)]
    fell = [w["velocity"] for w in seen]
    assert fell == sorted(fell, reverse=True) and fell[0] < 4.0 and fell[-1] < 0.5
    again = AdaptiveLossWeights(pilot_epochs=2, w_max=10, memory=0.5)
    again.load_state_dict(weights.state_dict())
    assert again.weights() == weights.weights()


def test_weights_ignore_a_diverged_epoch():
    weights = AdaptiveLossWeights()
    before = weights.update({"position": 4.0, "velocity": 2.0, "attitude": 1.0})
    assert weights.update({"position": math.inf, "velocity": math.nan, "attitude": math.inf}) == before


def test_a_loss_of_one_s_own_may_leave_terms_out():
    weights = AdaptiveLossWeights()
    for value in (8.0, 4.0):
        weights.on_train_epoch_end(SimpleNamespace(callback_metrics={"train/position_loss": torch.tensor(value)}), None)
    assert weights.weights() == {"position": 1.0, "velocity": 1.0, "attitude": 1.0}


@pytest.mark.parametrize("epoch_s", [0.5, 0.2])
def test_decimation_counts_seconds_where_epochs_are_shorter(epoch_s):
    batch = scene(1, 40)
    batch = replace(batch, dt=epoch_s / batch.size[2])
    at = GnssDecimation((2, 2)).transform(batch, 0, generator()).available[0].nonzero().flatten() + 1
    assert (at * epoch_s).tolist() == pytest.approx([2.0 * (k + 1) for k in range(len(at))])


def test_decimation_keeps_every_nth_fix_per_segment():
    batch = scene(200, 60)
    kept = GnssDecimation((2, 5)).transform(batch, 0, generator()).available
    intervals = set()
    for row in kept:
        at = (row.nonzero().flatten() + 1).tolist()
        gaps = {b - a for a, b in pairwise(at)}
        assert len(gaps) == 1 and at[0] == next(iter(gaps))
        intervals |= gaps
    assert intervals == {2, 3, 4, 5}
    assert GnssDecimation((2, 5), start_epoch=3).transform(batch, 2, generator()) is batch


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


def stepped(guard: StepGuard, parameter: torch.nn.Parameter, gradient: float, optimizer=None, schedule=None) -> None:
    """One optimiser step through the guard."""
    module = torch.nn.Module()
    module.weight, module.log = parameter, lambda *a, **k: None
    optimizer = optimizer or torch.optim.SGD([parameter], lr=1.0)
    parameter.grad = torch.full((2,), gradient)
    configs = [] if schedule is None else [SimpleNamespace(scheduler=schedule)]
    guard.on_before_optimizer_step(SimpleNamespace(lr_scheduler_configs=configs), module, optimizer)
    optimizer.step()


def test_guard_takes_large_steps_and_skips_those_that_are_not_finite():
    """Clipping tames a large gradient; skipping it could go on for ever, as the weights would not move (R077)."""
    guard, parameter = StepGuard(patience=3), torch.nn.Parameter(torch.ones(2))
    stepped(guard, parameter, 1e6)
    assert guard.skipped == 0 and float(parameter[0].detach()) == pytest.approx(1 - 1e6)
    before = parameter.detach().clone()
    stepped(guard, parameter, math.nan)
    stepped(guard, parameter, math.inf)
    assert torch.equal(parameter.detach(), before) and guard.skipped == guard.in_a_row == 2
    stepped(guard, parameter, 1.0)
    assert guard.in_a_row == 0 and not torch.equal(parameter.detach(), before)


def test_guard_goes_back_to_the_last_good_epoch_and_gives_up_at_last():
    guard, parameter = StepGuard(patience=2, slower=0.5, returns=2), torch.nn.Parameter(torch.ones(2))
    module = torch.nn.Module()
    module.weight = parameter
    guard.on_train_epoch_end(None, module)
    stepped(guard, parameter, 3.0)
    for _ in range(2):
        stepped(guard, parameter, math.nan)
    assert torch.equal(parameter.detach(), torch.ones(2))
    again = StepGuard(patience=2, slower=0.5, returns=2)
    again.load_state_dict(guard.state_dict())
    assert (again.skipped, again.returned) == (2, 1)
    with pytest.raises(InputError, match="non-finite"):
        for _ in range(4):
            stepped(guard, parameter, math.nan)
    fresh = StepGuard(patience=2)
    with pytest.raises(InputError, match="first epoch"):
        for _ in range(2):
            stepped(fresh, parameter, math.nan)


def warm_up(optimizer):
    parts = [schedules.LinearLR(optimizer, 0.1, total_iters=3), schedules.CosineAnnealingLR(optimizer, 12)]
    return schedules.SequentialLR(optimizer, parts, [3])


@pytest.mark.parametrize(
    "plan",
    [
        lambda o: schedules.ExponentialLR(o, 0.9),
        lambda o: schedules.StepLR(o, 4),
        lambda o: schedules.LambdaLR(o, lambda epoch: 1 / (1 + epoch)),
        lambda o: schedules.CosineAnnealingLR(o, 12, eta_min=0.1),
        lambda o: schedules.CosineAnnealingWarmRestarts(o, 5, eta_min=0.1),
        lambda o: schedules.OneCycleLR(o, 1.0, total_steps=20, cycle_momentum=False),
        warm_up,
    ],
)
@pytest.mark.filterwarnings("ignore:The epoch parameter in `scheduler.step")
def test_a_return_of_the_guard_scales_all_further_rates_once(plan):
    """After two returns the rates are a quarter of the schedule's in every epoch, also through a checkpoint."""

    def make():
        parameter = torch.nn.Parameter(torch.ones(2))
        optimizer = torch.optim.SGD([{"params": [parameter], "lr": 1.0}])
        return parameter, optimizer, plan(optimizer)

    def rates(returns, resumed):
        guard, (parameter, optimizer, schedule) = StepGuard(patience=1, slower=0.5, returns=9), make()
        module = torch.nn.Module()
        module.weight, out = parameter, []
        for epoch in range(12):
            if epoch == resumed:
                states = optimizer.state_dict(), schedule.state_dict(), guard.state_dict()
                guard, (parameter, optimizer, schedule) = StepGuard(patience=1, slower=0.5), make()
                for part, state in zip((optimizer, schedule, guard), copy.deepcopy(states)):
                    part.load_state_dict(state)
                module.weight = parameter
                guard.on_train_start(SimpleNamespace(current_epoch=epoch), module)
            out.append(optimizer.param_groups[0]["lr"])
            stepped(guard, parameter, math.nan if epoch in returns else 0.0, optimizer, schedule)
            guard.on_train_epoch_end(None, module)
            schedule.step()
        return np.array(out)

    plain = rates((), None)
    expected = plain * np.repeat([1.0, 0.5, 0.25], [3, 3, 6])
    for resumed in (None, 4, 5, 9):
        assert np.allclose(rates((2, 5), resumed), expected, rtol=1e-12)


@pytest.mark.parametrize("losses", [(4.0, 1.0, 2.0, 100.0, math.nan), (-1.0, -2.0, -1.5, 100.0, math.nan)])
def test_guard_does_not_go_back_to_weights_that_have_diverged_already(losses):
    """Finite weights whose loss has risen a hundredfold are no place to go back to; a loss near the least is, also of
    a likelihood, which may be negative."""
    guard, parameter = StepGuard(patience=1, slower=0.5, returns=2), torch.nn.Parameter(torch.ones(2))
    module = torch.nn.Module()
    module.weight = parameter
    for weight, loss in enumerate(losses, 1):
        parameter.data.fill_(weight)
        for _ in range(2):
            guard.on_train_batch_end(None, module, {"loss": torch.tensor(loss)}, None, 0)
        guard.on_train_epoch_end(None, module)
    again = StepGuard(patience=1)
    again.load_state_dict(guard.state_dict())
    assert again.least == losses[1]
    stepped(guard, parameter, math.nan)
    assert float(parameter[0].detach()) == 3.0


@pytest.mark.parametrize(
    "make",
    [
        lambda: LengthCurriculum(60, 20),
        lambda: LengthCurriculum(20, 60, 40, 20),
        lambda: AdaptiveLossWeights(w_max=0.5),
        lambda: GnssDecimation((5, 2)),
        lambda: OutageInjection((30, 10)),
        lambda: StepGuard(slower=2.0),
    ],
)
def test_settings_that_make_no_sense(make):
    with pytest.raises(InputError):
        make()


def test_a_third_of_the_segments_lacks_a_sensor_and_a_third_loses_it():
    """Rows are whole, gone from a moment on, or gone; GNSS stays; the shares are those asked for."""
    batch = scene(1, 20)
    batch = batch.select(torch.zeros(3000, dtype=torch.long))
    assert SensorLoss().transform(batch, 0, generator()) is batch
    speed = torch.ones(*batch.size[:2], 5)
    blanked = SensorLoss().transform(replace(batch, aids={"speed": speed}), 0, generator())
    rows = blanked.aids["speed"]
    there = rows.all(-1).sum(1)
    assert torch.equal(rows, ((torch.arange(20) < there[:, None])[..., None]).expand_as(rows).float())
    shares = [float((there == k).float().mean()) for k in (0, 20)]
    assert shares == pytest.approx([1 / 3, 1 / 3 + 1 / 60], abs=0.03) and blanked.available is batch.available
    assert there[(there > 0) & (there < 20)].float().mean() == pytest.approx(10.0, abs=0.5)
    with pytest.raises(InputError, match="sensor_loss"):
        SensorLoss(0.8, 0.3)


def test_losses_go_on_where_a_training_was_killed(tmp_path):
    """Validation every second epoch; epoch 3 comes twice, since it was written and then lost."""

    def epochs(first, last):
        history = LossHistory(str(tmp_path))
        trainer = SimpleNamespace(is_global_zero=True, current_epoch=first, callback_metrics={})
        history.on_train_start(trainer, None)
        for trainer.current_epoch in range(first, last):
            trainer.callback_metrics["train/loss"] = torch.tensor(10.0 * first + trainer.current_epoch)
            if trainer.current_epoch % 2:
                trainer.callback_metrics["val/loss"] = torch.tensor(7.0)
                history.on_validation_end(trainer, None)
            history.on_train_epoch_end(trainer, None)
        return read_losses(tmp_path)

    assert read_losses(tmp_path) == {}
    epochs(0, 3)
    found = epochs(2, 4)
    assert found["epoch"] == [1, 2, 3, 4] and found["train/loss"] == [0, 1, 22, 23]
    assert [math.isnan(x) for x in found["val/loss"]] == [True, False, True, False]
    assert epochs(0, 1)["epoch"] == [1]
