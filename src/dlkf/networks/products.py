"""Layers that run at every epoch of a batch, fast to differentiate: y = x Wᵀ + b.

Backpropagation through T epochs asks for ∂W = Σₜ gₜᵀ xₜ, which autograd makes as T products of a few rows each and as
many sums of matrices of a megabyte. Here an epoch keeps (xₜ, gₜ), and once all have been through, ∂W = gᵀ x is one
product over all rows. Where torch has oneDNN, products on a CPU go through it: MKL leaves half of the vector width of
AMD's processors alone. W is put into oneDNN's own order once a batch, for the way there and the way back.

The layers are torch's own by name and weights, their values are the same but for rounding; without gradients they are
torch's own code.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import linear

from dlkf.navigation.compiled import is_recorded

ONEDNN = torch.backends.mkldnn.is_available() and hasattr(torch.ops.mkldnn, "_linear_pointwise")


class GRUCell(nn.GRUCell):
    """Torch's own, which an export records gate by gate: torch's takes sums in place and has to be recorded twice."""

    def forward(self, input: Float[Tensor, "B K"], hx: Float[Tensor, "B h"]) -> Float[Tensor, "B h"]:
        """r, z = σ(W x + b + U h + c), n = tanh(W x + b + r (U h + c)), h⁺ = n + z (h − n)."""
        if not is_recorded():
            return super().forward(input, hx)
        of_input = linear(input, self.weight_ih, self.bias_ih).chunk(3, -1)
        of_memory = linear(hx, self.weight_hh, self.bias_hh).chunk(3, -1)
        r, z = (torch.sigmoid(x + h) for x, h in zip(of_input[:2], of_memory))
        n = torch.tanh(of_input[2] + r * of_memory[2])
        return n + z * (hx - n)


class EpochProduct:
    """y = x Wᵀ + b through the epochs of one batch, its gradient in W and b collected over them."""

    def __init__(self, weight: Float[Tensor, "N K"], bias: Float[Tensor, " N"]) -> None:
        self.seen: list[tuple[Tensor, Tensor]] = []  # (x, g) of the epochs whose gradient has come back
        self.weight, self.bias = _Collecting.apply(weight, bias, self.seen)
        self.forth, self.back = (_reorder(x.detach()) for x in (weight, weight.mT))

    def multiply(self, x: Float[Tensor, "B K"]) -> Float[Tensor, "B N"]:
        """x Wᵀ + b."""
        return _product(x, self.forth, self.bias.detach())

    def gradient(self, x: Float[Tensor, "B K"], g: Float[Tensor, "B N"]) -> Float[Tensor, "B K"]:
        """g W, the gradient in x; that in W and b is computed once x and g of all epochs are there."""
        self.seen.append((x, g))
        return _product(g, self.back)


class EpochLayer(nn.Module):
    """A layer with the product of the current batch, made when it first runs; :func:`begin_batch` drops it."""

    product: EpochProduct | None = None

    def is_learning(self) -> bool:
        """Whether gradients of the layer's weights are wanted; a compiler has products of its own."""
        if not torch.is_grad_enabled() or torch.compiler.is_compiling():
            return False
        return self.product is not None or all(p.requires_grad for p in self.parameters())

    def __getstate__(self) -> dict:
        """A copy begins without a product: it belongs to the graph of a batch."""
        return {k: v for k, v in self.__dict__.items() if k != "product"}


def begin_batch(network: nn.Module) -> None:
    """A new batch: weights may have changed."""
    for layer in network.modules():
        if isinstance(layer, EpochLayer):
            layer.product = None


class EpochLinear(EpochLayer, nn.Linear):
    """A dense layer."""

    def forward(self, x: Float[Tensor, "B K"]) -> Float[Tensor, "B N"]:
        """``torch.nn.Linear``."""
        if not self.is_learning():
            return super().forward(x)
        self.product = product = self.product or EpochProduct(self.weight, self.bias)
        return _Linear.apply(x, product.weight, product.bias, product)


class EpochLSTMCell(EpochLayer, nn.LSTMCell):
    """A cell whose gates are one product of (x, h) (Hochreiter and Schmidhuber 1997).

    i, f, g, o = σ, σ, tanh, σ of W (x, h) + b;  c' = f c + i g,  h' = o tanh c'
    """

    def forward(self, x: Float[Tensor, "B K"], memory: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        """``torch.nn.LSTMCell``."""
        if not self.is_learning():
            return super().forward(x, memory)
        if self.product is None:
            both = torch.cat((self.weight_ih, self.weight_hh), 1)
            self.product = EpochProduct(both, self.bias_ih + self.bias_hh)
        return _LstmCell.apply(x, *memory, self.product.weight, self.product.bias, self.product)


def _uses_onednn(x: Tensor) -> bool:
    return ONEDNN and x.device.type == "cpu" and x.dtype == torch.float32


def _reorder(weight: Tensor) -> Tensor:
    """A matrix in oneDNN's layout for many products."""
    return torch.ops.mkldnn._reorder_linear_weight(weight) if _uses_onednn(weight) else weight


def _product(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """x Wᵀ + b, by oneDNN through the operation that torch.compile uses for it."""
    if _uses_onednn(x):
        return torch.ops.mkldnn._linear_pointwise.default(x, weight, bias, "none", [], "")
    return linear(x, weight, bias)


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


class _Linear(torch.autograd.Function):
    """An epoch of a dense layer; weight and bias stand for the way to :class:`_Collecting`."""

    @staticmethod
    def forward(ctx, x, weight, bias, product):
        ctx.save_for_backward(x)
        ctx.product = product
        return product.multiply(x)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, g):
        (x,) = ctx.saved_tensors
        return ctx.product.gradient(x, g), None, None, None


class _LstmCell(torch.autograd.Function):
    """An epoch of an LSTM cell, likewise."""

    @staticmethod
    def forward(ctx, x, h, c, weight, bias, product):
        both = torch.cat((x, h), 1)
        i, f, g, o = product.multiply(both).chunk(4, 1)
        i, f, g, o = torch.sigmoid(i), torch.sigmoid(f), torch.tanh(g), torch.sigmoid(o)
        after = torch.addcmul(f * c, i, g)
        swing = torch.tanh(after)
        ctx.save_for_backward(both, c, i, f, g, o, swing)
        ctx.product, ctx.sizes = product, (x.shape[1], h.shape[1])
        return o * swing, after

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, of_h, of_c):
        both, c, i, f, g, o, swing = ctx.saved_tensors
        of_c = torch.addcmul(of_c, of_h * o, 1 - swing * swing)
        gates = of_c * g * (i - i * i), of_c * c * (f - f * f), of_c * i * (1 - g * g), of_h * swing * (o - o * o)
        of_x, of_h = ctx.product.gradient(both, torch.cat(gates, 1)).split(ctx.sizes, 1)
        return of_x, of_h, of_c * f, None, None, None
