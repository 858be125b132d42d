"""Delay of the fixes, antenna and clock as states: H by differences, what is found, and what it is worth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from dlkf.data.alignment import ALIGN
from dlkf.data.masks import withhold_fixes
from dlkf.data.schema import write_drive, write_drives_table
from dlkf.data.segments import whole_drives
from dlkf.data.store import load_dataset
from dlkf.filters.aids.attach import aid_columns
from dlkf.filters.build import build_filter
from dlkf.filters.integration import Epoch, Fix, integrate
from dlkf.filters.kalman_update import kalman_update
from dlkf.filters.receiver import (
    ARM,
    DELAY,
    DRIFT,
    PPM,
    SLOPE_S,
    VELOCITY_DELAY,
    add_drift,
    discount_information,
    let_delay_grow,
    predict_fix,
)  # fmt: skip
from dlkf.navigation.calibration import ImuError
from dlkf.navigation.error_model import antenna
from dlkf.navigation.state import NavState
from dlkf.navigation.strapdown import strapdown
from dlkf.running.start import align_each
from tests.cars import IMU, car, car_batch

WRONG = {DELAY: 0.2, "lever_forward_m": 1.0, "lever_right_m": -0.6, "lever_down_m": 0.0}


FAST = 400.0  # ppm
ANTENNA = (0.4, -0.2, -1.0)
NAMES = (DELAY, VELOCITY_DELAY, *ARM)


@pytest.fixture(scope="module")
def epoch() -> Epoch:
    """The first window of three cars, with an antenna away from the IMU."""
    batch = car_batch(3, 4)
    imu, frame, dt = batch.imu[:, 0], batch.frame, batch.dt
    window = strapdown(batch.start, imu, dt, frame)
    arm, nothing = torch.tensor(ANTENNA).expand(3, -1).to(imu), imu.new_zeros(3, 6)
    fix = Fix(batch.gnss[:, 0], batch.gnss_std[:, 0], torch.ones(3, 6, dtype=torch.bool), None)
    rate = imu[:, -1, 3:]
    return Epoch(imu, imu, ImuError(nothing), batch.start, window, window.end, rate, rate, nothing, fix, arm, dt, frame)


def predicted(epoch: Epoch, *values: float) -> Epoch:
    """With these estimates of delays and antenna."""
    return predict_fix(epoch, {name: epoch.z.new_full((3,), x) for name, x in zip(NAMES, values, strict=True)})


def test_h_is_the_derivative_of_the_predicted_fix(epoch):
    """Of delays and antenna, in the middle of a window; its velocity is that of then."""
    kalman, found = build_filter("mbkf15+receiver", IMU), (0.51, 0.15, 0.3, -0.1, 0.2)
    H = kalman.fix.matrix(predicted(epoch, *found))
    for k, name in enumerate(NAMES):
        step = SLOPE_S if k < 2 else 1e-3
        less, more = ([x + sign * step * (i == k) for i, x in enumerate(found)] for sign in (-1, 1))
        measured = (predicted(epoch, *less).z - predicted(epoch, *more).z) / (2 * step)
        # H leaves out how the arm's swing changes, and that the antenna turns with the Earth
        close = {"atol": 0.03, "rtol": 0.01} if k < 2 else {"atol": 1e-4}
        assert torch.allclose(measured, H[:, :, kalman.states.of(name).start], **close)
    assert torch.equal(H[:, 0, kalman.states.velocity], H.new_tensor([[-0.51, 0.0, 0.0]]).expand(3, -1))


def test_with_nothing_found_the_fix_is_that_of_the_loop_and_an_early_one_lies_beyond_the_window(epoch):
    at_end = antenna(epoch.window.end, epoch.rate_at_fix_b, epoch.lever_arm_b, epoch.frame)
    assert torch.allclose(predicted(epoch, 0, 0, 0, 0, 0).z, epoch.fix.value - at_end, atol=1e-9)
    early = predicted(epoch, -0.2, 0, 0, 0, 0)
    few = round(SLOPE_S / epoch.dt)
    a = (epoch.window.end.v_n - epoch.window.v_n[:, -1 - few]) / SLOPE_S
    further = torch.cat((0.2 * at_end[:, 3:] + 0.02 * a, 0.2 * a), -1)
    assert torch.allclose(early.z, epoch.fix.value - at_end - further, atol=1e-9)
    assert torch.equal(early.fix.lag, epoch.z.new_full((3,), -0.2))
    apart = predicted(epoch, 0.3, -0.5, 0, 0, 0)  # a velocity after the window's end, a position within
    assert torch.allclose(apart.z[:, :3], predicted(epoch, 0.3, 0, 0, 0, 0).z[:, :3])
    assert torch.allclose(apart.z[:, 3:], early.z[:, 3:], atol=0.03)  # the arm swings as at the position


def test_the_position_of_a_start_is_as_uncertain_as_the_age_and_the_antenna_of_a_fix():
    """Of a start that was found from fixes; one that is given is what it says."""
    batch, kalman = car_batch(2, 3), build_filter("mbkf15+receiver", IMU)
    given, found = (
        kalman.begin(b)[0].P for b in (batch, replace(batch, start_noise=torch.ones(2, 2, dtype=torch.float64)))
    )
    v, C = batch.start.v_n, batch.start.C_nb
    own = torch.diag_embed(batch.start_std[:, :3].square())
    want = own + 0.05**2 * v[:, :, None] * v[:, None] + 0.2**2 * C @ C.mT
    assert torch.allclose(found[:, :3, :3], want.to(found), rtol=1e-9)
    assert torch.allclose(given[:, :3, :3], own.to(given), rtol=1e-9)
    states, found = kalman.states, found.double()
    assert torch.allclose(found[:, :3, states.of(DELAY).start], 0.05**2 * v, rtol=1e-6)  # δp = v δd − C δl
    arm = states.of(ARM[0]).start
    assert torch.allclose(found[:, :3, arm : arm + 3], -(0.2**2) * C, rtol=1e-6, atol=1e-9)
    assert float(torch.linalg.eigvalsh(found).min()) > 0


@pytest.fixture(scope="module")
def cars(tmp_path_factory):
    """Three minutes with noise of IMU and receiver, once as they are, once with fixes that are 0.2 s old at their stamp
    and an antenna elsewhere, and once with a receiver's clock that is fast by 400 ppm."""
    folder, g = tmp_path_factory.mktemp("receiver"), np.random.default_rng(0)
    tables = car(180)
    imu, gnss = tables["imu"], tables["gnss"]
    imu[["accel_x", "accel_y", "accel_z"]] += 0.02 * g.standard_normal((len(imu), 3)) + 0.03
    imu[["gyro_x", "gyro_y", "gyro_z"]] += 1e-3 * g.standard_normal((len(imu), 3)) + 1e-3
    gnss[["lat_deg", "lon_deg"]] += 0.02 / 111_195 * g.standard_normal((len(gnss), 2))
    gnss["height_m"] += 0.03 * g.standard_normal(len(gnss))
    gnss[["vel_n", "vel_e", "vel_d"]] += 0.05 * g.standard_normal((len(gnss), 3))
    late = gnss.assign(t=gnss["t"] + WRONG[DELAY])
    fast = gnss.assign(t=gnss["t"] * (1 + PPM * FAST))
    for name, fixes in (("right", gnss), ("wrong", late), ("fast", fast)):
        arm = {f"lever_arm_{x}_m": -WRONG[n] if name == "wrong" else 0.0 for x, n in zip("xyz", ARM)}
        row = write_drive(folder / name, {"drive": name, **arm}, imu, fixes, tables["reference"])
        write_drives_table(folder / name, [row])
    return {name: load_dataset(folder / name, dtype=torch.float64)[0] for name in ("right", "wrong", "fast")}


