"""plus: at zero the classical filter, blind to the direction of driving, differentiable, and on disk."""

from dataclasses import replace

import pytest
import torch

from dlkf.base.errors import InputError
from dlkf.filters.build import build_filter
from dlkf.filters.constraints import CarConstraints
from dlkf.filters.integration import integrate
from dlkf.filters.model_based import has_covariance
from dlkf.filters.plus import PlusConfig, PlusFilter
from dlkf.filters.saved import build_learned_filter, load_filter, parse_learned_settings, save_filter
from dlkf.filters.smoother import smooth
from dlkf.networks.plus import bound_factor, window_features
from tests.turned import turn_frames

from .scene import scene


def plus(base="mbkf21_car", weights: float = 0.0, hidden: int = 16) -> PlusFilter:
    torch.manual_seed(1)
    model = PlusFilter(PlusConfig.from_mapping({"base": base, "network": {"hidden": hidden}})).eval()
    if weights:
        for p in model.network.noise.parameters():
            torch.nn.init.normal_(p, std=weights)
    else:
        for p in model.parameters():
            torch.nn.init.zeros_(p)
    return model


def classical(base: str, model: PlusFilter):
    """Its classical filter."""
    kalman = build_filter(base, model.imu, tuning=model.tuning)
    sources = tuple(replace(s, adapts_noise=True) if isinstance(s, CarConstraints) else s for s in kalman.sources)
    return replace(kalman, sources=sources, heavy_tails=True)


def car(segments: int, epochs: int, seed: int = 0):
    batch = scene(segments, epochs, seed=seed, lever_arm=(0.4, 0.1, -0.7))
    available = batch.available.clone()
    available[:, epochs // 2 : epochs - 3] = False
    return replace(batch, available=available)


@pytest.mark.parametrize("base", ["mbkf21_car", "mbkf33_car_gated"])
def test_with_weights_of_zero_it_is_the_classical_filter(base, claimed):
    batch, model = car(3, 10), plus(base)  # no virtual outage is scored so soon
    with torch.no_grad():
        a, b = integrate(batch, model), integrate(batch, classical(base, model))
    for one, other in zip(
        (*a.posterior, a.imu_error, a.std, a.gain), (*b.posterior, b.imu_error, b.std, b.gain), strict=True
    ):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-9)


def test_before_the_first_fix_it_is_the_classical_filter():
    batch, model = car(3, 16), plus(weights=0.5)
    available = torch.ones_like(batch.available)
    available[:, :9] = False
    batch = replace(batch, available=available)
    with torch.no_grad():
        a, b = integrate(batch, model), integrate(batch, build_filter("mbkf21_car", model.imu, tuning=model.tuning))
    for one, other in ((a.posterior.p_n, b.posterior.p_n), (a.std, b.std)):
        torch.testing.assert_close(one[:, :9], other[:, :9], rtol=1e-9, atol=1e-9)
    assert not torch.allclose(a.posterior.p_n[:, 12], b.posterior.p_n[:, 12], atol=1e-6)


def test_it_does_not_know_where_north_is():
    """The same drive in a turned frame: the same solution, turned. 1e-6 of kilometres and radians is rounding."""
    batch, model = car(4, 24, seed=2), plus(weights=0.3).double()
    turned = turn_frames(batch, torch.Generator().manual_seed(0))
    with torch.no_grad():
        a, b = integrate(batch, model), integrate(turned, model)
    C = turned.truth.C_nb @ batch.truth.C_nb.mT
    assert not torch.allclose(a.posterior.p_n, b.posterior.p_n, atol=1.0)
    assert torch.allclose((C @ a.posterior.p_n.unsqueeze(-1)).squeeze(-1), b.posterior.p_n, atol=1e-6)
    assert torch.allclose(C @ a.posterior.C_nb, b.posterior.C_nb, atol=1e-8)
    assert torch.allclose(a.imu_error, b.imu_error, atol=1e-9)


def test_weights_matter_in_outages_too():
    batch = car(2, 20)
    with torch.no_grad():
        a, b = integrate(batch, plus()), integrate(batch, plus(weights=0.3))
    assert not torch.allclose(a.std[:, 14], b.std[:, 14])


