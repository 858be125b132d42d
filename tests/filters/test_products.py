"""Products whose gradients are collected over the epochs of a batch, against torch's own layers."""

import copy

import pytest
import torch
from torch import nn

from dlkf.networks.cnn_lstm import NetworkConfig
from dlkf.networks.products import EpochLayers

ROUNDING = 1e-5  # relative to the largest element: sums of a thousand products in float32, in another order


def close(one: torch.Tensor, other: torch.Tensor) -> bool:
    return bool((one - other).abs().max() <= ROUNDING * other.abs().max())


def test_linear_layer_over_epochs_of_different_rows():
    layer, plain = nn.Linear(40, 30), nn.Linear(40, 30)
    plain.load_state_dict(layer.state_dict())
    layers, inputs = EpochLayers(), [torch.randn(rows, 40) for rows in (7, 1, 50)]
    for _ in range(2):  # two batches: nothing of the first is left in the second
        layers.begin()
        total = sum((layers.linear(layer, x) * x[:, :30]).sum() for x in inputs)
        expected = sum((plain(x) * x[:, :30]).sum() for x in inputs)
        for one, value in ((layer, total), (plain, expected)):
            one.zero_grad()
            value.backward()
        assert close(total, expected)
        assert close(layer.weight.grad, plain.weight.grad)
        assert close(layer.bias.grad, plain.bias.grad)


def test_lstm_cell_over_epochs():
    cell = nn.LSTMCell(40, 32)
    plain = copy.deepcopy(cell)
    x = torch.randn(20, 7, 40)

    def through(step) -> torch.Tensor:
        memory, out = (torch.zeros(7, 32), torch.zeros(7, 32)), []
        for epoch in x:
            memory = step(epoch, memory)
            out.append(memory[0])
        return torch.stack(out)

    layers = EpochLayers()
    got, expected = through(lambda e, m: layers.lstm(cell, e, m)), through(plain)
    assert close(got, expected)
    for value in (got, expected):
        value.square().sum().backward()
    for one, other in zip(cell.parameters(), plain.parameters()):
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
    network = NetworkConfig(samples=50, lstm_hidden=8, lstm_layers=1, dense=(8,)).build()
    network(torch.randn(2, 15, 50), torch.randn(2, 30), network.start(2, torch.zeros(1)))
    copy.deepcopy(network)
