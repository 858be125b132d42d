"""Speed from the spectrum over distance of the vibration of an IMU."""

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
from dlkf.filters.integration import Fix, advance, integrate
from dlkf.filters.vibration_spectrum import (
    FIRST_HZ,
    LEAST,
    LINES,
    PARTS,
    STEP,
    TONE_HZ,
    TONES,
    WAVES,
    components,
    demodulate,
    describe_block,
    expected_log_likelihood,
    line_weights,
    lines,
    log_likelihood,
    log_power,
    phases,
    remove_trend,
    shifts,
    tone_shares,
)
from dlkf.filters.vibration_speed import FEW, MEMORY, Block, Mean, VibrationMemory, VibrationSpeed, _predictive
from dlkf.navigation.calibration import ImuError
from dlkf.navigation.state import NavState
from tests.cars import car

from .scene import IMU, RATE, beside
from .test_constraints import epoch_of

WHEELBASE = 2.6  # m
ROUGH = replace(
    IMU, accel=replace(IMU.accel, noise_density=0.05), gyro=replace(IMU.gyro, noise_density=2e-3)
)  # with what the road adds
KALMAN, AIDED = "mbkf21_nhc", "mbkf21_nhc+vibration_speed"


def road(rng, t, s):
    """Pitch rate and heave of a car whose rear axle runs over what the front axle has run over."""
    at = np.arange(0.0, s.max() + 10.0, 0.2)
    profile = rng.normal(size=len(at))
    rear, front = (np.interp(s + x, at, profile) for x in (0.0, WHEELBASE))
    return front - rear, front + rear


def tones(rng, t, s):
    """Two tones of a fixed frequency, which wander a little."""
    phase = 2 * np.pi * np.cumsum(1 + 0.02 * np.sin(0.3 * t)) / RATE
    return 2 * np.sin(7 * phase), 2 * np.sin(11 * phase)


def noise(rng, t, s):
    """White noise."""
    return rng.normal(size=len(t)), rng.normal(size=len(t))


def cars(count, epochs, vibration, seed=0, size=0.4, epoch_s=1.0):
    """Cars at 10 ± 3 m/s on a plane, in noise, with a vibration of pitch and heave."""
    tables = car(epochs * epoch_s + 1.0, RATE)
    t = tables["imu"]["t"].to_numpy() - 0.5 / RATE
    drives = []
    for k in range(count):
        rng = np.random.default_rng((seed, k))
        imu = {str(c): tables["imu"][c].to_numpy(copy=True) for c in tables["imu"]}
        for axis, scale in (("accel", 1.0), ("gyro", 0.05)):
            for c in "xyz":
                bias = 0.2 * scale * size * rng.normal()
                imu[f"{axis}_{c}"] += bias + (0.2 if c == "z" else 1.0) * scale * size * rng.normal(size=len(t))
        pitch, heave = vibration(rng, t, 10 * t + 15 * (1 - np.cos(0.2 * t)))
        imu["gyro_y"] += 0.1 * size * pitch
        imu["accel_z"] += size * heave
        others = [{str(c): tables[n][c].to_numpy(copy=True) for c in tables[n]} for n in ("gnss", "reference")]
        row = DriveRow(f"car-{k}", "cars", (0.0, 0.0, 0.0))
        drives.append(drive_from_tables(CheckedTables(row, imu, *others), "cars", RATE, epoch_s, torch.float64))
    stack = DriveStack(drives)
    segments = cut_segments(stack, epochs * epoch_s, epochs * epoch_s)
    law, generator = StartLaw(0.1, 0.1, 1.0, 2.0), torch.Generator().manual_seed(seed)
    return make_batch(stack, segments, dtype=torch.float64, start=law, generator=generator)


def without_fixes(batch, first):
    """With an outage from an epoch on."""
    return replace(batch, available=batch.available & (torch.arange(batch.size[1]) < first))