def test_gradient_reaches_the_noise(claimed):
    """From the position in the outage, by finite differences: Riccati recursion and state. Only biases, since what the
    network sees is cut by design; so is Φ in training, for speed, but not here."""
    batch, model = car(2, 14, seed=3), plus(weights=0.05).double()
    model.kalman = replace(model.kalman, cut_transition=False)
    torch.nn.init.zeros_(model.network.noise.weight)

    def loss() -> torch.Tensor:
        e = integrate(batch, model).posterior.p_n - batch.truth.p_n
        return e[:, 7:11].square().sum()

    head = model.network.noise.bias
    loss().backward()
    gradient = head.grad.clone()
    assert (gradient != 0).all()  # every source and axis
    direction, step = gradient / gradient.norm(), 1e-4
    values = []
    for sign in (1, -1):
        with torch.no_grad():
            head += sign * step * direction
            values.append(float(loss()))
            head -= sign * step * direction
    assert (values[0] - values[1]) / (2 * step) == pytest.approx(float(gradient.norm()), rel=1e-4)


def test_factors_are_bounded_and_begin_with_the_slope_of_exp():
    x = torch.tensor([-50.0, 0.0, 50.0], requires_grad=True)
    y = bound_factor(x, 2.0)
    (gradient,) = torch.autograd.grad(y.sum(), x)
    assert y.tolist() == pytest.approx([torch.e**-2, 1.0, torch.e**2]) and float(gradient[1]) == 1.0


def test_band_variances_do_not_depend_on_the_rate():
    """White noise of the same density, and a tone, at 50 and 200 Hz; 30 % is what 500 windows leave of scatter."""
    g = torch.Generator().manual_seed(0)
    seen = []
    for rate in (50, 200):
        t = torch.arange(rate) / rate
        noise = 1e-2 * rate**0.5 * torch.randn(500, rate, 6, generator=g)
        tone = 0.5 * torch.sin(2 * torch.pi * 7 * t)[:, None]
        seen.append(window_features(noise + tone, 1 / rate)[:, 6:].mean(0))
    assert torch.allclose(seen[0], seen[1], atol=0.3 / 4)


def test_a_saved_filter_is_the_same_filter(tmp_path):
    model, batch = plus(weights=0.2), car(2, 12)
    save_filter(model, tmp_path / "model")
    again = load_filter(tmp_path / "model")
    assert again.config == model.config and again.imu == model.imu
    with torch.no_grad():
        assert torch.equal(integrate(batch, again).posterior.p_n, integrate(batch, model).posterior.p_n)


def test_it_can_be_smoothed():
    batch, model = car(12, 40, seed=6), plus()
    assert has_covariance(model)
    with torch.no_grad():
        f, s = integrate(batch, model), smooth(batch, model)
    before, after = ((x.posterior.p_n - batch.truth.p_n)[:, 30].norm(dim=-1).log().mean().exp() for x in (f, s))
    assert after < 0.5 * before


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"kind": "minus"}, "dlkf, dlkf_kalman, plus"),
        ({"kind": "plus", "hiden": 3}, "unknown key hiden"),
        ({"kind": "plus", "base": "ins"}, "no Kalman filter"),
        ({"kind": "plus", "network": {"hidden": 1000}}, "between 8 and 256"),
    ],
)
def test_mistakes_are_one_line(settings, words):
    with pytest.raises(InputError, match=words):
        build_learned_filter(parse_learned_settings(settings))


class Judged:
    """A filter whose virtual outages say from the start that its network is wrong, or right."""

    def __init__(self, model: PlusFilter, hypothesis: int) -> None:
        self.model, self.hypothesis = model, hypothesis

    def begin(self, batch):
        memory, error = self.model.begin(batch)
        evidence = memory.outage.evidence.clone()
        evidence[:, self.hypothesis] += 1e3
        return memory._replace(outage=memory.outage._replace(evidence=evidence)), error

    def step(self, memory, epoch):
        return self.model.step(memory, epoch)


def test_a_network_that_outages_contradict_has_no_effect(claimed):
    """κ^w with w = 0 is the filter with weights of zero; with w = 1 it is another."""
    batch, model = car(2, 10), plus(weights=0.5)
    with torch.no_grad():
        wrong, right = (integrate(batch, Judged(model, k)) for k in (1, 0))
        none = integrate(batch, Judged(plus(), 1))
    assert torch.allclose(wrong.std, none.std, rtol=1e-12)
    assert not torch.allclose(right.std, none.std, rtol=1e-3)
