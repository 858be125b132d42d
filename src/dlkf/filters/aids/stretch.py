"""What a filter predicts for the stretch of an update interval that a sensor's measurement is the mean over."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from dlkf.filters.integration import Epoch


def stretch_weights(
    lag_s: Float[Tensor, " B"], span_s: Float[Tensor, " B"], samples: int, dt: float
) -> Float[Tensor, "B m"]:
    """Weights of the values at the ``samples`` + 1 limits of a window's samples, for their mean over a stretch.

    The stretch is ``span_s`` long (at least ``dt``, which makes it the value at one time, linear between the limits)
    and centred ``lag_s`` before the window's end.
    """
    age = dt * torch.arange(samples, -1, -1, dtype=lag_s.dtype, device=lag_s.device)
    half = 0.5 * span_s.clamp_min(dt).unsqueeze(-1)
    centre = lag_s.unsqueeze(-1)
    top = torch.minimum(centre + half, age + 0.5 * dt)
    bottom = torch.maximum(centre - half, age - 0.5 * dt)
    overlap = (top - bottom).clamp_min(0.0)
    return overlap / overlap.sum(-1, keepdim=True).clamp_min(1e-9 * dt)


def stack_limits(before: Float[Tensor, "B ..."], after: Float[Tensor, "B M ..."]) -> Float[Tensor, "B m ..."]:
    """Values at the limits of a window's samples: at its start, then at the end of each sample."""
    return torch.cat((before.unsqueeze(1), after), 1)


def weighted_mean(weights: Float[Tensor, "B m"], values: Float[Tensor, "B m ..."]) -> Float[Tensor, "B ..."]:
    """Their mean."""
    flat = values.reshape(len(values), values.shape[1], -1)
    return torch.bmm(weights.unsqueeze(1), flat).reshape(len(values), *values.shape[2:])


def mean_force(epoch: Epoch) -> Float[Tensor, "B 3"]:
    """Mean specific force of the window in n [m/s²]."""
    T = epoch.span_s
    return (epoch.window.end.v_n - epoch.start.v_n) / T - epoch.window.gravity
