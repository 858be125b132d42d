"""The loop and the 15-state filter: consistency, the textbook update, outages, lever arm, late fixes."""

import math
from dataclasses import replace
from functools import partial

import pytest
import torch
from scipy.stats import chi2

from dlkf.base.errors import InputError
from dlkf.filters.build import MODEL_BASED, build_filter
from dlkf.filters.integration import integrate
from dlkf.filters.kalman_update import _compute_update, _solve, kalman_prediction, kalman_update
from dlkf.filters.model_based import Ins, Mbkf, bias_sigma
from dlkf.filters.tuning import Prior, Tuning
from dlkf.navigation.error_model import antenna
from dlkf.navigation.imu_errors import ImuSpec, SensorErrors
from dlkf.navigation.state import ErrorStates, NavState
from dlkf.navigation.strapdown import strapdown

from .scene import IMU, scene


def hidden(batch, first: int, last: int):
    available = batch.available.clone()
    available[:, first:last] = False
    return replace(batch, available=available)


def errors(batch, solution):
    pva = solution.posterior.error_to(batch.truth)
    return torch.cat((pva, batch.true_imu_error - solution.imu_error), -1)


def test_gain_is_the_brute_force_least_squares_solution():
    """Kalman update = minimum of the weighted squares of prior and measurement (batch solution by lstsq)."""
    g = torch.Generator().manual_seed(0)
    L = torch.randn(4, 15, 15, generator=g, dtype=torch.float64)
    P, H = L @ L.mT, torch.randn(4, 6, 15, generator=g, dtype=torch.float64)
    R, z = torch.rand(4, 6, generator=g, dtype=torch.float64) + 0.1, torch.randn(4, 6, generator=g, dtype=torch.float64)
    _, K, updated = kalman_update(P, H, R, torch.zeros_like(R))
    information = torch.linalg.inv(P) + H.mT @ (H / R.unsqueeze(-1))
    expected = torch.linalg.solve(information, H.mT @ (z / R).unsqueeze(-1))
    assert torch.allclose(K @ z.unsqueeze(-1), expected, rtol=1e-6, atol=1e-8)
    assert torch.allclose(updated, torch.linalg.inv(information), rtol=1e-6, atol=1e-8)


def test_gradient_of_the_update_is_that_of_its_steps():
    """In closed form and by autograd through the Joseph form; P stays symmetric, so only that part of its is told."""
    g = torch.Generator().manual_seed(1)
    rand = partial(torch.randn, generator=g, dtype=torch.float64)
    L, H, R, z = rand(5, 9, 9), rand(5, 4, 9), rand(5, 4).square() + 0.1, rand(5, 4)
    given = [x.requires_grad_() for x in (L @ L.mT, H, R, z)]
    of_dx, of_P = rand(5, 9), rand(5, 9, 9)

    def gradients(update):
        dx, _, P = update(*given)[:3]
        (of_prior, *others) = torch.autograd.grad((dx * of_dx).sum() + (P * of_P).sum(), given)
        return torch.lerp(of_prior, of_prior.mT, 0.5), *others

    for got, expected in zip(gradients(kalman_update), gradients(_compute_update), strict=True):
        assert torch.allclose(got, expected, rtol=1e-9, atol=1e-10)  # rounding: S is conditioned to some 1e3


@pytest.mark.parametrize("learned_through", [False, True])
def test_prediction_of_states_that_walk_is_the_dense_one(learned_through):
    """Value and gradients, also where Φ has one; P stays symmetric, so only that part of its gradient is told."""
    g = torch.Generator().manual_seed(2)
    rand = partial(torch.randn, generator=g, dtype=torch.float64)
    L, Phi = rand(5, 15, 15), torch.eye(15, dtype=torch.float64).repeat(5, 1, 1)
    Phi[:, :9] += rand(5, 9, 15)
    P, Q, of = (L @ L.mT).requires_grad_(), rand(5, 15, 15).requires_grad_(), rand(5, 15, 15)
    given = [P, Q, Phi.requires_grad_()] if learned_through else [P, Q]

    def gradients(predict):
        predicted = predict(P, Phi, Q)
        of_P, *others = torch.autograd.grad((predicted * of).sum(), given)
        return predicted, torch.lerp(of_P, of_P.mT, 0.5), *others

    for got, expected in zip(
        gradients(kalman_prediction), gradients(lambda P, Phi, Q: Phi @ P @ Phi.mT + Q), strict=True
    ):
        assert torch.allclose(got, expected, rtol=1e-12, atol=1e-12)  # rounding


