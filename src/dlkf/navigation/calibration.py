"""The IMU error that a filter corrects: biases, and where estimated the sensor matrices and the g-sensitivity."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from dlkf.navigation.state import ErrorStates


class ImuError(NamedTuple):
    """Bias (B, 6), accelerometers then gyroscopes, and M of measured = (I + M) true + bias.

    ``matrix`` is None for M = 0, (B, 6) for scale factors only, (B, 2, 3, 3) for all elements of both sensors.
    ``g_sensitivity`` (B, 3, 2) is the rate that the gyroscopes show of the specific force forward and right, or None.
    """

    bias: Tensor
    matrix: Tensor | None = None
    g_sensitivity: Tensor | None = None

    @classmethod
    def of(cls, error: Tensor | ImuError) -> ImuError:
        """Of an estimator's answer: biases (B, 6) alone, or all of it."""
        return error if isinstance(error, ImuError) else cls(error)

    def correct(self, raw: Float[Tensor, "B M 6"]) -> Float[Tensor, "B M 6"]:
        """The samples without the error: (I + M)⁻¹ (raw − bias), the rates of these less G f."""
        samples = self._correct_linear(raw)
        if self.g_sensitivity is None:
            return samples
        force, rate = samples.split(3, -1)
        return torch.cat((force, rate - torch.bmm(force[..., :2], self.g_sensitivity.mT)), -1)

    def _correct_linear(self, raw: Float[Tensor, "B M 6"]) -> Float[Tensor, "B M 6"]:
        """(I + M)⁻¹ (raw − bias)."""
        if self.matrix is not None and self.matrix.ndim == 4:
            if torch.is_grad_enabled() and not raw.requires_grad and self.matrix.requires_grad:
                return _Correction.apply(raw, self.bias, self.matrix)
            return _correct(raw, self.bias, self.matrix)[0]
        samples = raw - self.bias.unsqueeze(1)
        return samples if self.matrix is None else samples / (1 + self.matrix).unsqueeze(1)

    def update(self, dx: Float[Tensor, "B n"], states: ErrorStates) -> ImuError:
        """The error after a correction of a filter's states: columns 9… of ``dx``."""
        bias = self.bias + dx[:, 9:15]
        if states.matrix == "none":
            return self._replace(bias=bias)
        if states.matrix == "scale":
            change = dx[:, states.of_matrix]
        else:
            change = torch.index_select(dx, 1, _index_by_rows(states, dx.device)).unflatten(-1, (2, 3, 3))
        return self._replace(bias=bias, matrix=change if self.matrix is None else self.matrix + change)

    def elements(self, states: ErrorStates) -> Float[Tensor, "*b k"]:
        """The estimated elements of both sensor matrices, in the order of their states."""
        if self.matrix is None or not states.elements:
            return self.bias.new_zeros(*self.bias.shape[:-1], 2 * len(states.elements))
        if states.matrix == "scale":
            return self.matrix
        rows, columns = (list(x) for x in zip(*states.elements))
        return self.matrix[..., rows, columns].flatten(-2)

    def at(self, mean: Float[Tensor, "B 6"]) -> Float[Tensor, "B 6"]:
        """Complete error of samples whose corrected mean is ``mean``: bias + M · mean, of
        gyroscopes bias + G f + M · (mean + G f)."""
        error = self.bias
        if self.g_sensitivity is not None:
            shown = torch.bmm(self.g_sensitivity, mean[:, :2].unsqueeze(-1)).squeeze(-1)
            shown = torch.cat((torch.zeros_like(shown), shown), -1)
            error, mean = error + shown, mean + shown
        if self.matrix is None:
            return error
        if self.matrix.ndim == 2:
            return error + self.matrix * mean
        return error + (self.matrix @ mean.unflatten(-1, (2, 3)).unsqueeze(-1)).flatten(1)


@lru_cache
@torch.inference_mode(False)
def _index_by_rows(states: ErrorStates, device: torch.device) -> Tensor:
    """Which states the elements of both full matrices are, row by row."""
    place = {element: k for k, element in enumerate(states.elements)}
    one = [states.of_matrix.start + place[i, j] for i in range(3) for j in range(3)]
    return torch.tensor([*one, *(k + len(place) for k in one)], device=device)


def _correct(raw: Float[Tensor, "B M 6"], bias: Float[Tensor, "B 6"], matrix: Tensor) -> tuple[Tensor, Tensor]:
    """y = U (raw − bias) and U = (I + M)⁻¹ (B, 2, 3, 3)."""
    U = torch.linalg.inv_ex(torch.eye(3, dtype=raw.dtype, device=raw.device) + matrix)[0]
    return _multiply_by_sensor(raw - bias.unsqueeze(1), U.mT), U


def _multiply_by_sensor(samples: Float[Tensor, "B M 6"], matrices: Float[Tensor, "B 2 3 3"]) -> Float[Tensor, "B M 6"]:
    """Each sensor's samples, as rows, times its matrix."""
    return torch.cat((torch.bmm(samples[..., :3], matrices[:, 0]), torch.bmm(samples[..., 3:], matrices[:, 1])), -1)


class _Correction(torch.autograd.Function):
    """With its gradient in closed form: a = Uᵀ ∂y of every sample, ∂bias = −Σ a, ∂M = −Σ a yᵀ."""

    @staticmethod
    def forward(ctx, raw, bias, matrix):
        y, U = _correct(raw, bias, matrix)
        ctx.save_for_backward(y, U)
        return y

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, g):
        y, U = ctx.saved_tensors
        a = _multiply_by_sensor(g, U)
        of_both = torch.bmm(a.mT, y)
        return None, -a.sum(1), -torch.stack((of_both[:, :3, :3], of_both[:, 3:, 3:]), 1)
