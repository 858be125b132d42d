"""Metrics against loops and closed forms; NaN is "no truth", inf is "the filter broke"."""

import math
from dataclasses import replace

import numpy as np
import pymap3d
import pytest
import torch

from dlkf.evaluation import metrics as m
from dlkf.navigation.attitude import rotation_from_vector
from dlkf.navigation.state import NavState


def test_errors_are_truth_minus_estimate_in_the_tangent_frame_near_its_origin(cars):
    dx = torch.tensor([1.0, -2.0, 3.0, 0.1, -0.2, 0.3, 0.01, -0.02, 0.05], dtype=torch.float64)
    B, T, _ = cars.size
    estimate = cars.truth.correct(-dx.expand(B, T, 9))  # truth = estimate ⊞ dx up to the order of rotations
    error = m.error_series(cars, estimate)
    # 1 km from the origin the axes turn by 1.6e-4 rad: 4e-4 of a 2.2 m error, and convergence of as much
    assert np.allclose(error, dx.numpy(), atol=2e-3)


def test_far_from_the_origin_errors_are_in_true_local_ned(cars):
    """100 km east, north of the vehicle is 1 degree off the frame's; pymap3d is the oracle."""
    far = torch.tensor([40e3, 100e3, 800.0], dtype=torch.float64)
    truth = NavState(cars.truth.p_n + far, cars.truth.v_n, cars.truth.C_nb)
    batch = replace(cars, truth=truth)
    estimate = NavState(truth.p_n + torch.tensor([30.0, 40.0, 5.0]).double(), truth.v_n, truth.C_nb)
    error = m.error_series(batch, estimate)
    ecef = [batch.frame.to_ecef(s.p_n)[0, 0].numpy() for s in (truth, estimate)]
    lat, lon, h = pymap3d.ecef2geodetic(*ecef[0])
    east, north, up = pymap3d.ecef2enu(*ecef[1], lat, lon, h)
    assert np.allclose(error[0, 0, :3], [-north, -east, up], atol=1e-6)
    assert abs(math.atan2(east, north) - math.atan2(40, 30)) > math.radians(0.5)  # the correction matters


def test_unknown_truth_is_nan_and_a_broken_filter_is_inf(cars):
    valid = cars.truth_valid.clone()
    valid[0, 10] = False
    level = torch.zeros_like(cars.attitude_valid)
    padded = cars.present.clone()
    padded[1, 50:] = False
    batch = replace(cars, truth_valid=valid, attitude_valid=level, present=padded)
    broken = cars.truth.p_n.clone()
    broken[2, 5] = math.nan
    error = m.error_series(batch, NavState(broken, cars.truth.v_n, cars.truth.C_nb))
    assert np.isnan(error[0, 10]).all() and np.isnan(error[1, 50:]).all()
    assert np.isnan(error[..., 6:]).all()
    assert np.isinf(error[2, 5, :3]).all() and np.isfinite(error[2, 5, 3:6]).all()
    size = m.magnitudes(error)
    rms = m.segment_rms(size["position"])
    assert np.isinf(rms[2]) and np.isfinite(np.delete(rms, 2)).all()
    assert m.summarise_errors(rms)["nonfinite"] == 1 and m.summarise_errors(rms)["rms"] == math.inf
    assert m.summarise_errors(m.segment_rms(size["attitude"]))["n"] == 0


def test_attitude_error_is_the_rotation_angle(cars):
    phi = torch.tensor([0.3, -1.0, 2.0], dtype=torch.float64)
    estimate = NavState(cars.truth.p_n, cars.truth.v_n, rotation_from_vector(-phi) @ cars.truth.C_nb)
    size = m.magnitudes(m.error_series(cars, estimate))
    assert np.allclose(size["attitude"], phi.norm().item(), atol=1e-9)


def test_segment_rms_equals_a_loop_over_valid_epochs():
    rng = np.random.default_rng(0)
    x = rng.normal(size=(5, 40))
    x[rng.random(x.shape) < 0.3] = np.nan
    x[4] = np.nan
    mask = rng.random(x.shape) < 0.7
    for i in range(4):
        kept = [v for v, k in zip(x[i], mask[i]) if k and not math.isnan(v)]
        assert m.segment_rms(x, mask)[i] == pytest.approx(math.sqrt(sum(v * v for v in kept) / len(kept)))
    assert math.isnan(m.segment_rms(x, mask)[4])


def test_summary_of_known_numbers():
    s = m.summarise_errors(np.array([3.0, 4.0, np.nan, 0.0]))
    assert (s["n"], s["nonfinite"], s["median"], s["max"]) == (3, 0, 3.0, 4.0)
    assert s["rms"] == pytest.approx(math.sqrt(25 / 3)) and s["mean"] == pytest.approx(7 / 3)


