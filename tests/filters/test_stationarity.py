"""Standing is told from moving by how this very car sounds, whatever engine and IMU it has."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import ClassVar

import pytest
import torch

from dlkf.data.drive import EPOCHWISE, Batch
from dlkf.filters.build import build_filter
from dlkf.filters.constraints import CarConstraints
from dlkf.filters.integration import integrate
from dlkf.filters.stationarity import (
    APART,
    CHANGED_ACCEL,
    CHANGING_ACCEL,
    LEAST_FORCE,
    LEAST_RATE,
    MEMORY_S,
    REST_S,
    LastSecond,
    Rest,
    VibrationLevel,
    acceleration_std,
    detect_stationary,
)
from dlkf.filters.tuning import Tuning
from dlkf.navigation.attitude import rotation_from_rpy, rotation_from_vector
from dlkf.navigation.state import ACCEL, ATTITUDE, VELOCITY, NavState
from dlkf.navigation.strapdown import strapdown
from dlkf.onboard.compiled_filter import compile_filter
from dlkf.onboard.library import find_compiler

from .scene import IMU, M, beside, scene
from .test_constraints import driven, outage, slipping

D = torch.float64
STOP = 40.0  # s
SWAY = (2.3, 4.7)  # Hz


def shaken(
    idling: tuple[float, float], driving: tuple[float, float], hertz: tuple[float, float] = (9.3, 17.7)
) -> Batch:
    """Cars that stop after 40 s and shake with these amplitudes [m/s², rad/s], with GNSS for 20 s."""
    batch = slipping(8, 100, (0.0, 0.0, 0.0, 0.0, 0.0), stop=STOP)
    _, T, count = batch.size
    moving = batch.truth.v_n.norm(dim=-1)[..., None, None] > 0.01
    size = torch.where(moving, *(batch.imu.new_tensor(x).repeat_interleave(3) for x in (driving, idling)))
    t = (torch.arange(T * count, dtype=D) * batch.dt).reshape(1, T, count, 1)
    waves = torch.sin(2 * math.pi * torch.linspace(*hertz, 6, dtype=D) * t)
    return outage(replace(batch, imu=batch.imu + size * waves), 20, 100)


class Watched(CarConstraints):
    """Constraints that keep in which windows they found a standstill."""

    found: ClassVar[list[torch.Tensor]] = []

    def detect_rest(self, epoch, turning, prediction, memory):
        resting, liveliness, variance = super().detect_rest(epoch, turning, prediction, memory)
        self.found.append(resting)
        return resting, liveliness, variance


def steady(speeds: tuple[float, ...], epochs: int, stand_s: int = 10, ramp_s: float = 0.0):
    """Cars without vibration that stand for a while, speed up for 20 s, gently at first, and keep their speed [m/s]
    straight on."""
    base = scene(len(speeds), epochs, seed=12)
    a = torch.zeros(len(speeds), epochs * M, dtype=D)
    a[:, stand_s * M : (stand_s + 20) * M] = torch.tensor(speeds, dtype=D)[:, None] / 20
    if ramp_s:
        a[:, stand_s * M :] *= (torch.arange((epochs - stand_s) * M) / (M * ramp_s)).clamp_max(1.0)
    clean = torch.zeros(len(speeds), epochs * M, 6, dtype=D)
    start = NavState(torch.zeros(len(speeds), 3, dtype=D), torch.zeros(len(speeds), 3, dtype=D), base.start.C_nb * 0)
    start = start._replace(C_nb=torch.eye(3, dtype=D).repeat(len(speeds), 1, 1))
    clean[..., 0], clean[..., :3] = 0, -base.frame.gravity(start.p_n)[:, None]
    clean[..., 0] += a
    return driven(base, start, clean.reshape(len(speeds), epochs, M, 6))


@pytest.mark.parametrize("name", ["mbkf15_nhc", "mbkf21_car"])
def test_constant_speed_without_vibration_is_no_standstill(name):
    """The spread of the samples is the same in both, and the filter's 1σ of the speed grows to several m/s: two
    minutes without GNSS at 2 to 25 m/s, after a stop that it could learn from, hold no standstill."""
    batch = outage(steady((2.0, 6.7, 12.0, 17.1, 25.0), 180), 60, 180)
    taken = found(batch, name, accel_noise=30.0, accel_walk=100.0)
    assert taken[:, 2:9].any()  # under GNSS it is found
    assert not taken[:, 31:].any()


@pytest.mark.parametrize("name", ["mbkf15_nhc", "mbkf21_car", "mbkf33_car"])
def test_a_car_that_creeps_under_gnss_is_not_stopped(name):
    """At 0.4 to 0.8 m/s, as calm as at rest, with velocities of 5 cm/s: below the speed at which a filter alone may
    take it for a standstill."""
    batch = steady((0.4, 0.6, 0.8), 120)
    batch = replace(batch, gnss_std=torch.cat((batch.gnss_std[..., :3], 0 * batch.gnss_std[..., 3:] + 0.05), -1))
    taken, solution = watched(batch, name, accel_noise=30.0, accel_walk=100.0)
    assert taken[:, 2:9].all() and not taken[:, 40:].any()
    assert (solution.posterior.v_n - batch.truth.v_n)[:, 40:].norm(dim=-1).max() < 0.15


@pytest.mark.parametrize("name", ["mbkf21_car", "mbkf33_car"])
def test_a_car_that_pulls_away_in_an_outage_is_not_held_by_its_standstill(name):
    """Gently, while the filter's tilt may explain the acceleration: its force differs from that of the standstill. For
    three seconds; later its speed has to tell."""
    batch = outage(steady((2.0, 3.0, 4.0), 60, stand_s=30), 20, 60)  # 0.1 to 0.2 m/s²
    batch = replace(batch, start_std=torch.full_like(batch.start_std, 0.03))
    taken = found(batch, name, accel_noise=30.0, accel_walk=100.0)
    assert taken[:, 25:29].all() and not taken[:, 30:33].any()


def second(before: float, after: float, force: float):
    """A second in an outage in which the filter's speed changes so [m/s], with that force forward [m/s²]; P, in which
    tilt may explain much; and the prior level."""
    seen = []

    class Seen(CarConstraints):
        def detect_rest(self, epoch, turning, prediction, memory):
            seen.append((epoch, prediction.P, memory.prior))
            return super().detect_rest(epoch, turning, prediction, memory)

    kalman = build_filter("mbkf15_nhc", IMU)
    integrate(scene(1, 1), replace(kalman, sources=tuple(Seen(s.tuning, s.states) for s in kalman.sources)))
    epoch, P, prior = seen[0]
    P = P.clone()
    P[:, ATTITUDE, ATTITUDE] = 0.06**2 * torch.eye(3, dtype=D)
    along, level = torch.tensor([[1.0, 0.0, 0.0]], dtype=D), torch.eye(3, dtype=D)[None]
    start, end = (NavState(0 * along, v * along, level) for v in (before, after))
    noise = 1e-3 * torch.randn(1, M, 6, generator=torch.Generator().manual_seed(1), dtype=D)
    epoch = epoch._replace(
        corrected=torch.tensor([force, 0.0, -9.8, 0.0, 0.0, 0.0], dtype=D) + noise,
        error=epoch.error._replace(bias=0 * epoch.imu_error), start=start,
        window=epoch.window._replace(end=end), fix=epoch.fix._replace(used=epoch.used & False),
    )  # fmt: skip
    return epoch, P, prior


@pytest.mark.parametrize("last_force", [-1.3, -0.7])
def test_a_rolling_stop_is_no_standstill(last_force):
    """A car brakes at 0.7 m/s² from 0.75 to 0.05 m/s, as calm as at rest, and errors of tilt may explain that: a
    standstill if the force was the same a second before, none if the car braked harder, or if nothing is learned of
    it."""
    epoch, P, prior = second(0.75, 0.05, -0.7)
    before = VibrationLevel.begin(scene(1, 1))._replace(moving=torch.tensor([0.1], dtype=D))
    before = before._replace(rest=before.rest._replace(last_force=torch.tensor([[last_force, 0.0]], dtype=D)))
    turning = torch.zeros(1, 3, dtype=D)
    stationary, *_ = detect_stationary(epoch, turning, P, before, prior)
    assert stationary.item() == (last_force == -0.7)
    unlearned = before._replace(moving=torch.full_like(before.moving, math.inf))
    assert not detect_stationary(epoch, turning, P, unlearned, prior)[0].any()


@pytest.mark.parametrize("speed, calm_s, times_rest, expected", [
    (0.3, 0.0, 2.0, True), (0.3, 0.0, 20.0, False), (0.15, 0.0, 20.0, True), (0.35, 5.0, 20.0, False),
    (0.25, 5.0, 20.0, True), (0.6, 5.0, 2.0, True),
])  # fmt: skip
def test_a_level_of_creeping_is_a_standstill_at_a_smaller_speed(speed, calm_s, times_rest, expected):
    """A car whose motion is a thousand times the level of its rest, with a 1σ of the speed of 0.1 m/s: up to ten times
    that level 0.5 m/s, or 0.5 m/s + 3σ for two seconds, above 0.2 m/s, or 0.2 m/s + 1σ."""
    epoch, P, prior = second(speed, speed, 0.0)
    P[:, VELOCITY, VELOCITY] = 0.5 * 0.1**2 * torch.eye(3, dtype=D)
    before = VibrationLevel.begin(scene(1, 1))
    standing = before.second.update(epoch.corrected, epoch.dt)[1].level / times_rest
    seconds = torch.tensor([calm_s], dtype=D)
    before = before._replace(standing=standing, moving=1000 * standing, still_s=seconds, calm_s=seconds)
    assert detect_stationary(epoch, torch.zeros(1, 3, dtype=D), P, before, prior)[0].item() == expected


def test_a_force_that_changes_within_a_second_is_an_acceleration():
    rest = Rest.begin(torch.zeros(1, dtype=D), 2)
    at_rest, off = torch.tensor([[0.1, 0.0], [0.0, -0.1]], dtype=D), torch.tensor([1.2 * CHANGING_ACCEL, 0.0], dtype=D)
    assert not rest.is_changing(at_rest).any()  # nothing known
    rest = rest.update(at_rest, torch.tensor([True, False]), 1.0)
    assert rest.is_changing(at_rest + off).all() and not rest.is_changing(at_rest + 0.5 * off).any()


def test_sensors_that_round_find_the_same_standstills():
    """Gyroscopes that read the same in every sample at rest: their spread is 0 there, or what rounding leaves of it."""
    batch = shaken((0.05, 0.0), (0.2, 8e-3), SWAY)
    batch = outage(replace(batch, available=torch.ones_like(batch.available)), 60, 100)
    rest = (batch.truth.v_n.norm(dim=-1) < 0.01)[..., None, None]
    imu = batch.imu.clone()
    imu[..., 3:] = torch.where(rest, batch.true_imu_error[..., None, 3:], imu[..., 3:])
    noise = 1e-15 * torch.randn(imu.shape, generator=torch.Generator().manual_seed(3), dtype=D)
    noise[:, ::2] = 0.0
    taken = found(beside(replace(batch, imu=imu), replace(batch, imu=imu + rest * noise)), "mbkf21_car")
    assert taken.chunk(2)[0].equal(taken.chunk(2)[1])
    assert taken[:, 60:].float().mean() > 0.9


@pytest.mark.parametrize("name", ["mbkf15_nhc", "mbkf33_car"])
def test_a_gyroscope_that_reads_the_same_shows_nothing_of_its_bias(name):
    """It holds back its rate at rest: a bias that was found in motion stays, and the car is held all the same."""
    batch = shaken((0.05, 4e-3), (0.2, 8e-3), SWAY)
    batch = replace(batch, available=torch.ones_like(batch.available))
    rest = (batch.truth.v_n.norm(dim=-1) < 0.01)[..., None, None]
    imu = batch.imu.clone()
    imu[..., 3:] += 0.004  # 0.2 °/s
    usual = replace(batch, imu=imu.clone())
    imu[..., 5:] = torch.where(rest, 0.0, imu[..., 5:])
    silent = replace(batch, imu=imu)
    taken, solution = watched(beside(usual, silent), name)
    assert taken[:, int(STOP) + 3 :].float().mean() > 0.8
    at, end = int(STOP) - 1, -1
    moved = (solution.imu_error[:, end, 5] - solution.imu_error[:, at, 5]).abs().chunk(2)
    off = (solution.imu_error[:, end, 5] - batch.true_imu_error[:, end, 5].repeat(2) - 0.004).abs().chunk(2)
    assert off[0].max() < 1e-3 and moved[1].max() < 1e-3


def test_the_force_of_a_standstill_is_known_during_it_and_for_seconds_after():
    rest = Rest.begin(torch.zeros(1, dtype=D), 2)
    at_rest, off = torch.tensor([[0.1, 0.0], [0.0, -0.1]], dtype=D), torch.tensor([1.2 * CHANGED_ACCEL, 0.0], dtype=D)
    assert not rest.has_changed(at_rest).any()  # nothing known
    for _ in range(3):
        rest = rest.update(at_rest, torch.tensor([True, True]), 1.0)
    assert rest.has_changed(at_rest + off).all() and not rest.has_changed(at_rest + 0.5 * off).any()
    for _ in range(int(REST_S)):
        rest = rest.update(at_rest + off, torch.tensor([False, True]), 1.0)
    assert rest.has_changed(at_rest + off).tolist() == [True, False]  # the second one stands on another slope
    rest = rest.update(at_rest + off, torch.tensor([False, False]), 1.0)
    assert not rest.has_changed(at_rest + 10 * off)[0]


def test_a_smoother_road_than_any_before_is_no_standstill():
    """Cars that have shaken some three times as much in motion as at rest shake no more than that on the next road."""
    batch = steady((6.7, 12.0, 17.1), 160)
    t = torch.arange(160 * M, dtype=D) * batch.dt
    size = torch.where((t > 10) & (t < 60), 0.06, 0.02).reshape(1, 160, M, 1)
    waves = torch.sin(2 * math.pi * torch.linspace(9.3, 17.7, 6, dtype=D) * t.reshape(1, 160, M, 1))
    shaken_ = batch.imu + size * waves * torch.tensor([1.0] * 3 + [0.01] * 3, dtype=D)
    batch = outage(replace(batch, imu=shaken_), 60, 160)
    taken = found(batch, "mbkf21_car", accel_noise=30.0, accel_walk=100.0)
    assert taken[:, 2:9].any() and not taken[:, 31:].any()


@pytest.mark.parametrize("moves", [False, True])
def test_the_uncertainty_of_an_acceleration_is_that_of_the_strapdown(moves):
    """Tilt C = exp([δh×]) Ĉ and bias errors of a car that is stationary, or brakes in a bend, pushed through the
    strapdown one by one: the mean acceleration of a second, with a covariance in which tilt and bias hang together."""
    base = scene(1, 1)
    C = rotation_from_rpy(torch.tensor([[0.1, -0.2, 0.7]], dtype=D))
    zero, g = torch.zeros(1, 3, dtype=D), base.frame.gravity(torch.zeros(1, 3, dtype=D))
    force_n = torch.tensor([[-4.0 * moves, 3.0 * moves, 0.0]], dtype=D) - g

    def acceleration(tilt: torch.Tensor, bias: torch.Tensor) -> torch.Tensor:
        """Of the truth where the estimate stands still: its attitude is turned, its samples have that much less."""
        force = ((C.mT @ force_n[..., None])[..., 0] - bias).expand(1, M, 3)
        state = NavState(zero, zero, rotation_from_vector(tilt) @ C)
        return strapdown(state, torch.cat((force, 0 * force), -1), base.dt, base.frame).end.v_n[0, :2]

    step = 1e-5 * torch.eye(3, dtype=D)
    at_rest = acceleration(zero, zero)
    columns = [acceleration(x[None], zero) for x in step] + [acceleration(zero, x[None]) for x in step]
    J = (torch.stack(columns, -1) - at_rest[:, None]) / 1e-5
    A = torch.randn(9 + 6, 9 + 6, generator=torch.Generator().manual_seed(3), dtype=D)
    P = (A @ A.mT)[None]
    of = [*range(*ATTITUDE.indices(15)), *range(*ACCEL.indices(15))]
    expected = (J @ P[0][of][:, of] @ J.mT).trace().sqrt()
    torch.testing.assert_close(acceleration_std(P, C, force_n if moves else None)[0], expected, rtol=2e-3, atol=0)


def found(batch, name: str = "mbkf15_nhc", **tuning: float):
    """(B, T): windows taken for a standstill by a filter with constraints."""
    return watched(batch, name, **tuning)[0]


@torch.inference_mode()
def watched(batch, name: str = "mbkf15_nhc", **tuning: float):
    """The same, and the solution."""
    kalman = build_filter(name, IMU, tuning=Tuning(**tuning))
    Watched.found.clear()
    sources = tuple(Watched(s.tuning, s.states) if isinstance(s, CarConstraints) else s for s in kalman.sources)
    solution = integrate(batch, replace(kalman, sources=sources))
    return torch.stack(Watched.found, 1), solution


def test_the_first_stop_is_found_however_the_engine_idles():
    """In an outage, by a car that GNSS has only seen in motion; three times as lively when it moves."""
    engines = [(0.02, 2e-4), (0.2, 2e-3), (0.5, 5e-3)]
    batch = beside(*(shaken(idling, (1.7 * idling[0], 4 * idling[1])) for idling in engines))
    speed = batch.truth.v_n.norm(dim=-1)
    before = torch.cat((speed[:, :1], speed[:, :-1]), 1)
    rest, moving = (speed < 0.01) & (before < 0.01), speed > 0.5
    taken, held = watched(batch)
    for of_engine, resting in zip(taken.chunk(3), rest.chunk(3)):
        assert of_engine[resting].float().mean() > 0.95
    assert not taken[moving].any()
    # a standing car's position is worth what it was when it stopped, 20 s into the outage
    free = integrate(batch, build_filter("mbkf15", IMU))
    off = [(x.posterior.p_n - batch.truth.p_n)[:, -1, :2].norm(dim=-1).unflatten(0, (3, -1)) for x in (held, free)]
    held_m, free_m = (x.square().mean(1).sqrt() for x in off)
    assert (held_m < 0.2 * free_m).all()


@pytest.mark.parametrize("per_second", [1, 5])
def test_an_engine_that_shakes_more_than_the_road_hides_no_stop(per_second):
    """It idles at 12 to 22 Hz with three times what the car shakes by in motion, which also sways at 1 to 3 Hz. In an
    outage, by a car that GNSS has only seen in motion, whatever the update interval."""
    batch = shaken((0.6, 6e-3), (0.2, 2e-3))
    t = torch.arange(100 * M, dtype=D).reshape(1, 100, M, 1) * batch.dt
    sway = torch.sin(2 * math.pi * torch.tensor([1.1, 1.7, 2.3, 2.9, 1.3, 1.9], dtype=D) * t)
    moving = batch.truth.v_n.norm(dim=-1)[..., None, None] > 0.01
    batch = replace(batch, imu=batch.imu + moving * sway * torch.tensor([0.3] * 3 + [2e-2] * 3, dtype=D))
    speed = batch.truth.v_n.norm(dim=-1)
    standing = speed < 0.01
    standing[:, 2:] &= standing[:, 1:-1] & standing[:, :-2]
    cut = in_parts(batch, per_second) if per_second > 1 else batch
    taken = found(cut).unflatten(1, (100, per_second))
    assert taken[standing].float().mean() > 0.8
    assert not taken[speed > 0.5].any()


def test_the_level_is_that_of_a_second_whatever_the_update_interval():
    """The spread of ten means, against numpy; of fewer than two means a second there is none."""
    batch = scene(2, 3, seed=5)
    boxes = batch.imu.numpy().reshape(2, 3, 10, M // 10, 6).mean(3)
    variance = boxes.var(2, ddof=1)
    force, rate = variance[..., :3].sum(-1), variance[..., 3:].sum(-1)
    expected = ((force + LEAST_FORCE**2) * (rate + LEAST_RATE**2)) ** 0.5
    for per_second in (1, 5, 10, 50):
        cut = in_parts(batch, per_second) if per_second > 1 else batch
        second, levels = LastSecond.begin(cut), []
        for k in range(cut.size[1]):
            second, (level, mean, whole, of_rate) = second.update(cut.imu[:, k], cut.dt)
            assert level is not None
            levels.append(level)
        torch.testing.assert_close(torch.stack(levels, 1)[:, per_second - 1 :: per_second], torch.from_numpy(expected))
        torch.testing.assert_close(mean, batch.imu[:, -1, -max(M // per_second, M // 5) :].mean(1))
        torch.testing.assert_close(of_rate, 0.1 * per_second * torch.from_numpy(variance[:, -1, 3:]))
        assert all(x.isinf().all() for x in levels[: per_second - 1])
    for rate in (10, 26, 64, 125, 128, 208, 416):  # a second has all that it needs
        whole = replace(batch, imu=torch.zeros(2, 3, rate, 6, dtype=D), dt=1 / rate)
        assert LastSecond.begin(whole).means is None
    for rate in range(10, 60):  # nor does it matter whether means of 0.1 s divide it
        x = batch.imu[:, :, :1].expand(-1, -1, rate, -1) + torch.arange(rate, dtype=D)[:, None] / rate
        level = LastSecond.begin(replace(batch, imu=x, dt=1 / rate)).update(x[:, 0], 1 / rate)[1].level
        torch.testing.assert_close(level, torch.full((2,), 3 / 12, dtype=D), rtol=0.4, atol=0.0)
    slow = replace(batch, imu=batch.imu.mean(2, keepdim=True), dt=1.0)
    assert LastSecond.begin(slow).update(slow.imu[:, 0], 1.0)[1].level is None


def positions_alone(batch: Batch) -> Batch:
    """With fixes of centimetres and no velocity, throughout."""
    valid, std = batch.gnss_valid.clone(), torch.full_like(batch.gnss_std, 0.02)
    valid[..., 3:] = False
    noise = 0.02 * torch.randn(*batch.gnss.shape, generator=torch.Generator().manual_seed(9), dtype=D)
    gnss = torch.cat((batch.truth.p_n, batch.truth.v_n), -1) + noise
    return replace(batch, gnss=gnss, gnss_std=std, gnss_valid=valid, available=torch.ones_like(batch.available))


def test_positions_alone_show_how_a_car_shakes_at_rest():
    """As velocities do: a stop in an outage is found by a car that has stood and moved under positions alone."""
    batch = positions_alone(shaken((0.4, 4e-3), (0.8, 1.6e-2), SWAY))
    batch = outage(batch, 60, 100)
    taken, speed = found(batch), batch.truth.v_n.norm(dim=-1)
    assert taken[:, 60:].float().mean() > 0.95 and not taken[speed > 0.5].any()


def test_a_standstill_that_fixes_show_is_one_at_any_vibration():
    """An engine that idles more lively than the car rolls: no level of vibration shows its stop, but fixes do, with
    velocities and without, and the gyroscopes' bias is learned there."""
    batch = shaken((0.4, 4e-3), (0.04, 4e-4), SWAY)
    shown = positions_alone(batch), replace(batch, available=torch.ones_like(batch.available))
    taken, solution = watched(beside(*shown, *(outage(x, 30, 100) for x in shown)))
    speed = batch.truth.v_n.norm(dim=-1)
    rest = torch.stack([speed.roll(k, 1) < 0.01 for k in range(5)]).all(0)
    rest[:, :5] = False
    for part in taken[:16].chunk(2):
        assert part[rest].float().mean() > 0.9 and not part[speed > 0.5].any()
    assert not taken[16:, 30:].any()
    bias = solution.imu_error[:16, -1, 5]
    assert (bias - batch.true_imu_error[:, -1, 5].repeat(2)).abs().max() < 2e-4