def run(drive, model: str, outage: bool = False):
    """Solution and batch; with an outage, the last 30 s are without fixes."""
    batch = whole_drives([drive], align_each([drive], replace(ALIGN, search_s=0.0)))
    T = batch.size[1]
    if outage:
        batch = withhold_fixes(batch, (torch.arange(T) >= T - 30).expand(1, -1))
    kalman = build_filter(model, IMU)
    return kalman, integrate(batch, kalman, keep_innovations=True), batch


def test_delay_and_antenna_are_found(cars):
    """Within 3σ, of which the delay's is below 10 ms; the innovations are then as large as the filter says."""
    for name, wrong in (("wrong", WRONG), ("right", dict.fromkeys(WRONG, 0.0))):
        kalman, solution, _ = run(cars[name], "mbkf21_car+receiver")
        columns = aid_columns(kalman)
        last = dict(zip(columns, solution.aids[0, -1].tolist()))
        for parameter, value in wrong.items():
            assert abs(last[parameter] - value) < 3 * last[f"std_{parameter}"]
        assert last[f"std_{DELAY}"] < 0.01 and max(last[f"std_{x}"] for x in ARM[:2]) < 0.15
        z, S = solution.innovation[0, 100:], solution.innovation_covariance[0, 100:]
        ratio = (z.unsqueeze(1) @ torch.linalg.solve(S, z.unsqueeze(-1))).mean() / 6
        assert 0.2 < ratio < 1.5