def test_summary_in_closed_form():
    s = m.summarise_errors(np.arange(101.0))
    assert s["p95"] == pytest.approx(95.0)
    assert m.summarise_errors(np.array([1.0, 4.0, 16.0]))["geomean"] == pytest.approx(4.0)
    assert m.summarise_errors(np.array([1.0, 1.0, 8.0]))["geomean"] == pytest.approx(2.0)


def test_magnitudes_are_lengths_of_their_axes():
    error = np.array([3.0, 4.0, -12.0, 1.0, -2.0, 2.0, 0.02, 0.03, -0.06])
    assert m.magnitudes(error) == pytest.approx(
        {"position": 13.0, "horizontal": 5.0, "vertical": 12.0, "velocity": 3.0, "attitude": 0.07, "heading": 0.06}
    )


def test_outage_values_equal_a_loop():
    rng = np.random.default_rng(1)
    outage = np.zeros((3, 50), bool)
    outage[0, 10:20] = outage[0, 30:50] = outage[2, 0:5] = True
    x = rng.normal(size=outage.shape) ** 2
    w = m.outage_intervals(outage)
    assert list(zip(*(a.tolist() for a in w))) == [(0, 10, 10), (0, 30, 20), (2, 0, 5)]
    assert m.outage_end(x, w).tolist() == [x[0, 19], x[0, 49], x[2, 4]]
    at = m.outage_at(x, w, np.array([5.0, 10.0, 20.0]), epoch_s=1.0)
    assert np.array_equal(at, [[x[0, 14], x[0, 19], np.nan], [x[0, 34], x[0, 39], x[0, 49]],
                               [x[2, 4], np.nan, np.nan]], equal_nan=True)  # fmt: skip
    half = m.outage_at(x, w, np.array([5.0]), epoch_s=0.5)  # 5 s are 10 epochs of 0.5 s
    assert half[0, 0] == x[0, 19]
    expected = [math.sqrt(np.mean(x[i, a : a + n] ** 2)) for i, a, n in zip(*w)]
    assert np.allclose(m.outage_rms(x, w), expected)


def test_distance_in_an_outage_at_constant_speed():
    v = np.zeros((2, 30, 3))
    v[..., 0], v[..., 1], v[..., 2] = 6.0, 8.0, 99.0  # 10 m/s over ground, whatever it does vertically
    outage = np.zeros((2, 30), bool)
    outage[:, 5:20] = True
    v[0, 4] = np.nan  # at the start of the outage: the speed a second later stands for it
    v[1, 7] = np.nan
    distance = m.outage_distance(v, m.outage_intervals(outage), epoch_s=1.0)
    assert distance[0] == pytest.approx(150.0) and math.isnan(distance[1])


def test_distance_in_an_outage_at_constant_acceleration():
    """Speed 2 t at the epochs' ends, t = 0.5 … 15 s: the trapezoid is exact, ∫ from 2.5 to 10 s is 10² − 2.5²."""
    v = np.zeros((1, 30, 3))
    v[0, :, 1] = 2 * 0.5 * np.arange(1, 31)
    outage = np.zeros((1, 30), bool)
    outage[:, 5:20] = True
    assert m.outage_distance(v, m.outage_intervals(outage), epoch_s=0.5)[0] == pytest.approx(93.75)


def test_slope_tells_an_estimator_from_a_memoriser():
    rng = np.random.default_rng(2)
    cause = rng.normal(size=(200, 6)) * [0.1, 0.1, 0.1, 2e-3, 2e-3, 2e-3]
    noise = 0.1 * cause.std(0) * rng.normal(size=cause.shape)
    assert np.allclose(m.slope(cause + noise, cause, intercept=False), 1.0, atol=0.03)  # 0.1/√200 = 0.007
    memorised = np.broadcast_to([0.3, 0.2, 0.1, 0.01, 0.02, 0.03], cause.shape)
    assert np.allclose(m.slope(memorised + noise, cause, intercept=True), 0.0, atol=0.03)
    halfway = 0.5 * cause + memorised
    assert np.allclose(m.slope(halfway, cause, intercept=True), 0.5)


def test_slope_is_unknown_where_nothing_varies():
    same = np.tile([0.1, 0.0, -0.3, 1e-3, 0.0, 2e-3], (20, 1))
    assert np.isnan(m.slope(same, same, intercept=True)).all()
    assert np.isnan(m.slope(same, np.full_like(same, np.nan), intercept=True)).all()
