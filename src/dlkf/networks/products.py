"""Products of a layer that runs at every epoch of a batch: y = x Wᵀ + b, fast to differentiate.

Backpropagation through T epochs asks for ∂W = Σₜ gₜᵀ xₜ, which autograd makes as T products of a few rows each and as
many sums of matrices of a megabyte. Here an epoch keeps (xₜ, gₜ), and once all have been through, ∂W = gᵀ x is one
product over all rows. Where torch has oneDNN, products on a CPU go through it: MKL leaves half of the vector width of
AMD's processors alone.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import linear

ONEDNN = torch.backends.mkldnn.is_available() and hasattr(torch.ops.mkldnn, "_linear_pointwise")


class EpochProduct:
    """y = x Wᵀ + b through the epochs of one batch, its gradient in W and b collected over them.

    The same values and gradients as ``torch.nn.functional.linear`` but for rounding.
    """

    def __init__(self, weight: Float[Tensor, "N K"], bias: Float[Tensor, " N"]) -> None:
        self._seen: list[tuple[Tensor, Tensor]] = []  # (x, g) of the epochs whose gradient has come back
        self._weight, self._bias = _Collecting.apply(weight, bias, self._seen)

    def __call__(self, x: Float[Tensor, "B K"]) -> Float[Tensor, "B N"]:
        return _Product.apply(x, self._weight, self._bias, self._seen)


class EpochLayers:
    """The products of a network's linear layers and LSTM cells in the batch at hand; forgotten when a batch begins."""

    def __init__(self) -> None:
        self._products: dict[nn.Module, EpochProduct] = {}

    def begin(self) -> None:
        """A new batch: weights may have changed."""
        self._products.clear()

    def linear(self, layer: nn.Linear, x: Float[Tensor, "B K"]) -> Float[Tensor, "B N"]:
        """A dense layer."""
        if layer not in self._products:
            self._products[layer] = EpochProduct(layer.weight, layer.bias)
        return self._products[layer](x)

    def lstm(self, cell: nn.LSTMCell, x: Float[Tensor, "B K"], memory: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
        """h and c after an epoch: all gates in one product of (x, h) (Hochreiter and Schmidhuber 1997)."""
        if cell not in self._products:
            both = torch.cat((cell.weight_ih, cell.weight_hh), 1)
            self._products[cell] = EpochProduct(both, cell.bias_ih + cell.bias_hh)
        h, c = memory
        i, f, g, o = self._products[cell](torch.cat((x, h), 1)).chunk(4, 1)
        c = torch.sigmoid(f) * c + torch.sigmoid(i) * torch.tanh(g)
        return torch.sigmoid(o) * torch.tanh(c), c

    def __deepcopy__(self, memo: dict) -> EpochLayers:
        return EpochLayers()


def _product(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """x Wᵀ + b, in float32 on a CPU by oneDNN, through the operation that torch.compile uses for it."""
    if ONEDNN and x.device.type == "cpu" and x.dtype == torch.float32:
        return torch.ops.mkldnn._linear_pointwise(x, weight, bias, "none", [], "")
    return linear(x, weight, bias)


class _Product(torch.autograd.Function):
    """One epoch's product; tells the gradient of its input only."""

    @staticmethod
    def forward(ctx, x, weight, bias, seen):
        ctx.save_for_backward(x, weight)
        ctx.seen = seen
        return _product(x, weight, bias)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, g):
        x, weight = ctx.saved_tensors
        ctx.seen.append((x, g))
        return _product(g, weight.mT), None, None, None


class _Collecting(torch.autograd.Function):
    """Weight and bias as they are; autograd comes back here after the last epoch, and finds the gradient complete."""

    @staticmethod
    def forward(ctx, weight, bias, seen):
        ctx.seen = seen
        ctx.set_materialize_grads(False)
        return weight.view_as(weight), bias.view_as(bias)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *_):
        x, g = (torch.cat(rows) for rows in zip(*ctx.seen))
        ctx.seen.clear()
        return _product(g.mT, x.mT), g.sum(0), None