def test_a_delay_that_grows_is_one_transition():
    """P ← T P Tᵀ, the estimates likewise, and T is in the Φ that a smoother gets."""
    states = build_filter("mbkf15+receiver", IMU).states
    A = torch.randn(2, states.count, states.count, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    x, T = torch.arange(1.0, 13.0).double().view(2, 6), torch.eye(states.count, dtype=torch.float64)
    T[states.of(DELAY).start, states.of(DRIFT).start] = 30.0 * PPM
    P, grown = let_delay_grow(A @ A.mT, x, states, 30.0)
    assert torch.allclose(P, T @ A @ A.mT @ T.mT) and torch.equal(
        add_drift(torch.eye(len(T)).double()[None], states, 30.0)[0], T
    )
    of_receiver = T[states.of_others, states.of_others]
    assert torch.allclose(grown, x @ of_receiver.mT)


def test_the_drift_of_a_clock_is_found(cars):
    """Within 3σ, after three minutes below 20 ppm; and with it the delay, and what an outage makes of it."""
    kalman, solution, batch = run(cars["fast"], "mbkf21_car+receiver", outage=True)
    last = dict(zip(aid_columns(kalman), solution.aids[0, -31].tolist()))
    assert abs(last[DRIFT] - FAST) < 3 * last[f"std_{DRIFT}"] < 60
    t = float(batch.t_start[0]) + (batch.size[1] - 30) * batch.epoch_s
    assert abs(last[DELAY] - PPM * FAST * t) < 3 * last[f"std_{DELAY}"]
    at_end = float(solution.aids[0, -1, [*aid_columns(kalman)].index(DELAY)])
    assert at_end == pytest.approx(last[DELAY] + 30 * PPM * last[DRIFT], abs=5e-4)
    off, of_right = (
        float((s.posterior.p_n - b.truth.p_n)[0, -1, :2].norm())
        for _, s, b in ((kalman, solution, batch), run(cars["right"], "mbkf21_car+receiver", outage=True))
    )
    assert off < of_right + 0.5


@pytest.mark.commands
def test_a_stationary_car_shows_no_delay():
    """After half an hour at rest under good fixes the delay is as unknown as without any, and not moved: there its H
    would be the filter's own error in velocity, which the innovation has too."""
    T, M = 1800, 10
    batch, g = car_batch(1, T, M), torch.Generator().manual_seed(1)
    still = NavState(*(0 * x for x in batch.start[:2]), batch.start.C_nb)
    noise = torch.randn(1, T, M + 1, 6, generator=g, dtype=torch.float64)
    gravity = batch.frame.gravity(still.p_n) @ still.C_nb[0]
    rest = torch.cat((-gravity, batch.frame.earth_rate_n @ still.C_nb[0]), -1)
    batch = replace(
        batch, start=still, imu=rest + noise[:, :, :M] * noise.new_tensor([0.02] * 3 + [1e-3] * 3),
        gnss=0.02 * noise[:, :, M], gnss_std=torch.full((1, T, 6), 0.02, dtype=torch.float64),
    )  # fmt: skip
    kalman = build_filter("mbkf21_car+receiver", IMU)
    with torch.inference_mode():
        last = dict(zip(aid_columns(kalman), integrate(batch, kalman).aids[0, -1].tolist()))
    assert abs(last[DELAY]) < 0.2 * last[f"std_{DELAY}"] and last[f"std_{DELAY}"] > 0.15


def test_an_outage_is_as_good_as_with_the_right_ones(cars):
    def error(name: str, model: str) -> float:
        _, solution, batch = run(cars[name], model, outage=True)
        return float((solution.posterior.p_n - batch.truth.p_n)[0, -1, :2].norm())

    right = error("right", "mbkf21_car")
    assert error("right", "mbkf21_car+receiver") < right + 0.3
    assert error("wrong", "mbkf21_car+receiver") < right + 0.5 < 2.0 < error("wrong", "mbkf21_car")


def averaged(drive, seconds: int):
    """The drive with positions as a receiver gives them that averages over the last seconds, its velocities as they
    are."""
    r = drive.gnss_r_e
    late = torch.stack([r.roll(k, 0) for k in range(seconds)]).mean(0)
    late[:seconds] = r[:seconds]
    return replace(drive, gnss_r_e=late)


def test_positions_that_a_receiver_averages_are_older_than_its_velocities(cars):
    """By one second for means of three fixes a second apart; velocities that lag are found likewise."""
    right = cars["right"]
    assert right.epoch_s == 1.0
    late = right.gnss_v_e.clone()
    late[1:] -= 0.3 * (right.gnss_v_e[1:] - right.gnss_v_e[:-1])
    for drive, delay, older in (
        (right, 0.0, 0.0), (averaged(right, 2), 0.5, -0.5), (replace(right, gnss_v_e=late), 0.0, 0.3)
    ):  # fmt: skip
        kalman, solution, _ = run(drive, "mbkf21_car+receiver")
        last = dict(zip(aid_columns(kalman), solution.aids[0, -1].tolist()))
        assert abs(last[DELAY] - delay) < 0.03 and abs(last[VELOCITY_DELAY] - older) < 0.06
        assert last[f"std_{VELOCITY_DELAY}"] < 0.03


def test_what_is_beyond_any_receiver_is_not_followed(cars):
    """An IMU that is three seconds late."""
    right = cars["right"]
    late = right.imu.flatten(0, 1).roll(round(3 * right.rate_hz), 0).reshape(right.imu.shape)
    kalman, solution, _ = run(replace(right, imu=late), "mbkf21_car+receiver")
    found = solution.aids[0, :, [*aid_columns(kalman)].index(DELAY)]
    assert -0.9 <= float(found.min()) < -0.85


@pytest.mark.parametrize(("names", "part"), [((DELAY,), 0), ((DELAY, VELOCITY_DELAY), 1), ((ARM[1],), 0)])
def test_information_discounted_is_that_of_a_fix_that_was_as_noisy_from_the_start(names, part):
    """Of what such a fix shows, whose prior is correlated with a velocity's; drives without doubt stay."""
    filter_ = build_filter("mbkf15+receiver", IMU)
    states, first = filter_.states, filter_.states.of_others.start
    std = torch.tensor([1.0] * first + [filter_.parameters[x].std for x in states.others]).double()
    k, share = [states.of(name).start for name in names], 0.04
    P = torch.diag(std**2)
    P[k, 3] = P[3, k] = 0.6 * std[k]
    spread = float(P[k][:, k].sum() ** 0.5)  # of the sum that the fix shows
    P, H, z = P.repeat(2, 1, 1), torch.zeros(2, 1, states.count).to(P), torch.full((2, 1), 1.5 * spread).to(P)
    H[:, 0, k] = 1.0
    R = torch.full_like(z, 0.5 * spread**2)
    parameters, kept = P.new_zeros(2, len(states.others)), P.new_ones(2, 2)
    trusted, _, after = kalman_update(P, H, R, z)
    doubted, _, wide = kalman_update(P, H, R / share, z)
    kept[0, part] = share
    found, dx = discount_information(after, trusted, parameters, states, kept)
    assert torch.allclose(found[0], wide[0], rtol=1e-6, atol=1e-9)
    assert torch.allclose(dx[0], doubted[0], rtol=1e-6, atol=1e-9)
    assert torch.equal(found[1], after[1]) and torch.equal(dx[1], trusted[1])
    # what was found before counts as well
    found, dx = discount_information(after, 0 * trusted, parameters + trusted[:, first:], states, kept)
    assert torch.allclose((trusted + dx)[0, k], doubted[0, k], rtol=1e-6)
