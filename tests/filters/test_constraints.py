"""Constraints: Jacobians by finite differences, what they are worth, standstills, and the structure of a car."""

import math
from dataclasses import replace

import pytest
import torch

from dlkf.filters.build import build_filter
from dlkf.filters.constraints import MEAN_S, STRUCTURE_STD, STRUCTURE_WALK_STD, CarConstraints
from dlkf.filters.integration import Epoch, Fix, integrate
from dlkf.filters.model_based import Mbkf
from dlkf.filters.sources import Predicted
from dlkf.filters.tuning import Tuning
from dlkf.navigation.attitude import rotation_from_rpy
from dlkf.navigation.calibration import ImuError
from dlkf.navigation.imu_errors import ImuSpec, SensorErrors
from dlkf.navigation.state import ErrorStates, NavState
from dlkf.navigation.strapdown import strapdown

from .scene import IMU, M, scene

STATES = ErrorStates("scale", structure=True)
D = torch.float64


def epoch_of(batch, state: NavState, error: ImuError) -> Epoch:
    raw = batch.imu[:, 0]
    corrected = error.correct(raw)
    window = strapdown(state, corrected, batch.dt, batch.frame)._replace(end=state)
    none = torch.zeros(len(raw), 6, dtype=D)
    fix = Fix(none, none + 1, none > 0, None)
    rate = corrected[:, -5:, 3:].mean(1)
    return Epoch(raw, corrected, error, state, window, state, rate, rate, none, fix, None,
                 batch.dt, batch.frame)  # fmt: skip


def test_jacobian_matches_finite_differences():
    """z(x̂) falls by H dx when the estimate moves by dx, state by state: navigation, the sensors, the car."""
    batch = scene(1, 1, seed=3)
    structure = torch.tensor([[0.03, -0.02, 1.2, 0.008, 0.004]], dtype=D)
    error = ImuError(torch.zeros(1, 6, dtype=D))
    rules = CarConstraints(Tuning(), STATES)
    still = epoch_of(batch, batch.start, error)

    def innovation(dx):
        moved = epoch_of(batch, batch.start.correct(dx[:, :9]), error.update(dx, STATES))
        states = NavState(*(x[0] for x in still.window[:3])).correct(dx[:, :9].expand(M, -1))  # off alike all along
        moved = moved._replace(window=moved.window._replace(**{k: x[None] for k, x in states._asdict().items()}))
        across = rules._measure_lateral(moved, structure + dx[:, STATES.of_structure])[0]
        return torch.cat((across, rules._measure_standstill(moved)[0]), -1)

    H = torch.cat((rules._measure_lateral(still, structure)[1], rules._measure_standstill(still)[1]), 1)[0]
    for i in (*range(3, 10), *range(12, 15), *range(21, 26)):
        dx = torch.zeros(1, STATES.count, dtype=D)
        dx[0, i] = 1e-6
        numeric = -(innovation(dx) - innovation(-dx))[0] / 2e-6
        # left out on purpose: Earth rate turned by an attitude error (7e-5)
        assert (numeric - H[:, i]).abs().max() < 1e-4, i


def test_a_knock_that_the_springs_bring_back_is_no_motion_across_the_car():
    """A metre a second to the right in the last sample moves the mean of half a second by its share, 2 cm/s in 50."""
    batch = scene(1, 1, seed=3)
    epoch = epoch_of(batch, batch.start, ImuError(torch.zeros(1, 6, dtype=D)))
    rules, knocked = CarConstraints(Tuning(), STATES), epoch.window.v_n.clone()
    knocked[:, -1] += epoch.window.C_nb[:, -1, :, 1]
    calm, shaken = (
        rules._measure_lateral(epoch._replace(window=epoch.window._replace(v_n=v_n)), None)[0]
        for v_n in (epoch.window.v_n, knocked)
    )
    samples = round(MEAN_S / batch.dt)
    assert samples < M and torch.allclose(calm - shaken, torch.tensor([[1.0 / samples, 0.0]], dtype=D), atol=1e-3)


