"""The paper's CNN-LSTM (R035–R049) and its relatives (R050, R052): convolutions, recurrent cells, dense layers."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from dlkf.base.errors import InputError
from dlkf.networks.features import CNN_CHANNELS, COMPONENTS
from dlkf.networks.products import EpochLinear, EpochLSTMCell, GRUCell, begin_batch

CELLS = {"lstm": EpochLSTMCell, "gru": GRUCell}


@dataclass(frozen=True)
class NetworkConfig:
    """Sizes of the network; the defaults are the paper's. ``samples`` and ``flags`` are set by the filter.

    ``fusion``: ``concat`` feeds CNN output and components to the recurrent cells side by side; ``strict30`` squeezes
    them into the 30 inputs that the paper names (paper.md 4.1). ``flags`` further inputs are appended.
    ``window=False`` leaves out the CNN, ``cell`` is ``lstm``, ``gru`` or ``none`` (dense layers alone; R052).

    ``init``: ``plain`` is torch's own; a fresh network of the paper's depth then hands on a thousandth of what it
    sees, and training makes a constant of it. ``responsive`` keeps the variance from layer to layer: Kaiming
    convolutions and dense layers, orthogonal input weights with gain 2. ``conv_activation`` puts the paper's
    LeakyReLU behind the last convolution too, where it cuts off half of the one channel.
    """

    samples: int | None = None
    window: bool = True
    cnn_channels: int = 32
    kernel: int = 3
    cell: Literal["lstm", "gru", "none"] = "lstm"
    lstm_hidden: int = 256
    lstm_layers: int = 4
    dense: tuple[int, ...] = (512, 256)
    dropout: float = 0.5
    fusion: Literal["concat", "strict30"] = "concat"
    leaky_slope: float = 0.01
    init: Literal["plain", "responsive"] = "plain"
    conv_activation: bool = True
    flags: int = 0

    def __post_init__(self) -> None:
        if self.kernel % 2 == 0:
            raise InputError(f"model.network.kernel is {self.kernel}; it must be odd to keep the window's length")
        if min(self.samples or 1, self.cnn_channels, self.lstm_hidden, self.lstm_layers, *self.dense) < 1:
            raise InputError("model.network: every size must be at least 1")
        if not 0 <= self.dropout < 1:
            raise InputError(f"model.network.dropout is {self.dropout}; it must be in [0, 1)")

    def build(self) -> CnnLstm:
        """The network."""
        return CnnLstm(self)

    def as_dict(self) -> dict[str, Any]:
        """Plain values for a file; ``flags`` follow from the filter's mode."""
        values = asdict(self) | {"dense": list(self.dense)}
        return {k: v for k, v in values.items() if k != "flags"}


Recurrent = tuple[Tensor, ...]  # each (layers, B, hidden); h and c of LSTM cells, h of GRU cells, empty without cells


class Convolution(nn.Conv1d):
    """Over time; in training as one over pictures a pixel high, for which torch takes samples as they lie."""

    def forward(self, input: Float[Tensor, "B C M"]) -> Float[Tensor, "B N M"]:
        """``torch.nn.Conv1d``."""
        if not torch.is_grad_enabled():
            return super().forward(input)
        picture, weight = input.unsqueeze(2), self.weight.unsqueeze(2)
        return nn.functional.conv2d(picture, weight, self.bias, padding=(0, int(self.padding[0]))).squeeze(2)


class CnnLstm(nn.Module):
    """Window (B, 15, M) and components (B, 30 + flags) to a feature vector (B, width), with memory."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.width = config.dense[-1]
        pad, slope = config.kernel // 2, config.leaky_slope
        layers: list[nn.Module] = []
        if config.window:
            layers = [
                Convolution(CNN_CHANNELS, config.cnn_channels, config.kernel, padding=pad),
                nn.LeakyReLU(slope),
                Convolution(config.cnn_channels, 1, config.kernel, padding=pad),
                *([nn.LeakyReLU(slope)] if config.conv_activation else []),
            ]
        self.cnn = nn.Sequential(*layers)
        size = (config.samples or 0 if config.window else 0) + COMPONENTS + config.flags
        self.squeeze: nn.Module = nn.Identity()
        if config.fusion == "strict30":
            self.squeeze, size = EpochLinear(size, COMPONENTS), COMPONENTS
        cells = []
        for _ in range(config.lstm_layers if config.cell != "none" else 0):
            cells.append(CELLS[config.cell](size, config.lstm_hidden))
            size = config.lstm_hidden
        self.lstm = nn.ModuleList(cells)
        layers = []
        for i, out in enumerate(config.dense):
            if i:
                layers.append(nn.Dropout(config.dropout))
            layers += [EpochLinear(size, out), nn.LeakyReLU(slope)]
            size = out
        self.dense = nn.Sequential(*layers)
        self._initialise()

    def _initialise(self) -> None:
        """Orthogonal recurrent weights and an LSTM forget-gate bias of 1 (paper.md 4.13); see ``init``."""
        hidden = self.config.lstm_hidden
        responsive = self.config.init == "responsive"
        gates = {"lstm": 4, "gru": 3, "none": 1}[self.config.cell]
        for name, parameter in self.lstm.named_parameters():
            if name.endswith("weight_hh") or (responsive and name.endswith("weight_ih")):
                for gate in parameter.data.chunk(gates):
                    nn.init.orthogonal_(gate, gain=1.0 if name.endswith("weight_hh") else 2.0)
            elif name.endswith(("bias_ih", "bias_hh")):
                nn.init.zeros_(parameter)
                if name.endswith("bias_ih") and self.config.cell == "lstm":
                    parameter.data[hidden : 2 * hidden] = 1.0
        if responsive:
            for layer in (*self.cnn, *self.dense):
                if isinstance(layer, (nn.Conv1d, nn.Linear)):
                    nn.init.kaiming_normal_(layer.weight, self.config.leaky_slope, nonlinearity="leaky_relu")
                    if layer.bias is not None:
                        nn.init.zeros_(layer.bias)

    def start(self, batch_size: int, like: Tensor) -> Recurrent:
        """Empty memory."""
        begin_batch(self)
        zeros = like.new_zeros(self.config.lstm_layers, batch_size, self.config.lstm_hidden)
        return (zeros,) * {"lstm": 2, "gru": 1, "none": 0}[self.config.cell]

    def forward(
        self, window: Float[Tensor, "B 15 M"], components: Float[Tensor, "B C"], memory: Recurrent
    ) -> tuple[Float[Tensor, "B D"], Recurrent]:
        """One epoch."""
        seen = (self.cnn(window).squeeze(1), components) if self.config.window else (components,)
        y = self.squeeze(torch.cat(seen, -1))
        after = []
        for layer, old in zip(self.lstm, zip(*memory)):
            new = (layer(y, old[0]),) if self.config.cell == "gru" else layer(y, old)
            y = new[0]
            after.append(new)
        return self.dense(y), tuple(torch.stack(x) for x in zip(*after))
