"""Operations in C against torch's own, on graphs small enough to see what is tested."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from dlkf.base.errors import InputError
from dlkf.onboard.c_source import translate_function
from dlkf.onboard.library import find_compiler
from tests.onboard.translated import translate

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler here")


class Sums(nn.Module):
    """Reductions, products, solutions."""

    def example(self):
        g = torch.Generator().manual_seed(1)
        A = torch.randn(2, 5, 5, generator=g, dtype=torch.float64)
        return A @ A.mT + 5 * torch.eye(5), torch.randn(2, 5, 3, generator=g, dtype=torch.float64)

    def forward(self, S, B):
        X = torch.linalg.solve_ex(S, B)[0]
        L = torch.linalg.cholesky_ex(S)[0]
        Y = torch.cholesky_solve(B, L)
        F = torch.linalg.solve_triangular(L, B, upper=False)
        R = torch.linalg.inv_ex(S[:, 1:4, 1:4])[0]
        P = torch.baddbmm(S, B, B.mT, beta=0.5, alpha=-2.0)
        parts = (
            X, Y, F, L, R, P, S.cumsum(1), S.cumsum(-1), B.mT @ S, S.mean((0, 2)), S.var(1), S.amax(1), B.norm(dim=1),
            B.sum(1, keepdim=True),
        )  # fmt: skip
        return torch.cat([x.flatten() for x in parts])


class Places(nn.Module):
    """Views, parts that are written to, indices."""

    def example(self):
        g = torch.Generator().manual_seed(2)
        return (torch.randn(3, 4, 6, generator=g, dtype=torch.float64),)

    def forward(self, x):
        y = x.clone()
        y[:, 1, 2:4] = x[:, 0, :2] * 2
        y[..., 5] += 1.0
        rows, columns = [0, 2, 1], [1, 3, 5]
        best = x.argmax(-1)
        z = x.clone()
        z[:, rows, columns] += 10.0
        parts = (
            y, z, x[:, rows, columns], x.gather(-1, best[..., None].expand(3, 4, 1)), x.transpose(0, 2)[1:5:2],
            torch.diag_embed(x[:, 0]), x.diagonal(dim1=-2, dim2=-1), x.unflatten(-1, (2, 3)).mT, x.roll(1, 2)[:, :1],
            torch.cat((x, x[:, :1]), 1), torch.nn.functional.pad(x, (1, 0, 2, 0)), x[:, :, [0, 0, 3]],
            torch.linalg.cross(x[..., :3], x[:, :1, 3:].expand(3, 4, 3), dim=-1), x.repeat_interleave(2, -1),
        )  # fmt: skip
        return torch.cat([p.flatten() for p in parts])


class Elements(nn.Module):
    """Functions of single numbers, not-a-number and infinity among them; both precisions."""

    times = 1

    def example(self):
        x = torch.tensor([[-2.0, -0.5, 0.0, 0.3, 1.0, 7.0, torch.nan, torch.inf, -torch.inf]]).double()
        return (x.repeat(1, self.times),)

    def forward(self, x):
        good = x.nan_to_num(0.7, 3.0, -3.0)
        f = good.float()
        parts = (
            torch.sin(good), torch.atan2(good, good + 0.1), torch.hypot(good, 2 * good), torch.asinh(good),
            torch.log1p(good.abs()), torch.exp(-good), good.clamp(-1, 1), good.clamp_min(0.2), torch.tanh(f).double(),
            torch.sigmoid(f).double(), torch.where(x.isnan(), 1.0, 2.0), x.isfinite().double(), x.isinf().double(),
            (good > 0.1).double(), ((x == x) & ~(x > 1)).double(), torch.lerp(good, 2 * good, 0.25), good.square(),
            good**3, torch.maximum(good, 0 * good), good.floor(), good.rsqrt().nan_to_num(5.0, 6.0, 7.0),
            torch.addcmul(good, good, good, value=2), torch.nn.functional.leaky_relu(f).double(), x,
        )  # fmt: skip
        return torch.cat([p.flatten() for p in parts])


class ManyElements(Elements):
    """So many that they are vectorised, with functions that have no branch."""

    times = 20

    def forward(self, x):
        f, good = x.float(), 100 * x.nan_to_num(0.7, 3.0, -3.0)
        parts = (
            x.exp(), x.log(), x.log1p(), x.asinh(), x.sin(), x.cos(), f.exp().double(), f.tanh().double(),
            f.sigmoid().double(), good.exp(), good.sin(), good.cos(), (1e-9 * good).log1p(),
            (1e-308 * good.abs()).log(),
        )  # fmt: skip
        return torch.cat((super().forward(x), *(p.flatten() for p in parts)))


class Layers(nn.Module):
    """What networks are made of."""

    def __init__(self):
        super().__init__()
        torch.manual_seed(3)
        self.cnn = nn.Sequential(nn.Conv1d(4, 3, 3, padding=1), nn.LeakyReLU(0.01), nn.Conv1d(3, 1, 3, padding=1))
        self.lstm, self.gru = nn.LSTMCell(10, 8), nn.GRUCell(8, 70)  # 70 · 210 weights go into weights.c
        self.dense = nn.Linear(70, 5)

    def example(self):
        g = torch.Generator().manual_seed(4)
        return (torch.randn(1, 4, 10, generator=g, dtype=torch.float64),)

    def forward(self, x):
        h, c = self.lstm(self.cnn(x.float()).squeeze(1))
        return torch.cat((self.dense(self.gru(h)), c), -1).double()


class Constants(Places):
    """What is made of constants alone, then written to."""

    def __init__(self):
        super().__init__()
        self.register_buffer("fixed", 2 * torch.eye(6, dtype=torch.float64))

    def forward(self, x):
        y = torch.eye(6, dtype=torch.float64).repeat(3, 1, 1)
        fixed = self.fixed.repeat(3, 1, 1)
        y[:, :4] += x
        fixed[:, 1:4, 2] = x[:, :3, 0]
        return torch.cat((y, fixed), 1)


KINDS = Sums, Places, Constants, Elements, ManyElements, Layers


@pytest.fixture(scope="module")
def translated(tmp_path_factory):
    """All of them, in one library."""
    return dict(zip(KINDS, translate(tmp_path_factory.mktemp("code"), *(kind() for kind in KINDS))))


@pytest.mark.parametrize("kind", KINDS)
def test_c_does_what_torch_does(translated, kind):
    function = translated[kind]
    module, example = function.module, function.module.example()
    got, want = function(*example), function.wanted(*example)
    # sums in another order; float32 inside the network
    tolerance = 1e-5 if isinstance(module, Layers) else 1e-6 if isinstance(module, Elements) else 1e-12
    torch.testing.assert_close(got, want, rtol=tolerance, atol=tolerance, equal_nan=True)


def test_an_unknown_operation_is_named():
    class Sorted(Places):
        def forward(self, x):
            return torch.sort(x)[0]

    with torch.no_grad(), pytest.raises(InputError, match=r"aten\.sort.*does not know"):
        translate_function("tested", Sorted())


@pytest.mark.parametrize("other", [{"stride": 2}, {"dilation": 2}, {"groups": 2}])
def test_a_convolution_that_is_not_the_plain_one_is_refused(other):
    class Other(Layers):
        def forward(self, x):
            return nn.functional.conv1d(x, torch.ones(2, 4 // other.get("groups", 1), 3).double(), **other)

    with torch.no_grad(), pytest.raises(InputError, match="stride, dilation and groups 1"):
        translate_function("tested", Other())
