"""The DLKF beside a Kalman filter: that filter with weights of zero, its covariance with any gain, saving, gradient."""

from dataclasses import replace

import pytest
import torch

from dlkf.base.errors import InputError
from dlkf.filters.build import build_filter
from dlkf.filters.integration import Covariances, integrate
from dlkf.filters.learned_kalman import LearnedKalmanConfig, LearnedKalmanFilter, _add_gain
from dlkf.filters.saved import load_filter, save_filter
from dlkf.filters.tuning import Prior, Tuning

from .scene import IMU as PLAIN
from .scene import scene

SMALL = {"network": {"lstm_hidden": 16, "lstm_layers": 2, "dense": [24, 12]}, "frame": "heading"}
IMU = replace(PLAIN, accel=replace(PLAIN.accel, scale_factor=5e-3), gyro=replace(PLAIN.gyro, misalignment=5e-3))
TUNING = Tuning(accel_noise=3.0, velocity_std=1.5)
PRIOR = Prior((0.02, -0.03, 0.01, 1e-3, -1e-3, 5e-4), (0.02,) * 3 + (1e-3,) * 3)


def small(base: str, prior: Prior | None = None, **settings) -> LearnedKalmanFilter:
    torch.manual_seed(0)
    config = LearnedKalmanConfig.from_mapping({**SMALL, "base": base, **settings})
    return LearnedKalmanFilter(config.with_base(IMU, TUNING, prior)).double().eval()


def without_heads(model: LearnedKalmanFilter) -> LearnedKalmanFilter:
    with torch.no_grad():
        for p in model.heads():
            p.zero_()
    return model


def with_outage(batch):
    available = batch.available.clone()
    available[:, 20:30] = False
    return replace(batch, available=available)


@pytest.mark.parametrize("form", ["constant", "affine"])
@pytest.mark.parametrize("base", ["mbkf15_prior", "mbkf21_car", "mbkf33_gated"])
def test_with_weights_of_zero_it_is_the_kalman_filter(base, form):
    """Through fixes and an outage, with and without sensor matrices on either side."""
    batch = with_outage(scene(5, 40, seed=3, lever_arm=(1.0, 0.3, -1.2)))
    prior = PRIOR if "prior" in base else None
    ours = integrate(batch, without_heads(small(base, prior, imu_error=form)), keep_innovations=True)
    theirs = integrate(batch, build_filter(base, IMU, tuning=TUNING, prior=prior), keep_innovations=True)
    for name in ("p_n", "v_n", "C_nb"):
        difference = getattr(ours.posterior, name) - getattr(theirs.posterior, name)
        assert difference.abs().max() < 1e-7  # rounding of strapdown in two forms of the sensor matrices
    assert torch.allclose(ours.std, theirs.std, rtol=1e-6)
    assert torch.allclose(ours.imu_error, theirs.imu_error, atol=1e-9)
    assert torch.allclose(ours.gain, theirs.gain, atol=1e-9)
    assert torch.allclose(ours.innovation_covariance, theirs.innovation_covariance, rtol=1e-6)


def test_an_innovation_that_is_left_out_has_its_own_variance():
    """As that of the Kalman filter; a fix 1 km off that the coarse gate leaves out."""
    batch = scene(2, 15, seed=4)
    gnss = batch.gnss.clone()
    gnss[:, 12, :3] += 1000.0
    batch, said = replace(batch, gnss=gnss), []

    class Watched:
        def __init__(self, inner):
            self.begin, self.inner, self.variances = inner.begin, inner, []

        def step(self, memory, epoch):
            memory, correction = self.inner.step(memory, epoch)
            self.variances.append(correction.rejected)
            return memory, correction

    for inner in (without_heads(small("mbkf15")), build_filter("mbkf15", IMU, tuning=TUNING)):
        watched = Watched(inner)
        integrate(batch, watched)
        said.append(watched.variances)
    assert [k for k, x in enumerate(said[0]) if x is not None] == [12]
    assert torch.allclose(said[0][12], said[1][12], rtol=1e-6) and bool((said[0][12] > 0).all())


