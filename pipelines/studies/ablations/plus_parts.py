"""``plus`` without one of its parts, for :mod:`pipelines.studies.plus`."""

from __future__ import annotations

from dataclasses import replace

import torch

from dlkf.filters.constraints import CarConstraints
from dlkf.filters.integration import Correction, Epoch, Estimator
from dlkf.filters.plus import PlusConfig, PlusFilter, PlusMemory
from dlkf.filters.shipped import trained_filter


class GaussianPriors(PlusFilter):
    """``plus`` without heavy tails."""

    def __init__(self, config: PlusConfig) -> None:
        super().__init__(config)
        self.kalman = replace(self.kalman, heavy_tails=False)


class ConstraintsAsSet(PlusFilter):
    """``plus`` whose vehicle constraints keep their 1σ."""

    def __init__(self, config: PlusConfig) -> None:
        super().__init__(config)
        kept = (replace(s, adapts_noise=False) if isinstance(s, CarConstraints) else s for s in self.kalman.sources)
        self.kalman = replace(self.kalman, sources=tuple(kept))


class WithoutLevels(PlusFilter):
    """``plus`` whose virtual outages show it nothing."""

    def step(self, memory: PlusMemory, epoch: Epoch) -> tuple[PlusMemory, Correction]:
        """With the levels of the start."""
        outage = memory.outage._replace(evidence=torch.zeros_like(memory.outage.evidence))
        return super().step(memory._replace(outage=outage), epoch)


class WalksAsSet(PlusFilter):
    """``plus`` whose biases walk as far as set, however their corrections are."""

    def step(self, memory: PlusMemory, epoch: Epoch) -> tuple[PlusMemory, Correction]:
        """With no sign in them."""
        steps = memory.steps._replace(total=torch.zeros_like(memory.steps.total))
        return super().step(memory._replace(steps=steps), epoch)


class AsClaimed(PlusFilter):
    """``plus`` that takes all errors of fixes for white noise of the claimed 1σ."""

    def step(self, memory: PlusMemory, epoch: Epoch) -> tuple[PlusMemory, Correction]:
        """With no error that moves, and none that is smaller or larger."""
        one = torch.ones_like(memory.errors.white)
        errors = memory.errors._replace(white=one, walk=0 * one, recent=0 * one)
        fix_noise = memory.fix_noise._replace(variance=torch.ones_like(memory.fix_noise.variance))
        return super().step(memory._replace(errors=errors, fix_noise=fix_noise), epoch)


def parts(folder: str) -> dict[str, Estimator]:
    """``plus`` with neither levels nor network, with one of them, with fixes as claimed, without one of its sources,
    with Gaussian priors, with constraints and with walks of the biases as set."""
    whole = trained_filter(folder)
    assert isinstance(whole, PlusFilter)
    found: dict[str, Estimator] = {}
    kinds = {"neither levels nor network": (WithoutLevels, False), "no network": (PlusFilter, False)}
    kinds["no levels"] = (WithoutLevels, True)
    kinds["fixes as claimed"] = (AsClaimed, True)
    bases = {"no speed from vibration": "+vibration_speed", "no delay and antenna": "+receiver"}
    kinds |= dict.fromkeys(bases, (PlusFilter, True))
    kinds |= {"Gaussian priors": (GaussianPriors, True), "constraints as set": (ConstraintsAsSet, True)}
    kinds["walks as set"] = (WalksAsSet, True)
    for name, (kind, network) in kinds.items():
        config = replace(whole.config, base=whole.config.base.replace(bases.get(name, ""), ""))
        found[name] = part = kind(config).eval()
        part.load_state_dict(whole.state_dict())
        if not network:
            with torch.no_grad():
                for weights in part.network.parameters():
                    weights.zero_()
    return found
