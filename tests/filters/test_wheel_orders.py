"""Speed from the wheels' orders in the vibration of an IMU."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from dlkf.data.segments import StartLaw, cut_segments, make_batch
from dlkf.data.stack import DriveStack
from dlkf.data.store import drive_from_tables
from dlkf.data.tables import DriveRow
from dlkf.data.validate import CheckedTables
from dlkf.filters.aids.attach import aid_columns
from dlkf.filters.build import build_filter, is_filter
from dlkf.filters.integration import integrate
from dlkf.filters.order_spectrum import (
    LEAST,
    LINES,
    ORDERS,
    STEP,
    WAVES,
    demodulate,
    log_levels,
    log_likelihood,
    log_likelihood_of_phase,
    log_lines,
    relative,
    rotated,
)
from dlkf.filters.wheel_line import DETECTED, WheelLine
from dlkf.filters.wheel_orders import OrdersMemory, _gaussian
from tests.cars import car

from .scene import IMU, RATE

TURNS = 0.52  # of a wheel per metre
ROUGH = replace(
    IMU, accel=replace(IMU.accel, noise_density=0.05), gyro=replace(IMU.gyro, noise_density=2e-3)
)  # with what the road adds
KALMAN, AIDED = "mbkf21_nhc", "mbkf21_nhc+wheel_orders"


def cars(count, epochs, turns_hz, seed=0, size=0.4, epoch_s=1.0):
    """Cars at 10 ± 3 m/s on a plane road, in road noise, that two axes show a tone of and its second harmonic, whose
    phase (turns) is a function of time t and distance s."""
    tables = car(epochs * epoch_s + 1.0, RATE)
    t = tables["imu"]["t"].to_numpy() - 0.5 / RATE
    phase = 2 * np.pi * turns_hz(t, 10 * t + 15 * (1 - np.cos(0.2 * t)))
    drives = []
    for k in range(count):
        rng = np.random.default_rng((seed, k))
        imu = {str(c): tables["imu"][c].to_numpy(copy=True) for c in tables["imu"]}
        for axis, scale in (("accel", 1.0), ("gyro", 0.05)):
            for c in "xyz":
                bias = 0.2 * scale * size * rng.normal()
                imu[f"{axis}_{c}"] += bias + 0.5 * scale * size * rng.normal(size=len(t))
            for order in (1, 2):
                imu[f"{axis}_y"] += size * scale * np.sin(order * phase + k)
        others = [{str(c): tables[n][c].to_numpy(copy=True) for c in tables[n]} for n in ("gnss", "reference")]
        row = DriveRow(f"car-{k}", "cars", (0.0, 0.0, 0.0))
        drives.append(drive_from_tables(CheckedTables(row, imu, *others), "cars", RATE, epoch_s, torch.float64))
    stack = DriveStack(drives)
    segments = cut_segments(stack, epochs * epoch_s, epochs * epoch_s)
    law, generator = StartLaw(0.1, 0.1, 1.0, 2.0), torch.Generator().manual_seed(seed)
    return make_batch(stack, segments, dtype=torch.float64, start=law, generator=generator)


def wheel(t, s):
    return TURNS * s


def fixed(t, s):
    return 7.0 * t


def half(t, s):
    return 3.0 * t + 0.25 * s


def without_fixes(batch, first):
    """With an outage from an epoch on."""
    return replace(batch, available=batch.available & (torch.arange(batch.size[1]) < first))


def run(batch, name):
    with torch.no_grad():
        return integrate(batch, build_filter(name, ROUGH), keep_covariances=True)


def memory(batch, name=AIDED) -> OrdersMemory:
    """What the source has learned at the end of a batch."""
    from dlkf.filters.integration import Fix, advance
    from dlkf.navigation.calibration import ImuError

    kalman = build_filter(name, ROUGH)
    with torch.no_grad():
        carried, bias = kalman.begin(batch)
        state, error = batch.start, ImuError.of(bias)
        for k in range(batch.size[1]):
            used = batch.gnss_valid[:, k] & batch.available[:, k, None]
            fix = Fix(batch.gnss[:, k], batch.gnss_std[:, k], used, None)
            carried, step = advance(
                kalman, carried, state, error, batch.imu[:, k], fix, dt=batch.dt, frame=batch.frame.prepared(),
                lever_arm_b=None,
            )  # fmt: skip
            state, error = step.posterior, step.error
    return next(x for x in carried.sources if isinstance(x, OrdersMemory))


def horizontal(solution, batch):
    return (solution.posterior.p_n - batch.truth.p_n)[..., :2].norm(dim=-1)


def test_the_spectrum_is_the_sum_that_its_equation_says():
    g = torch.Generator().manual_seed(3)
    x = torch.randn(2, 40, 6, generator=g, dtype=torch.float64)
    s = torch.rand(2, 40, generator=g, dtype=torch.float64).cumsum(1)
    begin = torch.randn(2, 6, WAVES, generator=g, dtype=torch.float64)
    got = (demodulate(x, s, begin) - begin).unflatten(-1, (2, len(ORDERS), LINES))
    for number, order in enumerate(ORDERS):
        for line in (0, 7, 8, LINES - 1):
            kappa = LEAST + STEP * line
            assert torch.exp(log_lines(x))[line] == pytest.approx(kappa)
            angle = 2 * math.pi * order * kappa * s
            expected = torch.stack([(f(angle).unsqueeze(-1) * x).sum(1) for f in (torch.cos, torch.sin)], -1)
            assert torch.allclose(got[..., number, line], expected, atol=1e-12)


def test_levels_have_no_mean_over_the_neighbours():
    g = torch.Generator().manual_seed(4)
    spectrum = torch.randn(1, 6, WAVES, generator=g, dtype=torch.float64)
    power = spectrum.unflatten(2, (2, len(ORDERS), LINES)).square().sum(2).log()
    levels = log_levels(spectrum)
    for k in (0, 10, 30, LINES - 1):
        near = power[..., max(0, k - 16) : k + 17]
        assert torch.allclose(levels[..., k], power[..., k] - near.mean(-1), atol=1e-9)


def test_a_spectrum_relative_to_its_noise_has_power_one_and_the_phase_it_had():
    g = torch.Generator().manual_seed(5)
    spectrum = 30 * torch.randn(400, 6, WAVES, generator=g, dtype=torch.float64)
    got = relative(spectrum).unflatten(2, (2, -1))
    power = got.square().sum(2)
    assert power.max() <= 4 + 1e-9  # a knock is no line
    assert power[power < 3.9].mean() == pytest.approx(1 - 4.9 * math.exp(-3.9) / (1 - math.exp(-3.9)), abs=0.04)
    whole = spectrum.unflatten(2, (2, -1))
    assert torch.allclose(torch.atan2(got[:, :, 1], got[:, :, 0]), torch.atan2(whole[:, :, 1], whole[:, :, 0]))


def test_a_rotated_spectrum_is_that_of_a_distance_counted_from_further_on():
    g = torch.Generator().manual_seed(6)
    x = torch.randn(2, 40, 6, generator=g, dtype=torch.float64)
    s = torch.rand(2, 40, generator=g, dtype=torch.float64).cumsum(1)
    nothing, further = torch.zeros(2, 6, WAVES, dtype=torch.float64), torch.tensor([3.0, -41.5]).double()
    expected = demodulate(x, s - further[:, None], nothing)
    assert torch.allclose(rotated(demodulate(x, s, nothing), further), expected, atol=1e-11)


def test_the_likelihood_of_phase_is_that_of_gaussian_noise_about_a_template():
    """ln p(Z | h) − ln p(Z | 0) of complex noise of power 1, times its share."""
    g = torch.Generator().manual_seed(7)
    Z, h = (0.3 * torch.randn(1, 6, WAVES, generator=g, dtype=torch.float64) for _ in range(2))
    seen = torch.tensor([[1.0, 1.0, 0.0]], dtype=torch.float64)
    square = Z.square() - (Z - h).square()
    by_order = 0.8 * square.unflatten(2, (2, len(ORDERS), LINES)).sum((1, 2))
    expected = (by_order * seen.unsqueeze(-1)).clamp(-2, 2).sum(1)
    assert torch.allclose(log_likelihood_of_phase(Z, h, seen), expected, atol=1e-12)


def line_of(amplitude, speeds, seed=0, coherent=True):
    """What seconds of noise of power 1 with a line of an amplitude at number 30 show, on distances at these speeds."""
    g = torch.Generator().manual_seed(seed)
    line, one, distance = WheelLine.begin(torch.zeros(1).double(), 1), torch.ones(1).double(), torch.zeros(1).double()
    yes, seen = torch.tensor([True]), torch.ones(1, 3, dtype=torch.float64)
    axes = torch.tensor([0.0, 0.0, 1.0, 0.0, 1.0, 0.0], dtype=torch.float64)
    for speed in speeds:
        spectrum = math.sqrt(0.5) * torch.randn(1, 6, WAVES, generator=g, dtype=torch.float64)
        tone = torch.zeros(1, 6, 2, len(ORDERS), LINES, dtype=torch.float64)
        turn = 0.0 if coherent else 2 * math.pi * float(torch.rand(1, generator=g))
        tone[0, :, 0, 0, 30], tone[0, :, 1, 0, 30] = (
            amplitude * math.cos(turn) * axes,
            amplitude * math.sin(turn) * axes,
        )
        spectrum = spectrum + rotated(tone.flatten(2), distance)  # its phase goes on with the distance
        line = line.after(spectrum, one, torch.log(speed * one), seen, yes, yes).from_here(speed * one, yes)
        distance = distance + speed
    return line


VARIED = [8.0 + 4.0 * math.sin(0.3 * k) for k in range(60)]


def test_a_line_that_keeps_its_phase_is_found_in_the_noise_of_its_neighbours():
    found = line_of(0.9, VARIED)
    log_turns, variance = found.log_turns()
    assert bool(found.detected) and abs(float(log_turns) - math.log(LEAST + 30 * STEP)) < 4 * float(variance.sqrt())
    assert not any(bool(line_of(0.9, VARIED, seed, coherent=False).detected) for seed in range(5))


def test_noise_alone_is_no_line():
    assert not any(bool(line_of(0.0, VARIED, seed).detected) for seed in range(20))


def test_at_one_speed_nothing_is_a_wheel():
    assert not bool(line_of(0.9, [10.0] * 120).detected)


@pytest.mark.parametrize("epoch_s", [0.2, 0.5, 2.0])
def test_other_update_intervals_detect_the_wheel_too(epoch_s):
    found = memory(cars(3, round(120 / epoch_s), wheel, 8, epoch_s=epoch_s))
    assert found.wheels.detected.all()
    assert torch.allclose(torch.exp(found.wheels.log_turns), torch.tensor(TURNS).double(), rtol=6e-3)


def test_the_likelihood_of_a_line_is_highest_where_it_stands_and_flat_for_a_car_without():
    levels = torch.zeros(1, 6, len(ORDERS), LINES, dtype=torch.float64)
    levels[..., 0, 20], levels[..., 1, 20] = 2.0, 1.5
    excess = torch.zeros(1, 6, len(ORDERS), 1, dtype=torch.float64)
    assert not log_likelihood(levels, excess).any()
    excess[:, :, :2] = 1.0
    said = log_likelihood(levels, excess)
    assert said.argmax() == 20 and said[0, 20] > 0 > said[0, 0]


def test_what_a_gaussian_density_says_is_found_again():
    """A likelihood N(m, R) under a prior N(0, S): innovation m, variance R but for the finest line."""
    off = torch.linspace(-0.3, 0.3, 601, dtype=torch.float64).unsqueeze(0)
    S, R, m = torch.tensor([0.03**2]), torch.tensor([0.02**2]), 0.01
    z, found, sure = _gaussian(-0.5 * off.square() / S - 0.5 * (off - m).square() / R, off, S.double())
    assert bool(sure) and z.item() == pytest.approx(m, rel=0.1) and found.item() == pytest.approx(R.item(), rel=0.2)
    z, found, sure = _gaussian(-0.5 * off.square() / S, off, S.double())
    assert not bool(sure)  # the prior alone says nothing


def test_it_detects_the_wheels_and_knows_their_turns():
    found = memory(cars(4, 100, wheel, 1))
    assert found.wheels.detected.all() and (found.line.by_phase.nats.sum(1).amax(1) > DETECTED).all()
    assert torch.allclose(torch.exp(found.wheels.log_turns), torch.tensor(TURNS).double(), rtol=4e-3)


def test_it_writes_what_it_measured_and_the_tyre_that_it_found():
    batch = cars(3, 120, wheel, 1)
    said = dict(zip(aid_columns(build_filter(AIDED, ROUGH)), run(batch, AIDED).aids.unbind(-1)))
    found = said["wheel_orders_circumference_m"]
    assert found[:, :5].isnan().all() and torch.allclose(found[:, -1], torch.tensor(1 / TURNS).double(), rtol=4e-3)
    assert ((found[:, -1] - 1 / TURNS).abs() < 4 * said["std_wheel_orders_circumference_m"][:, -1]).all()
    used = said["wheel_orders_used"] > 0
    ratio = (said["wheel_orders_innovation"] / said["wheel_orders_innovation_std"])[used]
    assert used.any() and float(ratio.square().mean()) < 2 and said["wheel_orders_innovation"][:, 0].isnan().all()


def test_it_holds_the_speed_in_an_outage_and_says_how_well():
    batch = cars(12, 150, wheel, 2)
    batch = without_fixes(batch, 90)
    plain, aided = (run(batch, name) for name in (KALMAN, AIDED))
    off = [(s.posterior.v_n.norm(dim=-1) - batch.truth.v_n.norm(dim=-1))[:, 110:] for s in (plain, aided)]
    assert off[1].square().mean().sqrt() < 0.65 * off[0].square().mean().sqrt()
    std = aided.std[:, -1, :2].square().sum(-1).sqrt()
    assert 0.1 < float((horizontal(aided, batch)[:, -1] / std).square().mean()) < 2.0


@pytest.mark.parametrize("turns", [fixed, half])
def test_a_tone_that_does_not_follow_the_speed_is_not_taken_for_a_wheel(turns):
    assert not memory(cars(6, 120, turns, 3)).wheels.detected.any()


def test_a_car_that_does_not_shake_is_navigated_as_without():
    batch = cars(3, 100, wheel, 4, size=0.0)
    batch = without_fixes(batch, 60)
    plain, aided = (run(batch, name) for name in (KALMAN, AIDED))
    assert torch.allclose(plain.posterior.p_n, aided.posterior.p_n, atol=1e-9)


def test_a_wheel_that_falls_silent_is_given_up_when_fixes_show_the_speed():
    loud, silent = (cars(2, 300, turns, 5) for turns in (wheel, fixed))
    imu = torch.where((torch.arange(300) < 100)[None, :, None, None], loud.imu, silent.imu)
    both = replace(loud, imu=imu)
    assert memory(loud).wheels.detected.all()
    assert not memory(both).wheels.detected.any()


def test_training_sees_a_filter_without_it():
    batch = cars(2, 12, wheel, 6)
    plain, aided = (integrate(batch, build_filter(name, ROUGH)) for name in (KALMAN, AIDED))
    assert torch.equal(plain.posterior.p_n, aided.posterior.p_n)


def test_its_name():
    assert is_filter("mbkf33_car+wheel_orders") and not is_filter("mbkf33_car+wheel_order")