def test_beyond_three_sigma_a_larger_innovation_corrects_less():
    """Within 3σ a row has its own variance; beyond, one in proportion to the innovation's square."""
    batch = scene(1, 1, seed=3)
    rules = CarConstraints(Tuning(), STATES)
    P = 1e-4 * torch.eye(STATES.count, dtype=D).unsqueeze(0)
    C_nb = batch.start.C_nb[0]
    correction, variances = [], []
    for sideways in (0.1, 2.0, 4.0):
        state = batch.start._replace(v_n=(C_nb @ torch.tensor([10.0, sideways, 0.0], dtype=D)).unsqueeze(0))
        epoch = epoch_of(batch, state, ImuError(torch.zeros(1, 6, dtype=D)))
        steady = {k: x.unsqueeze(1).expand_as(getattr(epoch.window, k)) for k, x in state._asdict().items()}
        epoch = epoch._replace(window=epoch.window._replace(**steady))
        row, _ = rules.rows(epoch, rules.begin(batch), Predicted(P))
        variances.append(float(row.R[0, 0]))
        S = float(row.H[0, 0] @ P[0] @ row.H[0, 0]) + variances[-1]
        correction.append(abs(float(row.z[0, 0])) / S)
    assert variances[0] == pytest.approx(Tuning().lateral_std ** 2) and variances[1] > variances[0]
    assert variances[2] == pytest.approx(4 * variances[1], rel=0.05)
    assert correction[2] < correction[1]


def test_a_car_at_rest_feels_the_earth_turn():
    """Tilted, on error-free sensors: the innovation of the rate is zero to rounding, not the Earth's 7e-5 rad/s."""
    batch = scene(3, 1, seed=4)
    still = torch.zeros(3, 3, dtype=D)
    C = rotation_from_rpy(torch.tensor([[0.3, -0.2, 1.0], [0.0, 0.1, -2.0], [-0.1, 0.0, 0.4]], dtype=D))
    earth_b = (C.mT @ batch.frame.earth_rate_n.unsqueeze(-1)).mT
    assert earth_b.norm(dim=-1).min() > 7e-5
    raw = torch.cat((torch.zeros(3, M, 3, dtype=D), earth_b.expand(-1, M, -1)), -1)
    at_rest = replace(batch, imu=raw.unsqueeze(1))
    epoch = epoch_of(at_rest, NavState(still, still, C), ImuError(torch.zeros(3, 6, dtype=D)))
    z, _ = CarConstraints(Tuning(), STATES)._measure_standstill(epoch)
    assert z.abs().max() < 1e-15


def test_what_is_known_of_a_car_grows_old():
    """With nothing that tells of it, the variances of its states grow by the PSD of their random walks times time."""
    batch = scene(2, 20, seed=5)
    with torch.no_grad():
        alone = Mbkf(IMU, states=ErrorStates(structure=True))
        P = integrate(batch, alone, keep_covariances=True).covariances.updated
    variance = P.diagonal(dim1=-2, dim2=-1)[..., alone.states.of_structure]
    walk = torch.tensor(STRUCTURE_WALK_STD, dtype=D).square()
    assert (walk > 0).all()
    assert torch.allclose(variance[:, -1], torch.tensor(STRUCTURE_STD, dtype=D).square() + 20 * walk, rtol=1e-12)
    # 1e-6: float64 beside the variance of the start, and the PSD comes as float32
    assert torch.allclose(variance[:, -1] - variance[:, 9], (10 * walk).expand(2, 5), rtol=1e-5)


def outage(batch, first: int, last: int):
    available = batch.available.clone()
    available[:, first:last] = False
    return replace(batch, available=available)


def drift(batch, name: str, **tuning: float) -> torch.Tensor:
    solution = integrate(batch, build_filter(name, IMU, tuning=Tuning(**tuning)))
    return (solution.posterior.p_n - batch.truth.p_n)[:, -1, :2].norm(dim=-1).square().mean().sqrt()


@pytest.mark.parametrize("base", ["mbkf15", "mbkf21"])
def test_cars_that_do_not_slide_drift_less(base):
    batch = outage(slipping(30, 90, (0.0, 0.0, 0.0, 0.0, 0.0)), 45, 90)
    assert drift(batch, f"{base}_nhc", lateral_std=0.05, vertical_std=0.05) < 0.35 * drift(batch, base)