def test_fixes_that_show_a_creeping_car_stop_it_not():
    batch = steady((0.3, 0.5), 60, stand_s=0)
    noise = 0.5 * torch.randn(*batch.imu.shape, generator=torch.Generator().manual_seed(1), dtype=D)
    batch = positions_alone(replace(batch, imu=batch.imu + noise * torch.tensor([1.0] * 3 + [0.02] * 3, dtype=D)))
    assert not found(batch, accel_noise=30.0, gyro_noise=10.0)[:, 20:].any()


@pytest.mark.parametrize("name", ["mbkf21_nhc", "mbkf21_car"])
def test_a_smooth_car_moves_off_under_positions_of_metres(name):
    """Silent cars move off gently; of the tilt 4° are unknown, which would explain it. While nothing is learned of the
    car, that counts for little, so that an acceleration is not taken for a standstill over and over."""
    batch = steady((20.0, 25.0, 30.0), 30, stand_s=2, ramp_s=4.0)
    noise = 1.5 * torch.randn(*batch.gnss.shape, generator=torch.Generator().manual_seed(4), dtype=D)
    valid, std = batch.gnss_valid.clone(), batch.start_std.clone()
    valid[..., 3:], std[:, 3:6], std[:, 6:8] = False, 0.7, math.radians(4)
    batch = replace(
        batch, gnss=batch.gnss + noise, gnss_std=torch.full_like(batch.gnss_std, 1.5), gnss_valid=valid, start_std=std
    )
    taken, solution = watched(batch, name, accel_noise=25.0, gyro_noise=4.0)
    assert not taken[batch.truth.v_n.norm(dim=-1) > 2].any()
    assert (solution.posterior.p_n - batch.truth.p_n)[:, 10:, :2].norm(dim=-1).max() < 8.0