def run(batch, name):
    with torch.no_grad():
        return integrate(batch, build_filter(name, ROUGH), keep_covariances=True)


def memory(batch) -> VibrationMemory:
    """What the source has learned at the end of a batch."""
    kalman = build_filter(AIDED, ROUGH)
    with torch.no_grad():
        carried, bias = kalman.begin(batch)
        state, error = batch.start, ImuError.of(bias)
        for k in range(batch.size[1]):
            used = batch.gnss_valid[:, k] & batch.available[:, k, None]
            fix = Fix(batch.gnss[:, k], batch.gnss_std[:, k], used, None)
            carried, step = advance(
                kalman, carried, state, error, batch.imu[:, k], fix, dt=batch.dt, frame=batch.frame.prepare(),
                lever_arm_b=None,
            )  # fmt: skip
            state, error = step.posterior, step.error
    return next(x for x in carried.sources if isinstance(x, VibrationMemory))


def columns(batch):
    return dict(zip(aid_columns(build_filter(AIDED, ROUGH)), run(batch, AIDED).aids.unbind(-1)))


def speed_error(solution, batch):
    return solution.posterior.v_n.norm(dim=-1) - batch.truth.v_n.norm(dim=-1)


def made(seed, *shape_):
    return torch.randn(*shape_, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_the_spectrum_is_the_sum_that_its_equation_says():
    x, s, begin = made(1, 2, 40, 6), made(2, 2, 40).abs().cumsum(1), made(3, 2, 6, WAVES)
    got = torch.stack(components(demodulate(x, s, begin) - begin), 2)
    for line in (0, 15, 16, 63, 64, LINES - 1):
        F = LEAST + STEP * line
        assert lines(x)[line] == pytest.approx(F)
        angle = 2 * math.pi * F * s
        expected = torch.stack([(f(angle).unsqueeze(-1) * x).sum(1) for f in (torch.cos, torch.sin)], -1)
        assert torch.allclose(got[..., line], expected, atol=1e-12)


def test_a_shape_has_no_trend_and_no_size():
    """Whatever is smooth in ln F leaves it as it is."""
    power, weight = log_power(*components(0.3 * made(4, 1, 6, WAVES) + 1)), torch.ones(1, LINES).double()
    share = torch.log(lines(power) / LEAST) / math.log(float(lines(power)[-1]) / LEAST)
    again = power + 4 + 1.4 * torch.cos(math.pi * share) - 0.8 * torch.cos(3 * math.pi * share)
    assert torch.allclose(remove_trend(power, weight), remove_trend(again, weight), atol=1e-4)


def test_phases_are_those_of_the_products_of_two_axes():
    """cos and sin of arg(Z_a* Z_b), whatever the size and where the stretch begins."""
    c, s = made(14, 2, 6, LINES), made(15, 2, 6, LINES)
    z = torch.complex(c, s)
    got = torch.complex(*phases(c, s).unflatten(1, (2, 6)).unbind(1))
    for number, (a, b) in enumerate(((0, 2), (1, 3), (0, 4), (1, 5), (2, 4), (3, 5))):
        product = z[:, a].conj() * z[:, b]
        assert torch.allclose(got[:, number], product / product.abs(), atol=1e-12)
    turned = 3 * z * torch.exp(1j * made(16, LINES))
    assert torch.allclose(phases(turned.real, turned.imag), phases(c, s), atol=1e-12)


@pytest.mark.whole
def test_parts_of_a_block_have_unit_variance_where_nothing_is_known():
    """Of white noise, but for what its clamped power and its trend take."""
    x, s = made(17, 400, 300, 6), torch.linspace(0, 30, 300).double().expand(400, -1)
    y = describe_block(demodulate(x, s, torch.zeros(400, 6, WAVES).double()), torch.ones(400, LINES).double())
    square = y[..., 10:-10].square().mean((0, 2))
    assert ((square[:6] > 0.75) & (square[:6] < 1.0)).all() and torch.allclose(
        square[6:], torch.ones(12).double(), atol=0.05
    )


def test_lines_count_between_two_frequencies_in_time():
    weight = line_weights(torch.tensor([10.0, 40.0]).double(), 0.02)
    f = lines(weight) * torch.tensor([[10.0], [40.0]]).double()
    assert (weight[(f > 3) & (f < 17)] > 0.99).all() and (weight[(f < 0.5) | (f > 23)] < 0.01).all()
    assert (line_weights(torch.tensor([10.0]).double(), 0.05)[0, f[0] > 11] < 0.03).all()  # samples at 20 Hz


def test_what_is_of_frequencies_in_time_is_interpolated():
    shares = tone_shares(torch.tensor([9.0]).double())[0]
    f = 9.0 * lines(shares)
    tones_hz = FIRST_HZ + TONE_HZ * torch.arange(TONES).double()
    inside = (f > tones_hz[0]) & (f < tones_hz[-1])
    assert inside.sum() > 100 and torch.allclose((shares @ tones_hz)[inside], f[inside], atol=1e-12)


def test_the_likelihood_of_a_shift_is_what_its_equation_says():
    y, mean, weight = made(5, 1, PARTS, LINES), made(6, 1, PARTS, LINES), torch.rand(1, LINES).double()
    got = log_likelihood(y, mean, weight, torch.tensor([50.0]).double())[0]
    F, w = lines(y).numpy(), weight[0].numpy()
    for number in (0, 10, 16, 32):
        at = F * math.exp(-float(shifts(y)[number]))
        A = np.stack([np.interp(at, F, a) for a in mean[0].numpy()])
        said = (w * (y[0].numpy() * A - 0.5 * A**2)).sum() * (STEP * 50 / 1.5)
        assert got[number] == pytest.approx(said, rel=1e-3, abs=0.02)


@pytest.mark.parametrize("delta", [-0.08, 0.0, 0.05])
def test_a_shape_that_stands_further_up_is_of_a_car_that_is_faster(delta):
    """y(F) = A(F e^−δ)."""
    F = lines(torch.zeros(1).double())
    A = torch.log(1.3 - torch.cos(2 * math.pi * WHEELBASE * F)).expand(1, PARTS, -1)
    y = torch.log(1.3 - torch.cos(2 * math.pi * WHEELBASE * F * math.exp(-delta))).expand(1, PARTS, -1)
    said = log_likelihood(y, A, torch.ones(1, LINES).double(), torch.tensor([30.0]).double())
    assert float(shifts(y)[said.argmax()]) == pytest.approx(delta, abs=1e-9)


def test_a_mean_of_few_blocks_is_drawn_towards_nothing():
    mean, one = Mean.begin(torch.zeros(1).double(), 1, 3), torch.ones(1).double()
    y, weight = torch.full((1, PARTS, 3), 2.0).double(), torch.tensor([[1.0, 0.5, 0.0]]).double()
    for _ in range(10):
        mean = mean.update(y, weight, one)
    n = sum((1 - 1 / MEMORY) ** k for k in range(10))  # blocks, of which older ones count less
    expected = torch.tensor([2 * n / (n + FEW), n / (0.5 * n + FEW), 0.0]).double()
    assert torch.allclose(mean.value, expected.expand(1, PARTS, 3), atol=1e-6) and 1.3 < float(expected[0]) < 1.4
    assert torch.equal(mean.update(y, weight, 0 * one).value, mean.value)


def source():
    kalman = build_filter(KALMAN, ROUGH)
    return VibrationSpeed(None, kalman.tuning, kalman.states)


def test_what_a_gaussian_likelihood_says_is_found_again():
    """A likelihood N(m, R) under the filter's own variance: innovation m, variance R but for the finest δ."""
    batch = cars(1, 4, noise)
    memory_ = source().begin(batch)
    memory_ = memory_._replace(blocks=memory_.blocks + 1e9, evidence=memory_.evidence + torch.tensor([0] * 6 + [99]))
    off, yes, of_speed, m = shifts(batch.imu), torch.tensor([True]), torch.tensor([0.03**2]).double(), 0.01
    for R in (0.02**2, 0.03**2):
        row = source()._row(memory_, (-0.5 * (off - m).square() / R).unsqueeze(0), torch.zeros(1, 1, 21), of_speed, yes)
        assert row.z.item() == pytest.approx(m, rel=0.1) and row.R.item() == pytest.approx(R, rel=0.2)
        assert bool(row.used)
    for std in (0.03, 0.06, 0.095):  # the prior alone says nothing, also where the shifts end within it
        row = source()._row(
            memory_, torch.zeros(1, len(off)).double(), torch.zeros(1, 1, 21), of_speed * 0 + std**2, yes
        )
        assert not bool(row.used)
    row = source()._row(memory_, (-0.5 * (off - 0.14).square() / 0.01**2).unsqueeze(0), torch.zeros(1, 1, 21),
                        of_speed, yes)  # fmt: skip
    S = row.R.item() + 0.03**2 + 0.02**2  # an outlier is of 3σ
    assert bool(row.used) and row.z.item() > 0.13 and row.z.item() == pytest.approx(3 * S**0.5, rel=1e-3)


def test_a_wrong_heading_is_no_wrong_speed():
    """A trajectory that is turned as a whole, δv = δh × v, has the same speeds: H δx = 0, in a bend too."""
    batch = cars(1, 4, noise)
    made_ = source()
    for lag in (0.0, 0.3):
        block = Block.begin(batch.imu, 1)
        block = block._replace(distance=block.distance + 36.0, elapsed=block.elapsed + 3.0, turned=block.turned + lag)
        v, C_nb = torch.tensor([[7.0, 9.0, 0.0]]).double(), batch.start.C_nb
        v = 12.0 * v / v.norm()
        state = NavState(batch.start.p_n, v, C_nb)
        H = made_._matrix(epoch_of(batch, state, ImuError(torch.zeros(1, 6).double())), block)[0, 0]
        heading = torch.tensor([0.0, 0.0, 1.0]).double()
        dx = torch.zeros(len(H), dtype=torch.float64)
        dx[3:6], dx[6:9] = torch.linalg.cross(heading, v[0]), heading
        assert abs(float(H @ dx)) < 1e-6
        assert float(H[3:6].norm()) == pytest.approx(1 / 12) and float(H[9:12].norm()) == pytest.approx(1.5 / 12)


def test_shares_are_worth_the_density_that_they_give_to_the_known_speed():
    off, known = shifts(torch.zeros(1).double()), torch.tensor([0.01**2]).double()
    right, wrong = (_predictive((-0.5 * (off - m).square() / 0.02**2).unsqueeze(0), known)[0] for m in (0.0, 0.09))
    assert right[0] == wrong[0] == 0 and (right.diff() > 0).all() and (wrong.diff() < 0).all()


def test_it_learns_the_shape_of_a_road_under_two_axles():
    found = memory(cars(3, 120, road, 1))
    assert (found.share > 0.3).all()
    F, pitch = lines(found.share), found.by_distance.value[:, 4].mean(0)
    notch = torch.cos(2 * math.pi * WHEELBASE * F)
    inside = (F > 0.3) & (F < 1.5)
    assert float(torch.corrcoef(torch.stack((pitch[inside], notch[inside])))[0, 1]) < -0.8  # none at n/L


@pytest.mark.parametrize("epoch_s", [0.2, 2.0])
@pytest.mark.whole
def test_other_update_intervals_learn_it_too(epoch_s):
    assert (memory(cars(2, round(120 / epoch_s), road, 8, epoch_s=epoch_s)).share > 0.3).all()


@pytest.mark.whole
def test_it_holds_the_speed_in_an_outage_and_says_how_well():
    batch = without_fixes(cars(12, 150, road, 2), 90)
    plain, aided = (run(batch, name) for name in (KALMAN, AIDED))
    off = [speed_error(s, batch)[:, 110:] for s in (plain, aided)]
    assert off[1].square().mean().sqrt() < 0.5 * off[0].square().mean().sqrt()
    std = aided.std[:, -1, :2].square().sum(-1).sqrt()
    error = (aided.posterior.p_n - batch.truth.p_n)[:, -1, :2].norm(dim=-1)
    assert 0.1 < float((error / std).square().mean()) < 2.0


def test_it_writes_what_it_measured_and_how_far_it_trusts():
    said = columns(without_fixes(cars(3, 180, road, 1), 90))
    assert said["vibration_speed_innovation"][:, :90].isnan().all()  # a block with fixes teaches
    assert (said["vibration_speed_share"][:, -1] > 0.3).all()
    used = said["vibration_speed_used"] > 0
    ratio = (said["vibration_speed_innovation"] / said["vibration_speed_innovation_std"])[used]
    assert used.sum() > 50 and 0.05 < float(ratio.square().mean()) < 2


@pytest.mark.whole
def test_what_does_not_follow_the_speed_is_not_trusted():
    """Tones of a fixed frequency, and white noise."""
    batch = beside(*(cars(6, 150, vibration, 3) for vibration in (tones, noise)))
    assert (memory(batch).share < 0.3).all()
    hidden = without_fixes(batch, 90)
    off = [speed_error(run(hidden, name), hidden)[:, 90:].square() for name in (KALMAN, AIDED)]
    plain, aided = (x.unflatten(0, (2, 6)).mean((1, 2)).sqrt() for x in off)
    assert (aided < 1.05 * plain).all()


@pytest.mark.whole
def test_a_shape_has_the_likelihood_that_is_expected_of_it():
    A, weight, distance = 0.5 * made(11, 1, PARTS, LINES), made(12, 1, LINES).sigmoid(), torch.tensor([30.0]).double()
    y = A + made(13, 1000, PARTS, LINES)
    found = log_likelihood(y, A.expand_as(y), weight.expand(1000, -1), distance.expand(1000))[:, 16]
    expected = expected_log_likelihood(A, weight, distance)[0, 0]
    assert float(found.mean()) == pytest.approx(float(expected), rel=0.05)


@pytest.mark.whole
def test_a_shape_that_does_not_hold_in_an_outage_says_nothing():
    """Other vibration from the outage on: the filter is about as without this source."""
    known, other = (cars(8, 150, vibration, 7) for vibration in (road, tones))
    imu = torch.where((torch.arange(150) < 90)[None, :, None, None], known.imu, other.imu)
    hidden = without_fixes(replace(known, imu=imu), 90)
    plain, aided = (speed_error(run(hidden, name), hidden)[:, 90:].square().mean().sqrt() for name in (KALMAN, AIDED))
    assert aided < 1.25 * plain


@pytest.mark.whole
def test_a_shape_that_is_gone_is_given_up_when_fixes_show_the_speed():
    loud, other = (cars(2, 300, vibration, 5) for vibration in (road, noise))
    both = replace(loud, imu=torch.where((torch.arange(300) < 100)[None, :, None, None], loud.imu, other.imu))
    share = memory(beside(loud, both)).share
    assert (share[:2] > 0.3).all() and (share[2:] < 0.3).all()


def test_training_sees_a_filter_without_it():
    batch = cars(2, 12, road, 6)
    plain, aided = (integrate(batch, build_filter(name, ROUGH)) for name in (KALMAN, AIDED))
    assert torch.equal(plain.posterior.p_n, aided.posterior.p_n)


def test_its_name():
    assert is_filter("mbkf33_car+vibration_speed") and not is_filter("mbkf33_car+vibration")