@pytest.mark.whole
def test_structure_of_the_car_is_found_and_pays():
    """Mounting angles, rear axle, slip and springs unknown: a filter that estimates them beats one that cannot."""
    true = (0.02, -0.015, 1.4, 0.004, 0.006)
    batch = outage(slipping(30, 150, true), 105, 150)
    estimator = build_filter("mbkf15_car", IMU, tuning=Tuning(lateral_std=0.05, vertical_std=0.05))
    memory = None

    class Watched(Mbkf):
        def step(self, memory, epoch):
            nonlocal watched
            memory, answer = super().step(memory, epoch)
            watched = memory.structure
            return memory, answer

    watched = memory
    with torch.no_grad():
        integrate(batch, Watched(**vars(estimator)))
    assert watched is not None
    error = watched.mean(0) - torch.tensor(true, dtype=D)
    assert (error.abs() < torch.tensor([2e-3, 2e-3, 0.15, 1e-3, 1e-3])).all(), error
    tuning = {"lateral_std": 0.05, "vertical_std": 0.05}
    assert drift(batch, "mbkf15_car", **tuning) < 0.6 * drift(batch, "mbkf15_nhc", **tuning)


def test_a_standing_car_stays_where_it_is():
    """Stopped after 40 s, GNSS gone from then on: zero-velocity updates hold the position and find the gyro bias."""
    batch = outage(slipping(10, 100, (0.0, 0.0, 0.0, 0.0, 0.0), stop=40), 40, 100)
    held, free = drift(batch, "mbkf15_nhc"), drift(batch, "mbkf15")
    assert held < 0.3 and held < 0.02 * free
    solution = integrate(batch, build_filter("mbkf15_nhc", IMU))
    bias = (batch.true_imu_error - solution.imu_error)[:, -1, 3:]
    assert bias.abs().max() < 1e-4  # rest_rate_std and noise over √60, the turn-on bias being 5e-3


@pytest.mark.parametrize("change", [1e-3, 5e-3])
def test_a_bias_that_has_changed_is_seen_at_rest(change):
    """The gyroscopes warm up while the car drives, and go on as it stands: 0.06 and 0.3 °/s in all. What a second at
    rest shows is the bias, so the heading stays within a degree, and 20 s after the stop the bias is known to a
    quarter of the change."""
    batch = outage(slipping(6, 160, (0.0,) * 5, stop=40), 40, 160)
    warm = change * -torch.expm1(-torch.arange(160, dtype=D) / 60)
    batch = replace(batch, imu=batch.imu + torch.nn.functional.pad(warm[:, None, None], (5, 0)))
    solution = integrate(batch, build_filter("mbkf15_nhc", IMU))
    bias = (batch.true_imu_error - solution.imu_error)[:, :, 5] + warm
    assert bias[:, 60:].abs().max() < 0.25 * change
    turned = solution.posterior.C_nb[:, 45].mT @ solution.posterior.C_nb[:, -1]
    assert torch.atan2(turned[:, 1, 0], turned[:, 0, 0]).abs().max() < math.radians(1.0)


def test_a_moving_car_is_not_taken_for_a_standing_one():
    """Steady straight driving is as quiet as standing; the filter's own speed speaks against it."""
    batch = outage(scene(20, 60, seed=10), 30, 60)
    quiet = replace(batch, imu=batch.imu.mean(2, keepdim=True).expand_as(batch.imu).clone())
    P = torch.eye(15, dtype=D).expand(20, 15, 15) * 0.01
    rules = CarConstraints(Tuning(), ErrorStates())
    epoch = epoch_of(quiet, NavState(*(x[:, 30] for x in batch.truth)), ImuError(torch.zeros(20, 6, dtype=D)))
    measured, _ = rules.rows(epoch, rules.begin(quiet), Predicted(P))
    assert not measured.used[:, 2:].any()


