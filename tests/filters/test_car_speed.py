"""Bayesian regression of the forward speed: equal to the batch solution, absent on cars that tell nothing."""

import math

import pytest
import torch

from dlkf.filters import car_speed
from dlkf.filters.car_speed import CarSpeed, Foretold


def model(numbers: int = 3) -> CarSpeed:
    torch.manual_seed(0)
    return CarSpeed(5, numbers).double()


def run(model: CarSpeed, heard: torch.Tensor, speed: torch.Tensor, fixed: torch.Tensor) -> list[Foretold]:
    known, out = model.begin(len(heard)), []
    for t in range(heard.shape[1]):
        out.append(model(heard[:, t], known))
        known = model.learned(known, out[-1], speed[:, t], fixed[:, t])
    return out


def test_it_is_the_regression_of_all_fixes_at_once(monkeypatch):
    """Ridge regression with the prior's spread and σ² ν as noise, in closed form; nothing is forgotten here."""
    monkeypatch.setattr(car_speed, "MEMORY", math.inf)
    listener, count = model(), 40
    heard, speed = torch.randn(2, count, 5).double(), 10 + torch.randn(2, count).double()
    with torch.no_grad():
        last = run(listener, heard, speed, torch.ones(2, count).bool())[-1]
        known = listener.begin(2)
        phi = torch.stack([listener(heard[:, t], known).heard for t in range(count)], 1)
        before, repeats = phi[:, :-1], listener._known()[3]
        information = torch.linalg.inv(known.spread) + before.mT @ before / repeats
        pulled = before.mT @ (speed[:, :-1, None] - before @ known.mean.unsqueeze(-1)) / repeats
        w = known.mean.unsqueeze(-1) + torch.linalg.solve(information, pulled)
    assert torch.allclose(last.speed, (phi[:, -1:] @ w)[:, 0, 0], atol=1e-9)
    assert torch.allclose(last.novelty, (phi[:, -1:] @ torch.linalg.inv(information) @ phi[:, -1:].mT)[:, 0, 0])


def test_its_variance_is_that_of_all_fixes_at_once(monkeypatch):
    """b = b₀ + |y − Φw|² + (w − w₀)ᵀΛ₀(w − w₀) of the normal-inverse-gamma law (Bishop 2006, 3.3), with ν = 1."""
    monkeypatch.setattr(car_speed, "MEMORY", math.inf)
    listener, count = model(), 40
    listener.log_sizes.data[2] = -math.log(car_speed.PRIOR_REPEATS)
    heard, speed = torch.randn(2, count, 5).double(), 10 + torch.randn(2, count).double()
    with torch.no_grad():
        prior = known = listener.begin(2)
        phi = torch.stack([listener(heard[:, t], prior).heard for t in range(count)], 1)
        for t in range(count):
            known = listener.learned(known, listener(heard[:, t], known), speed[:, t], torch.ones(2).bool())
        information = torch.linalg.inv(prior.spread)
        pulled = phi.mT @ (speed.unsqueeze(-1) - phi @ prior.mean.unsqueeze(-1))
        change = torch.linalg.solve(information + phi.mT @ phi, pulled)
        residual = speed - (phi @ (prior.mean.unsqueeze(-1) + change))[..., 0]
        b = prior.squares + residual.square().sum(-1) + (change.mT @ information @ change)[:, 0, 0]
    assert torch.allclose(known.squares, b, rtol=1e-9)
    assert torch.equal(known.count, prior.count + count)


def test_a_car_that_tells_its_speed_is_believed_and_one_that_does_not_is_not():
    """Two minutes with GNSS, one without: one car's sound follows its speed, the other's is noise."""
    listener, steps = model(), 180
    listener.log_spread.data.fill_(3.0)  # an untrained network's numbers are small
    v = 10 + 6 * torch.sin(torch.arange(steps) / 9).double().expand(2, -1)
    heard = 0.3 * torch.randn(2, steps, 5).double()
    heard[0, :, 0] = v[0] / 5 - 2
    fixed = (torch.arange(steps) < 120).expand(2, -1)
    with torch.no_grad():
        told = run(listener, heard, v, fixed)[120:]
    error = torch.stack([f.speed for f in told], 1) - v[:, 120:]
    std = torch.stack([f.std for f in told], 1)
    rms = error.square().mean(1).sqrt()
    assert rms[0] < 2.0 < 3.0 < rms[1] and std[0].mean() < 2.5 and std[1].mean() > 3.5


@pytest.mark.usefixtures("without_shape_checks")
def test_what_was_learned_long_ago_fades_to_the_prior():
    listener = model()
    known = listener.begin(1)
    heard, none = torch.ones(1, 5).double(), torch.zeros(1, 5).double()
    with torch.no_grad():
        for _ in range(8000):  # a day of standing still: nothing winds up
            known = listener.learned(known, listener(heard, known), torch.zeros(1).double(), torch.tensor([True]))
        eigenvalues = torch.linalg.eigvalsh(known.spread)
        assert float(eigenvalues.min()) > 0 and float(eigenvalues.max()) < 1.01
        assert float(known.count) == pytest.approx(car_speed.MEMORY + 3, abs=5)
        assert float(listener(none, known).std) > 0.3


def test_what_is_no_longer_heard_becomes_unknown_again():
    """Λ → Λ₀ at a rate 1/MEMORY: half a MEMORY after 1/100 of the prior's spread it is 1/(99 e^-½ + 1) of it."""
    listener = model()
    prior = listener.begin(1)
    known = prior._replace(spread=0.01 * prior.spread)
    with torch.no_grad():
        silent = listener(torch.zeros(1, 5).double(), prior)
        silent = silent._replace(heard=torch.zeros_like(silent.heard), novelty=torch.zeros_like(silent.novelty))
        for _ in range(round(0.5 * car_speed.MEMORY)):
            known = listener.learned(known, silent, silent.speed, torch.tensor([True]))
    share = (known.spread / prior.spread).diagonal(dim1=-2, dim2=-1)
    assert share.tolist()[0] == pytest.approx([1 / (99 * math.exp(-0.5) + 1)] * 4, rel=0.02)  # first order in the step
