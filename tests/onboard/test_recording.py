"""What the recorder takes down is what torch does, at other inputs as well; what depends on values it refuses."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dlkf.base.errors import InputError
from dlkf.onboard.c_source import translate_function
from dlkf.onboard.recording import export_mode, record

EXAMPLE = torch.tensor([1.0, -2.0, 3.0], dtype=torch.float64)
SCALE = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)


class Recorded(torch.nn.Module):
    """A function of one vector of three."""

    def __init__(self, work) -> None:
        super().__init__()
        self._work = work

    def example(self):
        return (EXAMPLE,)

    def forward(self, x):
        return self._work(x)


def parts_changed(x):
    y = torch.zeros(2, 3, dtype=x.dtype)
    y[0] = x * SCALE
    y[1, 1:] = x[:2].cumsum(0)
    y[0, 0].add_(x[2])
    return y, y.sum(0).detach()


def constants_read(x):
    half = torch.tensor(0.5, dtype=torch.float64)
    return (x * half.item() if half > 0 else x) + SCALE[torch.tensor([2, 0, 1])]


def split(x):
    low, high = torch.sort(x).values.aminmax()
    return torch.stack((low, high, x.to(torch.float32).double().norm()))


def masked(x):
    return x[torch.tensor([True, False, True])].sum() * x


def of_its_example(x):
    return x * EXAMPLE[0] + EXAMPLE


@pytest.mark.parametrize("work", [parts_changed, constants_read, split, masked, of_its_example])
def test_a_graph_has_the_values_of_its_function(work) -> None:
    with export_mode():
        graph = record(Recorded(work))
    x = torch.tensor([-7.0, 0.25, 1e3], dtype=torch.float64)
    torch.testing.assert_close(graph(x), work(x), rtol=0, atol=0)


def test_a_constant_is_not_changed_by_recording() -> None:
    with export_mode():
        record(Recorded(lambda x: SCALE.clone().mul_(2) + x))
    assert SCALE.tolist() == [1.0, 2.0, 3.0]


@pytest.mark.parametrize(
    ("work", "said"),
    [
        (lambda x: x * x[0].item(), "values"),
        (lambda x: x if x[0] > 0 else -x, "values"),
        (lambda x: x * max(1.0, x[0]), "values"),
        (lambda x: x[x > 0].sum(), "values"),
        (lambda x: x.nonzero().sum(), "values"),
        (lambda x: x if torch.equal(x, SCALE) else -x, "values"),
        (lambda x: torch.from_numpy(2 * x.numpy()), "values"),
        (lambda x: x * float(np.asarray(x)[0]), "values"),
        (lambda x: x + torch.rand(3), "random"),
    ],
    ids=["value", "branch", "maximum", "mask", "nonzero", "equal", "numpy", "array", "random"],
)
def test_what_depends_on_values_is_refused(work, said) -> None:
    with export_mode(), pytest.raises(InputError, match=f"cannot be exported: .*{said}"):
        translate_function("f", Recorded(work))


def test_what_depends_on_inputs_alone_is_not_refused() -> None:
    with export_mode():
        assert "in0" in translate_function("f", Recorded(lambda x: x * len(x))).code