def slipping(batch: int, epochs: int, structure: tuple[float, ...], stop: float | None = None):
    """Cars whose IMU moves as the constraint with these parameters says, and the truth that goes with it.

    Body velocity follows from speed and yaw rate; forces from its derivative, gravity and Earth rotation at the
    samples' middle; then the strapdown itself makes the truth, so that IMU and truth agree to rounding.
    """
    yaw, pitch, axle, slip, gradient = structure
    base = scene(batch, epochs, seed=12)
    t = torch.arange(epochs * M + 1, dtype=D) * base.dt
    g = torch.Generator().manual_seed(5)
    phase = 2 * math.pi * torch.rand(batch, 2, 1, generator=g, dtype=D)
    vx = 12 + 3 * torch.sin(2 * math.pi * t / 31 + phase[:, 0])
    wz = 0.3 * torch.sin(2 * math.pi * t / 23 + phase[:, 1])
    if stop is not None:
        fade = (1 - torch.cos(math.pi * ((stop - t) / 8).clamp(0, 1))) / 2
        vx, wz = vx * fade, wz * fade
    dt = base.dt
    ahead = torch.gradient(vx, spacing=dt, dim=1)[0]
    v_b = torch.stack((vx, yaw * vx + (axle + slip * vx**2) * wz, (pitch + gradient * ahead) * vx), -1)
    rate = torch.zeros(batch, epochs * M, 3, dtype=D)
    rate[..., 2] = 0.5 * (wz[:, 1:] + wz[:, :-1])
    middle = 0.5 * (v_b[:, 1:] + v_b[:, :-1])
    heading = 2 * math.pi * torch.rand(batch, 1, generator=g, dtype=D) + dt * rate[..., 2].cumsum(1)
    before = heading - 0.5 * dt * rate[..., 2]  # at the samples' middle
    C = rotation_from_rpy(torch.stack((0 * before, 0 * before, before), -1))
    v_n = (C @ middle.unsqueeze(-1)).squeeze(-1)
    p_n = dt * v_n.cumsum(1) - 0.5 * dt * v_n
    row = torch.arange(batch).repeat_interleave(epochs * M)
    gravity = base.frame[row].gravity(p_n.flatten(0, 1)).unflatten(0, (batch, -1))
    earth_n = base.frame.earth_rate_n[:, None].expand_as(v_n)
    pull = 2 * torch.linalg.cross(earth_n, v_n) - gravity
    force = (v_b[:, 1:] - v_b[:, :-1]) / dt + torch.linalg.cross(rate, middle)
    force = force + (C.mT @ pull.unsqueeze(-1)).squeeze(-1)
    rate = rate + (C.mT @ earth_n.unsqueeze(-1)).squeeze(-1)
    first = heading[:, 0] - dt * rate[:, 0, 2]
    C0 = rotation_from_rpy(torch.stack((0 * first, 0 * first, first), -1))
    start = NavState(torch.zeros(batch, 3, dtype=D), (C0 @ v_b[:, 0].unsqueeze(-1)).squeeze(-1), C0)
    clean = torch.cat((force, rate), -1).reshape(batch, epochs, M, 6)
    return driven(base, start, clean)


def driven(base, start: NavState, clean: torch.Tensor):
    """A batch in which the error-free samples ``clean`` move the cars from ``start``; errors and noises of ``base``."""
    rows, state = [], start
    with torch.no_grad():
        for k in range(clean.shape[1]):
            state = strapdown(state, clean[:, k], base.dt, base.frame).end
            rows.append(state)
    truth = NavState(*(torch.stack(x, 1) for x in zip(*rows)))
    old = torch.cat((base.truth.p_n, base.truth.v_n), -1)
    off = base.start.error_to(NavState(torch.zeros_like(base.start.p_n), base.start.v_n, base.start.C_nb))
    noise = torch.randn(clean.shape, generator=torch.Generator().manual_seed(2), dtype=D)
    white = torch.tensor([1e-3] * 3 + [7e-5] * 3, dtype=D) * math.sqrt(1 / base.dt)
    return replace(
        base,
        imu=clean + base.true_imu_error.unsqueeze(2) + white * noise,
        gnss=torch.cat((truth.p_n, truth.v_n), -1) + base.gnss - old,
        truth=truth,
        start=start.correct(-off),
    )


@pytest.mark.whole
def test_five_minutes_in_float32_are_those_in_float64():
    """Training runs in float32: rounding stays small beside what the filter does not know, in an outage too."""
    errors = {"scale_factor": 3e-3, "misalignment": 3e-3}
    imu = ImuSpec("all", SensorErrors(1e-3, 0.1, 1e-3, **errors), SensorErrors(7e-5, 5e-3, 5e-5, **errors))
    batch = outage(slipping(2, 300, (0.03, -0.02, 1.2, 0.008, 0.004)), 240, 300)
    with torch.inference_mode():
        both = (batch, batch.in_precision(torch.float32))
        double, single = (integrate(b, build_filter("mbkf33_car", imu), keep_covariances=True) for b in both)
    apart = (double.posterior.p_n - single.posterior.p_n).norm(dim=-1)
    assert (apart / double.std[..., :3].norm(dim=-1)).max() < 0.06  # 0.03 was measured
    assert (single.std / double.std - 1).abs().max() < 0.015  # 0.009
    P = single.covariances.updated[:, -1].double()
    sigma = P.diagonal(dim1=-2, dim2=-1).sqrt()
    assert P.shape[-1] == 38
    assert torch.linalg.eigvalsh(P / (sigma[:, :, None] * sigma[:, None, :])).min() > 0
