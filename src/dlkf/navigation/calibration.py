"""The IMU error that a filter takes off its samples: biases, and where it knows them the sensor matrices."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from dlkf.navigation.state import ErrorStates


class ImuError(NamedTuple):
    """Bias (B, 6), accelerometers then gyroscopes, and M of measured = (I + M) true + bias.

    ``matrix`` is None for M = 0, (B, 6) for scale factors only, (B, 2, 3, 3) for all elements of both sensors.
    """

    bias: Tensor
    matrix: Tensor | None = None

    @classmethod
    def of(cls, error: Tensor | ImuError) -> ImuError:
        """Of an estimator's answer: biases (B, 6) alone, or all of it."""
        return error if isinstance(error, ImuError) else cls(error)

    def corrected(self, raw: Float[Tensor, "B M 6"]) -> Float[Tensor, "B M 6"]:
        """The samples without the error: (I + M)⁻¹ (raw − bias)."""
        samples = raw - self.bias.unsqueeze(1)
        if self.matrix is None:
            return samples
        if self.matrix.ndim == 2:
            return samples / (1 + self.matrix).unsqueeze(1)
        eye = torch.eye(3, dtype=raw.dtype, device=raw.device)
        undo = torch.linalg.inv_ex(eye + self.matrix)[0].mT
        return torch.cat((torch.bmm(samples[..., :3], undo[:, 0]), torch.bmm(samples[..., 3:], undo[:, 1])), -1)

    def updated(self, dx: Float[Tensor, "B n"], states: ErrorStates) -> ImuError:
        """The error after a correction of a filter's states: columns 9… of ``dx``."""
        bias = self.bias + dx[:, 9:15]
        elements = states.elements
        if not elements:
            return ImuError(bias, self.matrix)
        change = dx[:, states.of_matrix]
        if states.matrix == "scale":
            return ImuError(bias, change if self.matrix is None else self.matrix + change)
        rows, columns = (list(x) for x in zip(*elements))
        matrix = dx.new_zeros(len(dx), 2, 3, 3) if self.matrix is None else self.matrix.clone()
        matrix[:, :, rows, columns] += change.unflatten(-1, (2, -1))
        return ImuError(bias, matrix)

    def at(self, mean: Float[Tensor, "B 6"]) -> Float[Tensor, "B 6"]:
        """Complete error of samples whose corrected mean is ``mean``: bias + M · mean."""
        if self.matrix is None:
            return self.bias
        if self.matrix.ndim == 2:
            return self.bias + self.matrix * mean
        return self.bias + (self.matrix @ mean.unflatten(-1, (2, 3)).unsqueeze(-1)).flatten(1)