def test_normalised_errors_lie_in_the_chi_square_band():
    """NEES of 15 states over 100 cars, errors drawn from what the filter is told; with a 20 s outage."""
    batch = hidden(scene(100, 60, seed=1), 30, 50)
    solution = integrate(batch, Mbkf(IMU), keep_covariances=True)
    e = errors(batch, solution)
    for t in (5, 20, 29, 40, 49, 59):
        P = solution.covariances.updated[:, t]
        nees = (e[:, t].unsqueeze(-1) * torch.linalg.solve(P, e[:, t].unsqueeze(-1))).sum()
        low, high = chi2.ppf([0.001, 0.999], 15 * 100)
        # second-order effects of a 5° heading error widen the band a little
        assert 0.93 * low < float(nees) < 1.10 * high, t
        assert torch.linalg.eigvalsh(P).min() > 0 and (P - P.mT).abs().max() == 0


def test_an_ins_gets_a_velocity_that_a_fix_lacks_from_its_positions():
    """From two of them, of a start with a wrong velocity; then it is that of the car but for what attitude does."""
    batch = scene(2, 20, seed=5)
    valid = batch.gnss_valid & (torch.arange(6) < 3)
    wrong = batch.start._replace(v_n=batch.start.v_n + 5.0)
    alone = integrate(replace(batch, gnss_valid=valid, start=wrong), Ins())
    off = (alone.posterior.v_n - batch.truth.v_n).norm(dim=-1)
    assert float(off[:, :1].min()) > 0.05 and float(off[:, 1:].max()) < 1.0


def test_filter_finds_the_biases_and_beats_pure_inertial():
    batch = hidden(scene(20, 90, seed=2), 60, 90)
    filtered, inertial = integrate(batch, Mbkf(IMU)), integrate(batch, Ins())
    before = (batch.true_imu_error - filtered.imu_error)[:, 59]
    assert before[:, :3].abs().mean() < 0.03 and before[:, 3:].abs().mean() < 2e-4
    drift = (filtered.posterior.p_n - batch.truth.p_n)[:, -1].norm(dim=-1)
    free = (inertial.posterior.p_n - batch.truth.p_n)[:, -1].norm(dim=-1)
    assert drift.median() < 0.05 * free.median()
    assert not inertial.posterior.p_n.isnan().any()


def test_outage_changes_nothing_but_the_missing_updates():
    """Hidden fixes are not looked at: the same solution whatever they say."""
    batch = hidden(scene(3, 30, seed=3), 10, 20)
    garbage = batch.gnss.clone()
    garbage[:, 10:20] = 1e6
    a, b = integrate(batch, Mbkf(IMU)), integrate(replace(batch, gnss=garbage), Mbkf(IMU))
    assert torch.equal(a.posterior.p_n, b.posterior.p_n)
    assert not a.used[:, 10:20].any() and a.used[:, 20:].all()
    assert torch.equal(a.prior.p_n[:, 10:20], a.posterior.p_n[:, 10:20])


def test_truth_is_never_read():
    """Every reference field replaced by NaN: the same solution."""
    batch = scene(2, 20, seed=4)
    blind = replace(
        batch,
        truth=NavState(*(torch.full_like(x, torch.nan) for x in batch.truth)),
        true_imu_error=torch.full_like(batch.true_imu_error, torch.nan),
        truth_valid=torch.zeros_like(batch.truth_valid),
        attitude_valid=torch.zeros_like(batch.attitude_valid),
    )
    a, b = integrate(batch, Mbkf(IMU)), integrate(blind, Mbkf(IMU))
    assert torch.equal(a.posterior.p_n, b.posterior.p_n)


def test_velocity_component_missing():
    """A fix without down velocity updates the other five components (comma2k19)."""
    batch = scene(4, 40, seed=5)
    valid = batch.gnss_valid.clone()
    valid[..., 5] = False
    gnss = batch.gnss.clone()
    gnss[..., 5] = 0.0
    solution = integrate(replace(batch, gnss=gnss, gnss_valid=valid), Mbkf(IMU))
    error = (solution.posterior.p_n - batch.truth.p_n)[:, 10:].norm(dim=-1)
    assert error.mean() < 0.2
    assert not solution.gain[..., 5].any()


