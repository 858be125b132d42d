"""A stream that goes on after a gap of the IMU: samples that fill it, covariance, memory, the solution after it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from dlkf.data.alignment import AlignConfig
from dlkf.data.store import drive_from_tables
from dlkf.filters.build import build_filter
from dlkf.navigation.earth import tangent_frame
from dlkf.navigation.state import ATTITUDE, POSITION, VELOCITY, NavState
from dlkf.navigation.strapdown import strapdown
from dlkf.running.bridging import (
    CORRELATION,
    LONGEST_BRIDGE_S,
    OF_POSITION,
    SAMPLES_ATTITUDE_STD,
    SAMPLES_VELOCITY_STD,
    Stretch,
    bridge,
    can_bridge,
    fill_gap,
)
from dlkf.running.replay import replay_drive
from dlkf.running.start import align_drives
from dlkf.running.streaming import Status, StreamingFilter
from tests.running.streams import ARM, EARTH, IMU, estimator, some

FILTERS = ("ins", "mbkf15", "mbkf21_car", "aekf", "plus", "net_run", "dlkf_kalman_mbkf21_car")


def _run(tables, name, begin, end, without=(np.inf, np.inf)):
    """The stream, its receipts that are not ``taken``, its estimates by time; without samples and fixes for a time."""
    t, t_fix = tables.imu["t"], tables.gnss["t"]
    tables = some(tables, (t <= begin) | (t > end), "imu")
    tables = some(tables, (t_fix <= without[0]) | (t_fix > without[1]), "gnss")
    stream, said, found = StreamingFilter(estimator(name), lever_arm_b=ARM), [], {}
    for receipt in replay_drive(stream, tables.imu, tables.gnss):
        if receipt.status is not Status.TAKEN:
            said.append(receipt)
        found.update((round(e.t, 6), e) for e in receipt.estimates)
    return stream, said, found


def _off(estimate, tables) -> float:
    """Horizontal error [m]."""
    k = int(np.argmin(np.abs(tables.reference["t"] - estimate.t)))
    row, ref = estimate.row, tables.reference
    north = np.radians(row["lat_deg"] - ref["lat_deg"][k]) * EARTH
    return float(
        np.hypot(north, np.radians(row["lon_deg"] - ref["lon_deg"][k]) * EARTH * np.cos(np.radians(row["lat_deg"])))
    )


def test_what_fills_a_gap():
    """Exact where forward and lateral acceleration and yaw rate are linear in time; the rest is as usual."""
    t = np.arange(30)[:, None]
    samples = 1.0 + t * np.array([0.1, -0.2, 0.3, 0.4, 0.5, 0.6])
    filled = fill_gap(samples[:5], samples[20:25], np.full(6, 7.0), 15)
    line = [0, 1, 5]
    step = (samples[22] - samples[2]) / 16  # from the middle of the five before to that of the five after
    np.testing.assert_allclose(filled[:, line], (samples[2] + (1 + np.arange(15))[:, None] * step)[:, line])
    np.testing.assert_array_equal(filled[:, [2, 3, 4]], 7.0)


def test_transition_of_a_stretch_matches_finite_differences():
    """Of the strapdown, over two seconds of constant specific force, but for Earth rotation and gravity gradient."""
    z = torch.zeros(1, 3, dtype=torch.float64)
    frame = tangent_frame(*(torch.tensor([x], dtype=torch.float64) for x in (0.8, 0.2, 100.0)))
    imu = torch.tensor([1.0, 0.5, -9.8, 0.0, 0.0, 0.0], dtype=torch.float64).expand(1, 100, 6)

    def run(dx):
        start = NavState(z, z + 10.0, torch.eye(3, dtype=torch.float64)[None]).correct(dx)
        return start, strapdown(start, imu, 0.02, frame).end

    start, end = run(torch.zeros(1, 9, dtype=torch.float64))
    stretch = Stretch(start, end, torch.tensor([[0.5, 1.0, 0.5]], dtype=torch.float64), frame)
    Phi = stretch.transition(torch.tensor([2.0], dtype=torch.float64), torch.eye(9, dtype=torch.float64)[None])[0]
    eps = 1e-5
    for k in range(9):
        dx = torch.zeros(1, 9, dtype=torch.float64)
        dx[0, k] = eps
        difference = end.error_to(run(dx)[1])[0] / eps
        torch.testing.assert_close(Phi[:, k], difference, atol=0.01, rtol=1e-3)  # of up to 20


def test_covariance_of_a_stretch_grows_with_the_gap_and_stays_one():
    like = torch.diag_embed(torch.full((1, 21), 1e-4, dtype=torch.float64))
    z = torch.zeros(1, 3, dtype=torch.float64)
    frame = tangent_frame(*(torch.tensor([x], dtype=torch.float64) for x in (0.8, 0.2, 100.0)))
    state = NavState(z, z, torch.eye(3, dtype=torch.float64)[None])
    before = 0.0
    for missing in (0.3, 1.0, 2.0, LONGEST_BRIDGE_S):
        seconds = torch.tensor([[0.4, missing, 0.6]], dtype=torch.float64)
        P = Stretch(state, state, seconds, frame).covariance(like)[0]
        assert torch.equal(P, P.mT) and float(torch.linalg.eigvalsh(P).min()) > 0
        assert torch.equal(P[9:, 9:], like[0, 9:, 9:])
        assert float(P.trace()) > before
        before = float(P.trace())
    # closed form after the longest gap, with the specific force g up: P at the start over 4 s, what the gap adds, 0.6 s
    T, after, span, g = LONGEST_BRIDGE_S, 0.6, LONGEST_BRIDGE_S + 1, float(frame.gravity(z)[0, 2])
    level, tilt = (0.2 * T**1.5) ** 2, np.radians(0.6) ** 2 * T + SAMPLES_ATTITUDE_STD**2 * span
    arm, samples = OF_POSITION * T, SAMPLES_VELOCITY_STD**2 * span
    yaw = 1e-4 + np.radians(T**2) ** 2 + SAMPLES_ATTITUDE_STD**2 * span
    velocity = 1e-4 * (1 + (g * span) ** 2) + level + samples + tilt * (g * after) ** 2
    position = 1e-4 * (1 + span**2 + (g * span**2 / 2) ** 2) + level * (arm**2 + 2 * after * CORRELATION * arm)
    position += after**2 * (level + samples) + tilt * (g * after**2 / 2) ** 2
    found = P.diagonal()[[POSITION.start, VELOCITY.start, ATTITUDE.start + 2]]
    np.testing.assert_allclose(found, [position, velocity, yaw], rtol=1e-9)


@pytest.mark.parametrize("name", FILTERS)
def test_a_filter_goes_on_after_a_gap(drive, name):
    """Half a second lost in an outage: reported once, no row inside the gap, and the outage ends hardly further off."""
    outage = (31.5, 40.5)
    _, _, whole = _run(drive, name, np.inf, np.inf, outage)
    stream, said, found = _run(drive, name, 34.13, 34.63, outage)
    bridged = [r for r in said if r.status is Status.BRIDGED]
    assert len(bridged) == 1 and bridged[0].reason == "gap of 0.510 s after t = 34.130000"
    assert stream.counts["refused"] == 4 and not stream.counts["restarted"] and not stream.aligning
    assert sorted(found) == sorted(whole)  # a row at the end of the stretch too
    assert not found[35.0].gnss_used and found[42.0].gnss_used
    assert abs(_off(found[40.0], drive) - _off(whole[40.0], drive)) < 1.5
    assert _off(found[50.0], drive) < 2 * _off(whole[50.0], drive) + 0.1
    if found[35.0].std is not None:
        assert (found[35.0].std[0, :9] > whole[35.0].std[0, :9]).all()


def test_a_gap_at_rest_and_one_in_motion_are_within_their_covariance(drive):
    """Every two seconds of the drive a gap of a second: the normalised squared error at the end of the stretch."""
    errors = []
    for begin in np.arange(20.13, 54.0, 2.0):
        _, said, found = _run(drive, "mbkf15", begin, begin + 1.0)
        assert [r.status for r in said][-1] is Status.BRIDGED
        at = float(np.ceil(begin + 1.0))
        variance = float(found[at].std[0, :2].square().mean())
        errors.append(_off(found[at], drive) ** 2 / (2 * variance))
    assert 0.05 < np.mean(errors) < 2.0  # of normal driving, the law holds for town cars


def test_what_is_longer_or_of_a_filter_without_a_rule_starts_over(drive):
    stream, _, _ = _run(drive, "mbkf15", 34.13, 34.13 + LONGEST_BRIDGE_S + 0.2)
    assert stream.counts["restarted"] == 1 and not stream.counts["bridged"]

    class Own(tuple):
        """A memory that nobody knows."""

    assert not can_bridge(Own())
    with pytest.raises(TypeError, match="no rule"):
        bridge(Own(), None, None)


def test_a_second_of_samples_begins_anew_for_the_wheel_too(drive):
    """Its vibration level is one of a second without a gap; with update intervals of 0.2 s it is kept between them."""
    cut = drive_from_tables(drive, "", 50.0, 0.2, torch.float64)
    batch = align_drives([cut], AlignConfig())
    fresh = build_filter("mbkf21_nhc+speed", IMU).begin(batch)[0]
    wheel, car = fresh.sources
    level = car.liveliness._replace(second=car.liveliness.second._replace(means=torch.ones(1, 10, 6)))
    shaken = wheel._replace(zone=torch.ones(1)), car._replace(liveliness=level)
    stretch = Stretch(batch.start, batch.start, torch.tensor([[0.1, 1.0, 0.1]], dtype=torch.float64), batch.frame)
    wheel, car = bridge(fresh._replace(sources=shaken), stretch, fresh).sources
    assert car.liveliness.second.means.isnan().all() and wheel.zone == 1


def test_a_stamp_ahead_is_not_taken_for_a_gap(drive):
    """Four samples a second ahead: refused, and nothing is filled."""
    imu = {name: x.copy() for name, x in drive.imu.items()}
    k = int(np.searchsorted(imu["t"], 34.0))
    imu["t"][k : k + 4] += 1.0
    stream, whole = (StreamingFilter(estimator("mbkf15"), lever_arm_b=ARM) for _ in range(2))
    for s, table in ((stream, imu), (whole, drive.imu)):
        for _ in replay_drive(s, table, drive.gnss):
            pass
    assert stream.counts["refused"] == 4 and not stream.counts["bridged"]
    assert abs(_off(stream.latest, replace(drive)) - _off(whole.latest, drive)) < 0.02