def test_covariance_with_a_further_gain_is_that_of_joseph_s_form():
    """P of the whole gain K + E on a fix beside a constraint, by P⁺ = (I − G H) P (I − G H)ᵀ + G R Gᵀ."""
    draw = torch.Generator().manual_seed(1)

    def random(*shape):
        return torch.randn(*shape, generator=draw, dtype=torch.float64)

    n, m = 15, 8  # the last two rows are a constraint
    A = random(2, n, n)
    P, H, R = A @ A.mT, random(2, m, n), random(2, m).square() + 0.1
    S = H @ P @ H.mT + torch.diag_embed(R)
    K = P @ H.mT @ torch.linalg.inv(S)

    def joseph(G):
        B = torch.eye(n, dtype=P.dtype) - G @ H
        return B @ P @ B.mT + G @ torch.diag_embed(R) @ G.mT

    further = random(2, 9, 6)
    E = torch.zeros(2, n, m, dtype=P.dtype)
    E[:, :9, :6] = further
    optimal = joseph(K)
    known = Covariances(P, P, optimal, H[:, :6], R[:, :6], random(2, n))
    assert torch.allclose(_add_gain(optimal, further, known), joseph(K + E), rtol=1e-9, atol=1e-9)


def test_a_wrong_gain_makes_the_filter_less_sure():
    batch = scene(3, 15, seed=5)
    model, plain = (without_heads(small("mbkf15")) for _ in range(2))
    with torch.no_grad():
        model.gain.linear.bias.copy_(0.3 * torch.eye(9, 6).flatten())
    assert (integrate(batch, model).std[..., :6] > integrate(batch, plain).std[..., :6]).all()


def test_both_heads_and_the_network_get_a_gradient():
    """With an outage at the end, in which the gain has no part."""
    batch = with_outage(scene(4, 30, seed=6))
    model = small("mbkf21_car", imu_error="affine").train()
    (integrate(batch, model).posterior.p_n - batch.truth.p_n).square().mean().backward()
    for name, p in model.named_parameters():
        assert p.grad is not None and p.grad.isfinite().all() and p.grad.abs().max() > 0, name


def test_the_gradient_of_the_imu_error_head_is_that_of_differences():
    """In an outage, where the covariance, through which no gradient runs, does not matter."""
    batch = scene(2, 12, seed=7)
    available = batch.available.clone()
    available[:, 6:] = False
    batch = replace(batch, available=available)
    model = without_heads(small("mbkf15"))

    def loss(bias):
        with torch.no_grad():
            model.imu_error.linear.bias.copy_(bias)
        return (integrate(batch, model).posterior.p_n[:, -1] - batch.truth.p_n[:, -1]).square().mean()

    zero = torch.zeros(6, dtype=torch.float64)
    model.zero_grad()
    loss(zero).backward()
    found = model.imu_error.linear.bias.grad
    with torch.no_grad():
        steps = 1e-4 * torch.eye(6, dtype=torch.float64)
        numeric = torch.stack([(loss(s) - loss(-s)) / 2e-4 for s in steps])
    # P and K depend on the trajectory by a share of some 1e-3, which the gradient leaves out
    assert torch.allclose(found, numeric, rtol=2e-2, atol=2e-2 * float(numeric.abs().max()))


def test_saved_and_loaded_it_gives_the_same(tmp_path):
    batch = scene(2, 12, seed=8)
    model = small("mbkf15_prior", PRIOR)
    save_filter(model.float(), tmp_path)
    loaded = load_filter(tmp_path)
    assert isinstance(loaded, LearnedKalmanFilter) and loaded.kalman.prior == PRIOR and loaded.kalman.tuning == TUNING
    batch = batch.in_precision(torch.float32)
    assert torch.equal(integrate(batch, loaded).posterior.p_n, integrate(batch, model).posterior.p_n)


@pytest.mark.parametrize(
    "settings, said",
    [
        ({"base": "ins"}, "model.base=ins is no Kalman filter"),
        ({"base": "plus"}, "model.base=plus is no Kalman filter"),
        ({"base": "mbkf15_rts"}, "mbkf15_rts is smoothed"),
        ({"outage_mode": "hold"}, "model.outage_mode must be run"),
    ],
)
def test_settings_that_do_not_fit(settings, said):
    with pytest.raises(InputError, match=said):
        LearnedKalmanConfig.from_mapping({**SMALL, **settings})
