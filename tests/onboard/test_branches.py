"""What only one choice takes is computed where it is taken, and with the values that torch gives."""

from __future__ import annotations

import random
import re
from typing import NamedTuple

import pytest
import torch
from torch import Tensor, nn

from dlkf.filters.branches import select_branch
from dlkf.onboard.library import find_compiler
from tests.onboard.translated import lines_within, translate

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler here")
BRANCH = re.compile(r"^ *if \((x|in)\d+\[0\]\) \{", re.MULTILINE)
COUNT = 400  # numbers, so many that an exponential of them is worth a branch
GOOD = torch.linspace(-2, 3, COUNT, dtype=torch.float64)[None]


class Pair(NamedTuple):
    """As memory of a filter."""

    first: Tensor
    second: Tensor


class Choice(nn.Module):
    """Of two truth values and a row of numbers."""

    branches = 1  # that the C has
    outside = 0  # exponentials that it computes in any case
    inside = 1  # and those in a branch

    def example(self):
        return torch.tensor([1.0]).double(), torch.tensor([-1.0]).double(), GOOD

    def forward(self, s, t, x):
        return select_branch(s > 0, x.exp() + 1, 2 * x)


class Several(Choice):
    """Choices on one truth value, with a part of their own and one that they share."""

    branches, inside = 3, 2

    def forward(self, s, t, x):
        shared = x.exp()
        first, second = select_branch(s > 0, Pair(shared + 1, shared * x), Pair(x, 0 * x))
        return torch.cat((first, second.cumsum(-1), torch.where((s > 0)[:, None], (-x).exp() + first, x)))


class OfTwo(Choice):
    """A value that choices on different truth values take is computed in any case."""

    branches, outside, inside = 0, 1, 0

    def forward(self, s, t, x):
        y = x.exp()
        return torch.cat((select_branch(s > 0, y, x), select_branch(t > 0, y, x)))


class Either(Choice):
    """A value that one choice takes where a truth value holds, another where it does not."""

    branches, outside, inside = 0, 1, 0

    def forward(self, s, t, x):
        y = x.exp()
        return torch.cat((select_branch(s > 0, y, x), select_branch(s > 0, x, y)))


class OfItself(Choice):
    """The truth value comes from what is chosen."""

    outside, inside = 1, 1

    def forward(self, s, t, x):
        y = (s * x).exp()
        large = y.mean(1) > 3
        return torch.cat((select_branch(large, y, x), select_branch(large, (y - 30).exp() + y, x)))


class Truth(Choice):
    """A truth value is itself what is chosen where it holds."""

    branches, outside, inside = 0, 1, 0

    def forward(self, s, t, x):
        on = (s * x).exp().mean(1) > 3
        return torch.where(on, on, t > 0).double()


class Inner(Choice):
    """A choice within what is chosen, its truth value too."""

    inside = 3

    def forward(self, s, t, x):
        y = x.exp()
        within = select_branch(t * y.nan_to_num().mean(1) > 0, (-y).exp(), (x - 1).exp())
        return select_branch(s > 0, within + 1, x)


class Inwards(Choice):
    """A truth value of an inner choice that another choice has as well."""

    branches, inside = 2, 3

    def forward(self, s, t, x):
        within = select_branch(t > 0, (-x).exp(), (x - 1).exp())
        return torch.cat((select_branch(s > 0, within + 1, x), select_branch(t > 0, (2 * x).exp(), x)))


class Elsewhere(Choice):
    """What a part uses is a result itself."""

    outside, inside = 1, 1

    def forward(self, s, t, x):
        y = x.exp()
        return torch.cat((select_branch(s > 0, (-y).exp() + y, x), y))


class ThenUsed(Choice):
    """The chosen value is read after the choice."""

    branches, outside, inside = 0, 1, 0

    def forward(self, s, t, x):
        y = x.exp()
        return select_branch(s > 0, y, x) + y.sum()


class Changed(Choice):
    """Parts that are written to, of what is read again where it is not chosen."""

    def forward(self, s, t, x):
        z = 3 * x
        y = z.clone()
        y[:, 3:300] += x.exp()[:, 3:300]
        return torch.cat((select_branch(s > 0, y, z), z))


class Copied(Choice):
    """A copy of what is taken otherwise."""

    branches = 2

    def forward(self, s, t, x):
        y = x * 2
        return torch.cat((select_branch(s > 0, y.clone(), y), select_branch(s > 0, x.exp(), x)))


class Angles(Choice):
    """Sine and cosine of the same angles, one of them in any case."""

    branches = 2

    def forward(self, s, t, x):
        first = select_branch(s > 0, x.exp() + x.sin(), x)
        return torch.cat((first, x.cos(), select_branch(s > 0, (x + 1).cos(), (x + 1).sin())))


