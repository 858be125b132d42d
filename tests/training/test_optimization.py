"""An optimizer and a schedule of a user's own, by their names, beside the settings of the preset."""

import pytest
import torch

from dlkf.base.errors import InputError
from dlkf.training.optimization import OptimizationPlan

ADAMW = {"lr": 1e-3, "head_lr_factor": 0.3, "weight_decay": 1e-4}
COSINE = {"restart_epochs": 10, "restart_factor": 1, "lr_min": 1e-5}


def built(optimizer=ADAMW, scheduler=COSINE):
    body, heads = (torch.nn.Parameter(torch.ones(2)) for _ in range(2))
    return OptimizationPlan.of(optimizer, scheduler).build([body], [heads])


def test_without_a_name_it_is_adamw_with_cosine_restarts():
    optimizer, schedule = built()
    assert type(optimizer) is torch.optim.AdamW
    assert [group["lr"] for group in optimizer.param_groups] == [1e-3, 0.3e-3]
    assert type(schedule) is torch.optim.lr_scheduler.CosineAnnealingWarmRestarts and schedule.T_0 == 10


def test_own_classes_get_the_groups_their_settings_and_what_they_take_of_ours():
    optimizer, schedule = built(
        {**ADAMW, "_target_": "torch.optim.SGD", "momentum": 0.9},
        {**COSINE, "_target_": "torch.optim.lr_scheduler.StepLR", "step_size": 1, "gamma": 0.5},
    )
    assert type(optimizer) is torch.optim.SGD
    for group, rate in zip(optimizer.param_groups, (1e-3, 0.3e-3), strict=True):
        assert (group["lr"], group["momentum"], group["weight_decay"]) == (rate, 0.9, 1e-4)
    optimizer.step()
    schedule.step()
    assert [group["lr"] for group in optimizer.param_groups] == [0.5e-3, 0.15e-3]


@pytest.mark.parametrize(
    ("optimizer", "said"),
    [
        ({**ADAMW, "momentum": 0.9}, "optimizer: unknown key momentum"),
        ({**ADAMW, "_target_": "torch.optim.Nothing"}, "optimizer._target_=torch.optim.Nothing"),
        ({**ADAMW, "_target_": "torch.optim.SGD", "speed": 1.0}, "takes no speed"),
    ],
)
def test_what_is_not_there_is_refused(optimizer, said):
    with pytest.raises(InputError, match=said):
        built(optimizer)