def test_lever_arm_is_modelled():
    """An antenna 2 m off: with the arm the filter is as good as without one, ignoring it costs decimetres."""
    batch = scene(20, 40, seed=6, lever_arm=(1.0, 0.5, -1.5))
    good = integrate(batch, Mbkf(IMU))
    ignorant = integrate(replace(batch, lever_arm_b=torch.zeros_like(batch.lever_arm_b)), Mbkf(IMU))
    plain = scene(20, 40, seed=6)
    reference = integrate(plain, Mbkf(IMU))

    def rms(solution, batch):
        return (solution.posterior.p_n - batch.truth.p_n)[:, 15:].square().sum(-1).mean().sqrt()

    assert rms(good, batch) < 1.5 * rms(reference, plain)
    assert rms(ignorant, batch) > 5 * rms(good, batch)


@pytest.mark.parametrize("lag_s", [0.0, 0.3])
def test_the_lever_arm_turns_at_the_rate_of_the_fix(lag_s):
    """A body that rolls at 1.5 Hz over a road: the rate is that at the fix, to half of 0.02 s, where that of 0.1 s is
    50 ms behind."""
    batch, seen = scene(1, 3, seed=7, noise=False, lever_arm=(1.0, 0.5, -1.5)), []

    class Watching(Mbkf):
        def step(self, memory, epoch):
            seen.append(epoch)
            return super().step(memory, epoch)

    M = batch.imu.shape[2]
    t = (torch.arange(3 * M, dtype=torch.float64) + 0.5) * batch.dt
    imu = batch.imu.clone()
    imu[..., 3] = torch.cos(2 * math.pi * 1.5 * t).reshape(1, 3, M)
    lag = torch.full_like(batch.gnss_lag, lag_s)
    integrate(replace(batch, imu=imu, gnss_lag=lag), Watching(IMU))
    steepest = 2 * math.pi * 1.5
    for k, epoch in enumerate(seen):
        true = math.cos(2 * math.pi * 1.5 * (k + 1 - lag_s))
        assert abs(float(epoch.rate_at_fix_b[0, 0] + epoch.error.bias[0, 3]) - true) < 0.0101 * steepest


def test_late_fix_is_compared_at_its_own_time():
    """A fix 0.3 s before the epoch's end at 12 m/s: 3.6 m off if it were taken for the end."""
    batch = scene(20, 40, seed=7, noise=False, bias=torch.zeros(20, 6, dtype=torch.float64))
    shifted = replace(batch, gnss_lag=torch.full_like(batch.gnss_lag, 0.3))
    # where the car was 0.3 s earlier: run the clean strapdown and read the samples
    rows, state = [], batch.start
    for t in range(batch.size[1]):
        window = strapdown(state, batch.imu[:, t], batch.dt, batch.frame)
        at = window.interpolate_before(state, shifted.gnss_lag[:, t], batch.dt)
        rows.append(torch.cat((at.p_n, at.v_n), -1))
        state = window.end
    shifted = replace(shifted, gnss=torch.stack(rows, 1))
    solution = integrate(shifted, Mbkf(IMU))
    assert (solution.posterior.p_n - batch.truth.p_n).abs().max() < 5e-3  # linear between samples


def test_h_of_a_late_fix_matches_finite_differences():
    """0.3 s before the epoch's end: an error at its start, of IMU errors too, moves the innovation by H Φ dx."""
    batch = scene(4, 1, seed=7, lever_arm=(1.0, 0.5, -1.5))
    batch = replace(batch, gnss_lag=torch.full_like(batch.gnss_lag, 0.3))
    solution = integrate(batch, Mbkf(IMU), keep_covariances=True)
    H, Phi = solution.covariances.H[:, 0], solution.covariances.Phi[:, 0]

    class Started(Mbkf):
        """With another IMU error at the start."""

        def begin(self, batch):
            memory, error = super().begin(batch)
            return memory, error.update(dx, self.states)

    for i in range(15):
        dx = torch.zeros(4, 15, dtype=torch.float64)
        dx[:, i] = 1e-3
        moved = integrate(replace(batch, start=batch.start.correct(dx[:, :9])), Started(IMU))
        change = (moved.innovation - solution.innovation)[:, 0]
        # left out on purpose: between the fix and the end gravity's gradient and Coriolis (3e-4 of dx), and that the
        # car turns meanwhile, by which attitude and IMU errors count
        close = 1e-6 if i < 6 else 3e-5
        assert (change + (H @ Phi @ dx.unsqueeze(-1)).squeeze(-1)).abs().max() < close, i


