"""Products whose gradients are collected over the epochs of a batch, against torch's own layers."""

import copy

import pytest
import torch
from torch import nn

from dlkf.networks.cnn_lstm import NetworkConfig
from dlkf.networks.products import EpochLinear, EpochLSTMCell, begin_batch

ROUNDING = 1e-5  # relative to the largest element: sums of a thousand products in float32, in another order


def close(one: torch.Tensor, other: torch.Tensor) -> bool:
    return bool((one - other).abs().max() <= ROUNDING * other.abs().max())


def test_linear_layer_over_epochs_of_different_rows():
    layer, plain = EpochLinear(40, 30), nn.Linear(40, 30)
    plain.load_state_dict(layer.state_dict())
    inputs = [torch.randn(rows, 40) for rows in (7, 1, 50)]
    for _ in range(2):  # two batches: nothing of the first is left in the second
        begin_batch(layer)
        got, expected = ([one(x) for x in inputs] for one in (layer, plain))
        assert all(close(x, y) for x, y in zip(got, expected, strict=True))
        for one, outputs in ((layer, got), (plain, expected)):
            one.zero_grad()
            sum(y.square().sum() for y in outputs).backward()
        assert close(layer.weight.grad, plain.weight.grad)
        assert close(layer.bias.grad, plain.bias.grad)
        with torch.no_grad():
            for one in (layer, plain):
                one.weight.mul_(1.1)


def test_lstm_cell_over_epochs():
    plain, cell = nn.LSTMCell(40, 32), EpochLSTMCell(40, 32)
    cell.load_state_dict(plain.state_dict())
    inputs = torch.randn(20, 7, 40), torch.randn(7, 32), torch.randn(7, 32)

    def through(step) -> tuple[torch.Tensor, list[torch.Tensor]]:
        x, h, c = given = [i.clone().requires_grad_() for i in inputs]
        memory, out = (h, c), []
        for epoch in x:
            memory = step(epoch, memory)
            out.extend(memory)
        total = torch.stack(out)
        total.square().sum().backward()
        return total, [i.grad for i in given]

    (got, of_inputs), (expected, of_plain) = through(cell), through(plain)
    assert close(got, expected)
    assert all(close(x, y) for x, y in zip(of_inputs, of_plain, strict=True))
    for one, other in zip(cell.parameters(), plain.parameters(), strict=True):
        assert close(one.grad, other.grad)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_network_with_and_without_gradients(dtype):
    """Training and inference take different ways through the same network to the same values."""
    torch.manual_seed(1)
    network = NetworkConfig(samples=50, lstm_hidden=32, lstm_layers=2, dense=(24, 16), dropout=0.0).build().to(dtype)
    window, components = torch.randn(5, 15, 50, dtype=dtype), torch.randn(5, 30, dtype=dtype)

    def outputs() -> list[torch.Tensor]:
        memory, out = network.start(5, window), []
        for _ in range(3):
            y, memory = network(window, components, memory)
            out.append(y)
        return out

    learning = outputs()
    with torch.inference_mode():
        plain = outputs()
    assert all(close(one, other) for one, other in zip(learning, plain))


def test_network_can_be_copied_in_the_middle_of_a_batch():
    """The copy goes on as the original does, with weights of its own."""
    network = NetworkConfig(samples=50, lstm_hidden=8, lstm_layers=1, dense=(8,), dropout=0.0).build()
    inputs = torch.randn(2, 15, 50), torch.randn(2, 30)
    _, memory = network(*inputs, network.start(2, torch.zeros(1)))
    copied = copy.deepcopy(network)
    memory = tuple(x.detach() for x in memory)
    outputs = [one(*inputs, memory)[0] for one in (network, copied)]
    assert close(*outputs)
    outputs[1].square().sum().backward()
    assert all(p.grad is None for p in network.parameters())
    outputs[0].square().sum().backward()
    for one, other in zip(network.parameters(), copied.parameters(), strict=True):
        assert close(one.grad, other.grad) and one.data_ptr() != other.data_ptr()