def in_parts(batch: Batch, n: int = 5) -> Batch:
    """The same samples and fixes in n times as many update intervals; between the boundaries is not the truth."""
    B, T, count = batch.size
    rows = {name: getattr(batch, name) for name in EPOCHWISE}
    truth = NavState(*(x.repeat_interleave(n, 1) for x in rows.pop("truth")))
    rows = {name: x.repeat_interleave(n, 1) for name, x in rows.items()}
    last = torch.arange(n * T) % n == n - 1
    rows["imu"], rows["available"] = batch.imu.reshape(B, n * T, count // n, 6), rows["available"] & last
    return replace(batch, truth=truth, **rows)


def test_shorter_update_intervals_find_the_same_standstills():
    """A fifth of a second is too short for a spread or for an acceleration: seconds are judged. Cars that stop and
    cars that keep their speed, in an outage."""
    stop = shaken((0.02, 2e-4), (0.06, 8e-4))
    batch = beside(stop, outage(steady((2.0, 6.7), 100), 60, 100))
    speed = batch.truth.v_n.norm(dim=-1)
    before = torch.cat((speed[:, :1], speed[:, :-1]), 1)
    taken = found(in_parts(batch)).unflatten(1, (-1, 5))
    stops = len(stop.imu)
    assert taken[:stops][((speed < 0.01) & (before < 0.01))[:stops]].float().mean() > 0.9
    assert not taken[(speed > 1.0) & (before > 1.0)].any()


@pytest.mark.whole
@pytest.mark.skipif(find_compiler() is None, reason="no C compiler here")
def test_the_last_second_is_the_same_in_c():
    """Update intervals of a fifth, whose means are kept from one to the next; a stop in an outage."""
    batch, kalman = in_parts(shaken((0.02, 2e-4), (0.2, 8e-3), SWAY)), build_filter("mbkf21_car", IMU)
    with torch.inference_mode():
        both = [integrate(batch, kalman), compile_filter(kalman, 1 / batch.dt, batch.epoch_s).integrate(batch)]
    torch.testing.assert_close(both[1].posterior.p_n, both[0].posterior.p_n, rtol=0, atol=1e-9)


def test_a_moment_without_acceleration_is_no_standstill():
    """Silent cars speed up and slow down by turns of a second at 2 m/s, without GNSS and with a speed known to 0.6 m/s:
    between the turns a fifth of a second shows no acceleration."""
    batch = outage(steady((2.0, 2.5), 40, stand_s=0), 0, 40)
    swing = torch.sin(math.pi * (torch.arange(40 * M, dtype=D) / M)).reshape(40, M)
    imu, std = batch.imu.clone(), batch.start_std.clone()
    imu[..., 0] += swing
    std[:, 3:6] = 0.6
    start = batch.start._replace(v_n=batch.start.v_n + 2.0 * batch.start.C_nb[..., 0])
    taken = found(in_parts(replace(batch, imu=imu, start=start, start_std=std)), "mbkf21_car")
    assert not taken.any()


def test_constraints_say_as_much_in_a_second_of_shorter_update_intervals():
    batch = outage(slipping(4, 90, (0.0, 0.0, 0.0, 0.0, 0.0)), 60, 90)
    kalman = build_filter("mbkf15_nhc", IMU)
    whole, fifths = (integrate(x, kalman).std[:, -1, 3:9] for x in (batch, in_parts(batch)))
    torch.testing.assert_close(fifths, whole, rtol=0.06, atol=0)
    assert (integrate(batch, build_filter("mbkf15", IMU)).std[:, -1, 3:5] > 2 * whole[:, :2]).any()


def test_one_sample_an_epoch_has_no_spread():
    """At 1 Hz in epochs of 1 s: no standstill, and nothing that is no number, neither told nor kept."""
    batch = shaken((0.02, 2e-4), (0.04, 4e-4))
    slow = replace(batch, imu=batch.imu.mean(2, keepdim=True), dt=batch.dt * batch.size[2])
    heard: list[VibrationLevel] = []

    class Hearing(CarConstraints):
        def detect_rest(self, epoch, turning, prediction, memory):
            resting, liveliness, variance = super().detect_rest(epoch, turning, prediction, memory)
            heard.append(liveliness)
            assert not resting.any()
            return resting, liveliness, variance

    kalman = build_filter("mbkf15_nhc", IMU)
    sources = tuple(Hearing(s.tuning, s.states) if isinstance(s, CarConstraints) else s for s in kalman.sources)
    solution = integrate(slow, replace(kalman, sources=sources))
    assert len(heard) == 100 and solution.posterior.p_n.isfinite().all() and solution.std.isfinite().all()
    assert not any(x.isnan().any() for x in heard[-1][:5])


def test_what_is_heard_sets_the_limit_half_way():
    nothing = VibrationLevel.begin(scene(3, 1))
    prior = torch.tensor([3e-3], dtype=D)
    none = torch.full((3,), math.inf, dtype=D)
    torch.testing.assert_close(nothing.thresholds(prior)[0], prior.expand(3) / APART**0.5)
    moved = nothing.update(none, torch.tensor([4e-2, 4e-3, 4e-4], dtype=D), 1.0)
    torch.testing.assert_close(moved.thresholds(prior)[0], moved.moving / APART**0.5)
    both = moved.update(torch.tensor([1e-3, 1e-3, 1e-3], dtype=D), none, 1.0)
    limits = torch.tensor([(4e-2 * 1e-3) ** 0.5, (4e-3 * 1e-3) ** 0.5, 3e-3 / APART], dtype=D)
    torch.testing.assert_close(both.thresholds(prior)[0], limits)  # the third sounds alike, louder when it stands


def test_a_wrong_second_is_forgotten():
    """Multipath that moves a standing car teaches that moving is quiet; later seconds of motion mend it."""
    heard = VibrationLevel.begin(scene(1, 1))
    none = torch.full((1,), math.inf, dtype=D)
    heard = heard.update(none, torch.tensor([1e-4], dtype=D), 1.0)
    for _ in range(int(5 * MEMORY_S)):
        heard = heard.update(none, torch.tensor([1e-2], dtype=D), 1.0)
    assert heard.moving.item() == pytest.approx(1e-2)


def positions_of_metres(batch: Batch) -> Batch:
    """With fixes of 1.5 m and no velocity."""
    noise = 1.5 * torch.randn(*batch.gnss.shape, generator=torch.Generator().manual_seed(9), dtype=D)
    gnss, valid = torch.cat((batch.truth.p_n, batch.truth.v_n), -1) + noise, batch.gnss_valid.clone()
    valid[..., 3:] = False
    return replace(batch, gnss=gnss, gnss_std=torch.full_like(batch.gnss_std, 1.5), gnss_valid=valid)


def test_positions_of_metres_show_how_a_car_shakes_in_motion():
    """By the mean speed over some seconds: a stop in an outage is found though the engine idles more lively than any
    car is taken to before it is known."""
    batch = positions_of_metres(shaken((0.3, 5e-3), (3.0, 1e-1), SWAY))
    speed = batch.truth.v_n.norm(dim=-1)
    taken = found(outage(replace(batch, available=torch.ones_like(batch.available)), 35, 100))
    assert taken[:, 45:].float().mean() > 0.9 and not taken[speed > 0.5].any()


def test_a_smooth_car_of_unknown_speed_is_not_stopped_at_the_start():
    """At 3 to 5 m/s, known to 2 m/s from two positions: a car of which nothing is known may be silent."""
    batch = steady((3.0, 5.0), 60, stand_s=0)
    rows = {k: getattr(batch, k) for k in EPOCHWISE}
    truth = rows.pop("truth")
    start, truth = NavState(*(x[:, 29] for x in truth)), NavState(*(x[:, 30:] for x in truth))
    std = batch.start_std.clone()
    std[:, 3:6] = 2.0
    rows = {k: x[:, 30:] for k, x in rows.items()}
    batch = positions_of_metres(replace(batch, truth=truth, start=start, start_std=std, **rows))
    assert not found(batch, "mbkf21_car")[:, :20].any()


def test_a_second_as_calm_as_a_standstill_is_none():
    """Cars that creep at 1.4 m/s in an outage, known to 0.4 m/s, and do not shake for a second."""
    batch = steady((1.4, 1.45), 100)
    t = torch.arange(100 * M, dtype=D).reshape(1, 100, M, 1) * batch.dt
    waves = torch.sin(2 * math.pi * torch.linspace(9.3, 17.7, 6, dtype=D) * t) * ((t > 10) & ((t < 80) | (t > 81)))
    imu = batch.imu + waves * torch.tensor([0.3] * 3 + [1e-2] * 3, dtype=D)
    taken = found(outage(replace(batch, imu=imu), 60, 100), "mbkf21_car", accel_noise=60.0, accel_walk=100.0)
    assert taken[:, 2:9].any() and not taken[:, 31:].any()


def test_the_limit_of_a_long_rest_lies_above_the_least_level():
    none, nothing = torch.full((4,), math.inf, dtype=D), VibrationLevel.begin(scene(4, 1))
    assert nothing.resting_limit().isinf().all()
    moved = nothing.update(none, torch.tensor([9e-3, 9e-3, 3e-5, 9e-3], dtype=D), 1.0)
    torch.testing.assert_close(moved.resting_limit(), moved.moving / 15)
    both = moved.update(torch.tensor([9e-6, 1.125e-3, 1e-5, math.inf], dtype=D), none, 1.0)
    # a third of the way as logarithms: ten times as loud, twice, 1.4 times; the last as before
    limits = torch.tensor([9e-5, 2.25e-3, 1e-5 * 3 ** (1 / 3), 6e-4], dtype=D)
    torch.testing.assert_close(both.resting_limit(), limits)


def test_a_long_rest_is_one_against_the_filters_speed():
    """An accelerometer is off for twenty seconds that end at the stop, in an outage: the filter's speed there is off by
    4 to 9σ, which ten seconds show."""
    batch = shaken((0.02, 2e-4), (0.2, 8e-3))
    imu = batch.imu.clone()
    imu[:, 20:40, :, 0] += 0.25
    batch = replace(batch, imu=imu)
    taken, solution = watched(batch, "mbkf21_car", accel_noise=15.0)
    wrong = (solution.posterior.v_n.norm(dim=-1) > 4 * solution.std[..., 3:5].norm(dim=-1))[:, 41]
    taken = taken[wrong]
    assert len(taken) > 2 and not taken[:, 41:48].any() and taken[:, 50].all()


def test_a_silent_road_after_a_rough_one_is_no_standstill():
    """Cars that GNSS has seen on a rough road alone go on at constant speed, as silent as at rest, for 100 s.
    (Below 10 m/s the filter's 1σ alone speaks against it.)"""
    batch = steady((12.0, 17.1, 25.0), 160)
    t = torch.arange(160 * M, dtype=D).reshape(1, 160, M, 1) * batch.dt
    waves = torch.sin(2 * math.pi * torch.linspace(9.3, 17.7, 6, dtype=D) * t) * ((t > 10) & (t < 60))
    imu = batch.imu + waves * torch.tensor([0.5] * 3 + [2e-2] * 3, dtype=D)
    taken = found(outage(replace(batch, imu=imu), 60, 160), "mbkf21_car", accel_noise=15.0)
    assert taken[:, 2:9].any() and not taken[:, 31:].any()
