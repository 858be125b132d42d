"""What moves the weights: AdamW and cosine annealing with restarts, or an optimizer and a schedule of one's own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import CosineAnnealingWarmRestarts

from dlkf.base.classes import TARGET, find_class, instantiate
from dlkf.base.settings import Ranged, bounded_field, settings_from

MANY = 10**9
OPTIMIZER, SCHEDULER = ("step", "zero_grad", "state_dict"), ("step", "state_dict")  # their methods


@dataclass(frozen=True)
class OptimizerSettings(Ranged, where="optimizer", least=0, greatest=1e3):
    """AdamW; the output layers learn at ``head_lr_factor`` times the rate."""

    lr: float
    head_lr_factor: float
    weight_decay: float


@dataclass(frozen=True)
class SchedulerSettings(Ranged, where="scheduler"):
    """Cosine annealing with warm restarts (R073), in epochs."""

    restart_epochs: int = bounded_field(100, 1, MANY)
    restart_factor: int = bounded_field(1, 1, 1000)
    lr_min: float = bounded_field(1e-5, 0, 1e3)


@dataclass(frozen=True)
class OptimizationPlan:
    """Both, as plain values were read; ``own_*`` are the settings beside a ``_target_``, None where there is none."""

    optimizer: OptimizerSettings
    scheduler: SchedulerSettings
    own_optimizer: Mapping[str, Any] | None = None
    own_scheduler: Mapping[str, Any] | None = None

    @classmethod
    def of(cls, optimizer: Mapping[str, Any], scheduler: Mapping[str, Any]) -> OptimizationPlan:
        """From plain values. InputError for an unknown key, or a class that is not there."""
        ours, own_optimizer = _split_settings(OptimizerSettings, optimizer, "optimizer", OPTIMIZER)
        law, own_scheduler = _split_settings(SchedulerSettings, scheduler, "scheduler", SCHEDULER)
        return cls(ours, law, own_optimizer, own_scheduler)

    def build(self, body: Sequence[nn.Parameter], heads: Sequence[nn.Parameter]) -> tuple[Optimizer, Any]:
        """Optimizer and schedule of a step an epoch (R073; paper.md 4.13).

        An optimizer of one's own gets two groups of parameters with their rates and what of ``lr`` and ``weight_decay``
        it takes, a schedule the optimizer. InputError for settings that they do not take.
        """
        o, s = self.optimizer, self.scheduler
        groups = [{"params": list(body), "lr": o.lr}, {"params": list(heads), "lr": o.lr * o.head_lr_factor}]
        if self.own_optimizer is None:
            optimizer: Optimizer = torch.optim.AdamW(groups, weight_decay=o.weight_decay)
        else:
            optimizer = instantiate(
                self.own_optimizer, "optimizer", OPTIMIZER, offered={"params": groups}, spare=_names(o)
            )
        if self.own_scheduler is None:
            return optimizer, CosineAnnealingWarmRestarts(
                optimizer, T_0=s.restart_epochs, T_mult=s.restart_factor, eta_min=s.lr_min
            )
        return optimizer, instantiate(
            self.own_scheduler, "scheduler", SCHEDULER, offered={"optimizer": optimizer}, spare=_names(s)
        )


def _names(settings: Any) -> set[str]:
    return {f.name for f in fields(settings)}


def _split_settings(
    kind: type[Any], values: Mapping[str, Any], where: str, needs: Sequence[str]
) -> tuple[Any, Mapping[str, Any] | None]:
    """Our settings, and all of them where a class of one's own is named."""
    if not values.get(TARGET):
        return settings_from(kind, values, where), None
    find_class(str(values[TARGET]), f"{where}.{TARGET}", needs)
    known = {k: v for k, v in values.items() if k in _names(kind)}
    return settings_from(kind, known, where), values