class Products(Choice):
    """Matrices, of which none is an expression of single numbers."""

    inside = 0

    def forward(self, s, t, x):
        A = x.view(20, 20)
        P = (A @ A.mT).unsqueeze(0) + 50 * torch.eye(20)
        return select_branch(s > 0, torch.linalg.solve_ex(P, A.unsqueeze(0))[0], A.unsqueeze(0))


class Little(Choice):
    """So little that a branch is not worth it."""

    branches, outside, inside = 0, 1, 0

    def forward(self, s, t, x):
        return select_branch(s > 0, x[:, :9].exp(), x[:, :9])


class Otherwise(Choice):
    """What is taken where the truth value does not hold is computed in any case."""

    branches, outside, inside = 0, 1, 0

    def forward(self, s, t, x):
        return select_branch(s > 0, x, x.exp())


class Drives(Choice):
    """A truth value each."""

    branches, outside, inside = 0, 1, 0

    def example(self):
        return torch.tensor([1.0, -1.0]).double(), torch.zeros(2).double(), GOOD.repeat(2, 1)


CHOICES = [
    Choice(), Several(), OfTwo(), Either(), OfItself(), Truth(), Inner(), Inwards(), Elsewhere(), ThenUsed(),
    Changed(), Copied(), Angles(), Products(), Little(), Otherwise(), Drives(),
]  # fmt: skip


@pytest.fixture(scope="module")
def translated(tmp_path_factory):
    """All of them, in one library."""
    return {type(c.module): c for c in translate(tmp_path_factory.mktemp("branches"), *CHOICES)}


@pytest.mark.parametrize("kind", [type(c) for c in CHOICES])
def test_values_are_those_of_torch(translated, kind):
    choice = translated[kind]
    s, t, x = choice.module.example()
    spoilt = x.clone()  # the part that is not taken must leave no trace, nor stop what is
    spoilt[:, 5], spoilt[:, 7], spoilt[:, 11], spoilt[:, 13] = torch.nan, torch.inf, -torch.inf, 800.0
    for u, v in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        for numbers in (x, spoilt):
            if kind is Products and numbers is spoilt:
                continue  # a matrix with NaN is singular, which LAPACK sees otherwise
            args = u * s, v * torch.ones_like(t), numbers
            # exponentials of the C library and of torch: a few units in the last place
            torch.testing.assert_close(choice(*args), choice.wanted(*args), rtol=1e-12, atol=1e-12, equal_nan=True)


@pytest.mark.parametrize("kind", [type(c) for c in CHOICES])
def test_a_branch_has_what_is_taken_there_alone(translated, kind):
    code = translated[kind].code
    taken = "".join(lines_within(code, "if (")).count("exp(")
    assert len(BRANCH.findall(code)) == kind.branches
    assert (code.count("exp(") - taken, taken) == (kind.outside, kind.inside)


class Random(Choice):
    """Thirty operations on what came before, chosen by a seed."""

    def __init__(self, seed):
        super().__init__()
        self.seed = seed

    def forward(self, s, t, x):
        pick = random.Random(self.seed)
        made, truths = [x, x.roll(7, 1) + 1], [s > 0, t > 0]
        for _ in range(30):
            a, b, on = pick.choice(made[-4:]), pick.choice(made), pick.choice(truths)
            match pick.randrange(9):
                case 0:
                    made.append((-a.abs()).exp())
                case 1:
                    made.append(a.sin() + b)
                case 2:
                    made.append(a.cos())
                case 3:
                    y = a.clone()
                    y[:, 10:200] += b[:, 20:210]
                    made.append(y)
                case 4:
                    made.append(a.cumsum(1) / COUNT)
                case 5:
                    made.append((a.view(20, 20) @ b.view(20, 20)).view(1, COUNT).tanh())
                case 6:
                    truths.append(a.mean(1) > b.mean(1))
                case _:
                    made.append(select_branch(on, a, b))
        return torch.cat((*made[-3:], select_branch(s > 0, made[-4], x)))


def test_random_functions_have_the_values_of_torch(tmp_path):
    functions = translate(tmp_path, *(Random(seed) for seed in range(8)))
    assert sum(len(BRANCH.findall(f.code)) for f in functions) > 8
    for f in functions:
        for u, v in ((1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)):
            args = torch.tensor([u]).double(), torch.tensor([v]).double(), GOOD
            # sums of a product in another order, through thirty operations
            torch.testing.assert_close(f(*args), f.wanted(*args), rtol=1e-9, atol=1e-9, msg=f"seed {f.module.seed}")