def test_the_antenna_of_a_late_fix_swings_with_the_rate_of_its_own_time():
    """4 m of arm and a turn that changes by 0.1 rad/s²: the rate of 0.6 s later is 0.2 m/s off in velocity."""
    batch = scene(8, 30, seed=7, noise=False, bias=torch.zeros(8, 6, dtype=torch.float64), lever_arm=(4.0, 0.5, -1.5))
    late = replace(batch, gnss_lag=torch.full_like(batch.gnss_lag, 0.6))
    rows, state = [], batch.start
    for t in range(batch.size[1]):
        window = strapdown(state, batch.imu[:, t], batch.dt, batch.frame)
        then = NavState(window.p_n[:, 19], window.v_n[:, 19], window.C_nb[:, 19])
        rate = batch.imu[:, t, 19, 3:]
        rows.append(antenna(then, rate, batch.lever_arm_b, batch.frame))
        state = window.end
    late = replace(late, gnss=torch.stack(rows, 1))
    assert integrate(late, Mbkf(IMU)).innovation.abs().max() < 1e-4  # what an orthonormal C loses by interpolation


@pytest.mark.parametrize(("matrix", "level", "down"), [("none", 3, 4), ("scale", 3, 0), ("full", 0, 0)])
def test_what_a_filter_has_no_states_for_is_a_bias_of_gravity(matrix, level, down):
    """M f of a level car, f = (0, 0, −g): misalignment on the level axes, scale factor on the axis down."""
    turned = replace(IMU.accel, turn_on_bias=0.0, instability=0.0, misalignment=3e-3, scale_factor=4e-3)
    found = bias_sigma(replace(IMU, accel=turned), ErrorStates(matrix))[:3] / 9.80665e-3
    assert found.tolist() == pytest.approx([level, level, down], abs=1e-9)


def test_prior_mean_starts_the_bias():
    batch = scene(5, 5, seed=8, bias=torch.full((5, 6), 0.01, dtype=torch.float64))
    message = build_filter("mbkf15_prior", IMU, prior=Prior([0.01] * 6, [1e-4] * 6))
    solution = integrate(batch, message)
    assert (solution.imu_error - 0.01).abs().max() < 1e-3
    assert (solution.std[:, -1, 9:] < 2e-3).all()


@pytest.mark.parametrize("name,count", [("mbkf21_prior", 12), ("mbkf33_prior", 24)])
def test_a_prior_of_more_states_starts_the_sensor_matrices(name, count):
    batch = scene(3, 3, seed=8)
    M = 0.01 * torch.arange(1, count - 5, dtype=torch.float64)
    message = build_filter(name, IMU, prior=Prior([0.0] * 6 + M.tolist(), [1e-9] * count))
    start = message.begin(batch)[1]
    diagonal = start.matrix if start.matrix.ndim == 2 else start.matrix.diagonal(dim1=-2, dim2=-1).flatten(1)
    first = M[:6] if count == 12 else torch.cat((M[:3], M[9:12]))
    assert torch.equal(diagonal, first.expand(3, 6))
    solution = integrate(batch, message, keep_covariances=True)
    assert (solution.error.matrix[:, -1] - start.matrix).abs().max() < 1e-6


@pytest.mark.parametrize("name", MODEL_BASED)
def test_every_filter_runs_in_float32(name):

    prior = Prior([0.0] * 6, [0.1] * 6)  # which the others leave aside
    solution = integrate(scene(2, 10).in_precision(torch.float32), build_filter(name, IMU, prior=prior))
    assert solution.posterior.p_n.dtype == torch.float32 and solution.posterior.p_n.isfinite().all()


