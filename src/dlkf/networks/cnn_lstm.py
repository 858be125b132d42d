"""The paper's CNN-LSTM (R035–R049): two convolutions over the window, stacked LSTM, two dense layers."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from dlkf.errors import InputError
from dlkf.networks.features import CNN_CHANNELS, COMPONENTS

FUSIONS = ("concat", "strict30")


@dataclass(frozen=True)
class NetworkConfig:
    """Sizes of the network; the defaults are the paper's.

    ``fusion``: ``concat`` feeds CNN output and components to the LSTM side by side; ``strict30`` squeezes
    them into the 30 inputs that the paper names (paper.md 4.1). ``flags`` further inputs are appended.
    """

    samples: int = 50
    cnn_channels: int = 32
    kernel: int = 3
    lstm_hidden: int = 256
    lstm_layers: int = 4
    dense: tuple[int, ...] = (512, 256)
    dropout: float = 0.5
    fusion: str = "concat"
    leaky_slope: float = 0.01
    flags: int = 0

    def __post_init__(self) -> None:
        if self.fusion not in FUSIONS:
            raise InputError(f"model.network.fusion is {self.fusion!r}; choose one of {', '.join(FUSIONS)}")
        if self.kernel % 2 == 0:
            raise InputError(f"model.network.kernel is {self.kernel}; it must be odd to keep the window's length")
        if min(self.samples, self.cnn_channels, self.lstm_hidden, self.lstm_layers, *self.dense) < 1:
            raise InputError("model.network: every size must be at least 1")
        if not 0 <= self.dropout < 1:
            raise InputError(f"model.network.dropout is {self.dropout}; it must be in [0, 1)")


LstmState = tuple[Tensor, Tensor]  # each (layers, B, hidden)


class CnnLstm(nn.Module):
    """Window (B, 15, M) and components (B, 30 + flags) to a feature vector (B, dense[-1]), with memory."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        pad = config.kernel // 2
        self.cnn = nn.Sequential(
            nn.Conv1d(CNN_CHANNELS, config.cnn_channels, config.kernel, padding=pad),
            nn.LeakyReLU(config.leaky_slope),
            nn.Conv1d(config.cnn_channels, 1, config.kernel, padding=pad),
            nn.LeakyReLU(config.leaky_slope),
        )
        width = config.samples + COMPONENTS + config.flags
        self.squeeze = nn.Linear(width, COMPONENTS) if config.fusion == "strict30" else nn.Identity()
        # cells, not nn.LSTM: with a batch that changes from epoch to epoch oneDNN's kernel is six times slower
        first = COMPONENTS if config.fusion == "strict30" else width
        self.lstm = nn.ModuleList(
            nn.LSTMCell(config.lstm_hidden if i else first, config.lstm_hidden) for i in range(config.lstm_layers)
        )
        layers: list[nn.Module] = []
        size = config.lstm_hidden
        for i, out in enumerate(config.dense):
            if i:
                layers.append(nn.Dropout(config.dropout))
            layers += [nn.Linear(size, out), nn.LeakyReLU(config.leaky_slope)]
            size = out
        self.dense = nn.Sequential(*layers)
        self._initialise()

    def _initialise(self) -> None:
        """Orthogonal recurrent weights and a forget-gate bias of 1 (paper.md 4.13)."""
        hidden = self.config.lstm_hidden
        for name, parameter in self.lstm.named_parameters():
            if name.endswith("weight_hh"):
                for gate in parameter.data.chunk(4):
                    nn.init.orthogonal_(gate)
            elif name.endswith("bias_ih"):
                nn.init.zeros_(parameter)
                parameter.data[hidden : 2 * hidden] = 1.0
            elif name.endswith("bias_hh"):
                nn.init.zeros_(parameter)

    def start(self, batch_size: int, like: Tensor) -> LstmState:
        """Empty memory."""
        zeros = like.new_zeros(self.config.lstm_layers, batch_size, self.config.lstm_hidden)
        return zeros, zeros

    def forward(
        self, window: Float[Tensor, "B 15 M"], components: Float[Tensor, "B C"], memory: LstmState
    ) -> tuple[Float[Tensor, "B D"], LstmState]:
        """One epoch."""
        y = self.squeeze(torch.cat((self.cnn(window).squeeze(1), components), -1))
        hidden, cell = [], []
        for layer, h, c in zip(self.lstm, *memory):
            y, c = layer(y, (h, c))
            hidden.append(y)
            cell.append(c)
        return self.dense(y), (torch.stack(hidden), torch.stack(cell))