@pytest.mark.parametrize(
    "arguments,words",
    [
        ({"name": "mbkf99"}, "known filters"),
        ({"name": "mbkf15_prior"}, "prior.mean"),
        ({"name": "mbkf15_prior", "prior": Prior([0.0], [1.0])}, "6 values"),
        ({"name": "mbkf33_prior", "prior": Prior([0.0] * 6, [1.0] * 6)}, "24 values"),
    ],
)
def test_mistakes_are_one_clear_line(arguments, words):
    with pytest.raises(InputError, match=words) as error:
        build_filter(imu=IMU, **arguments)
    assert "\n" not in str(error.value)


def test_noise_is_the_preset_s_times_the_squared_factors():
    """White noise S = (f √S)²; a bias in the run 2σ²/τ + K² (Gauss-Markov while t ≪ τ), or the floor, times f²."""
    accel = SensorErrors(noise_density=2e-3, instability=3e-3, correlation_time=100.0, random_walk=1e-4)
    tuning = Tuning(accel_noise=3.0, gyro_noise=5.0, accel_walk=2.0, gyro_walk=4.0)
    psd = Mbkf(ImuSpec("made up", accel, SensorErrors(noise_density=1e-4)), tuning).psd()
    assert psd == pytest.approx(
        {
            "accel_noise": 9 * 4e-6,
            "gyro_noise": 25 * 1e-8,
            "accel_walk": 4 * (2 * 9e-6 / 100 + 1e-8),
            "gyro_walk": (4 * tuning.walk_floor_gyro) ** 2,
        },
        rel=1e-12,
    )


def test_the_rate_at_the_fix_is_that_of_the_last_tenth_of_a_second():
    """What turns the lever arm: five samples of 50 Hz, without the IMU error."""
    batch, seen = scene(2, 3), []

    class Watched(Ins):
        def step(self, memory, epoch):
            seen.append((epoch.rate_b, epoch.corrected))
            return super().step(memory, epoch)

    integrate(batch, Watched())
    for rate_b, corrected in seen:
        torch.testing.assert_close(rate_b, corrected[:, -5:, 3:].mean(1), rtol=0, atol=1e-15)


def test_compiled_solution_is_that_of_the_tensor_form():
    g = torch.Generator().manual_seed(0)
    A, X = (torch.randn(5, 7, n, generator=g, dtype=torch.float64) for n in (7, 3))
    S = A @ A.mT + torch.eye(7, dtype=torch.float64)
    with torch.no_grad():
        assert torch.allclose(S @ _solve(S, X), X, rtol=0, atol=1e-12)
    assert torch.allclose(S @ _solve(S, X), X, rtol=0, atol=1e-12)


def test_what_cannot_be_solved_is_not_finite_and_no_error():
    S, X = torch.zeros(1, 2, 2, dtype=torch.float64), torch.ones(1, 2, 3, dtype=torch.float64)
    with torch.no_grad():
        assert not _solve(S, X).isfinite().any()


@pytest.mark.parametrize("name", ["mbkf15", "mbkf33_car"])
def test_a_start_that_shows_the_gyroscopes_bias_is_weighed_against_what_is_known_of_the_imu(name):
    """The product of two Gaussians; a start that shows nothing changes nothing, and position to accelerometers stay."""
    batch = scene(3, 5, seed=1)
    estimator = build_filter(name, IMU)
    assert isinstance(estimator, Mbkf)
    prior = float(bias_sigma(IMU, estimator.states)[3])
    found = torch.tensor([[0.02, -0.01, 0.03]], dtype=torch.float64).expand(3, 3)
    std = torch.stack([torch.full((3,), s, dtype=torch.float64) for s in (prior, 0.1 * prior, math.inf)])
    memory, error = estimator.begin(replace(batch, start_gyro=torch.cat((found, std), -1)))
    plain, without = estimator.begin(batch)
    variance = 1 / (1 / prior**2 + 1 / std.square())
    assert torch.allclose(memory.P.diagonal(dim1=1, dim2=2)[:, 12:15], variance, rtol=1e-9)
    assert torch.allclose(error.bias[:, 3:], variance * found / std.square(), rtol=1e-9)
    others = [k for k in range(memory.P.shape[-1]) if k not in (12, 13, 14)]
    assert torch.equal(memory.P[:, others][:, :, others], plain.P[:, others][:, :, others])
    assert torch.equal(error.bias[:, :3], without.bias[:, :3]) and torch.equal(error.bias[2], without.bias[2])
