"""The windowed strapdown against closed forms, a sample-by-sample oracle, python-ins and finite differences."""

import numpy as np
import pandas as pd
import pymap3d
import pytest
import torch
from pyins.strapdown import Integrator

from dlkf.navigation import compiled
from dlkf.navigation.attitude import rotation_from_rpy, rotation_from_vector, vector_from_rotation
from dlkf.navigation.earth import EARTH_RATE
from dlkf.navigation.state import NavState
from dlkf.navigation.strapdown import strapdown

from .oracle import frame_at, lively_imu, mechanise, still_imu

DT, M = 0.02, 50


def start(batch: int, seed: int = 5) -> NavState:
    g = torch.Generator().manual_seed(seed)

    def draw(scale):
        return scale * torch.randn(batch, 3, generator=g, dtype=torch.float64)

    return NavState(draw(200.0), draw(15.0), rotation_from_rpy(draw(0.5)))


def run(state: NavState, imu: torch.Tensor, frame, dt: float = DT, window: int = M) -> NavState:
    for first in range(0, imu.shape[1], window):
        state = strapdown(state, imu[:, first : first + window], dt, frame).end
    return state


def at_rest(batch: int = 1) -> NavState:
    zero = torch.zeros(batch, 3, dtype=torch.float64)
    return NavState(zero, zero, torch.eye(3, dtype=torch.float64).expand(batch, 3, 3))


def test_sample_by_sample_parity():
    """5 s of rough motion. The oracle's own step error (Heun, 0.5 ms) bounds the agreement."""
    frame, imu = frame_at(batch=3), lively_imu(3, 5 * M)
    expected = mechanise(start(3), imu, DT, frame)
    got = run(start(3), imu, frame)
    assert (got.p_n - expected.p_n[:, -1]).abs().max() < 1e-4
    assert (got.v_n - expected.v_n[:, -1]).abs().max() < 5e-5
    assert vector_from_rotation(got.C_nb @ expected.C_nb[:, -1].mT).abs().max() < 1e-8


def test_all_samples_of_a_window_not_only_its_end():
    frame, imu = frame_at(batch=2), lively_imu(2, M)
    expected, got = mechanise(start(2), imu, DT, frame), strapdown(start(2), imu, DT, frame)
    assert (got.p_n - expected.p_n).abs().max() < 5e-6
    assert (got.C_nb - expected.C_nb).abs().max() < 1e-8


def test_constant_acceleration_error_drifts_180_m_in_a_minute():
    """R014: ½ · 0.1 m/s² · (60 s)²; the Schuler term takes 0.03 % of it (ω_s² t² / 12)."""
    frame = frame_at()
    imu = still_imu(frame, 60 * M)
    imu[..., 0] += 0.1
    drift = run(at_rest(), imu, frame).p_n[0, 0]
    assert abs(float(drift) - 180.0) < 0.15


def test_constant_gyro_error_tilts_into_gravity():
    """A north gyro error w makes g w t³ / 6 of east drift: 44 km per rad/s at 30 s (paper.md 4.11)."""
    frame = frame_at()
    imu = still_imu(frame, 30 * M)
    imu[..., 3] += 1e-5
    drift = run(at_rest(), imu, frame).p_n[0, 1]
    # roll grows by w t; C f points −g along the tilted down axis, whose east part is + g sin(roll)
    expected = float(frame.gravity(torch.zeros(1, 3, dtype=torch.float64))[0, 2]) * 1e-5 * 30**3 / 6
    assert abs(float(drift) / expected - 1) < 1e-3


def test_rest_stays_at_rest():
    """Ten minutes still: what is left is the second order in ωT, g (ωT)² / 6 = 9e-9 m/s², 2 mm."""
    frame = frame_at()
    end = run(at_rest(), still_imu(frame, 600 * M), frame)
    assert end.p_n.abs().max() < 3e-3
    assert vector_from_rotation(end.C_nb).abs().max() < 1e-10


def test_free_inertial_direction_turns_with_the_earth():
    """A gyro that reads zero is fixed in inertial space, so it turns by −ω t against the Earth."""
    frame = frame_at()
    imu = still_imu(frame, 600 * M)
    imu[..., 3:] = 0
    turned = vector_from_rotation(run(at_rest(), imu, frame).C_nb)
    assert (turned + 600 * frame.earth_rate_n).abs().max() < 1e-9
    assert abs(float(turned.norm()) - 600 * EARTH_RATE) < 1e-9


@pytest.mark.parametrize("window", [1, 10, 25, 100])
def test_chunking_does_not_matter(window):
    """Windows of any length give the same drive; the rest is gravity's change along the
    window (this motion falls 640 m in 12 s) and the second order in ωT."""
    frame, imu = frame_at(batch=2), lively_imu(2, 6 * 100)
    whole, chunks = run(start(2), imu, frame, window=50), run(start(2), imu, frame, window=window)
    assert (whole.p_n - chunks.p_n).abs().max() < 3e-4
    assert vector_from_rotation(whole.C_nb @ chunks.C_nb.mT).abs().max() < 5e-8


def test_batched_equals_looped():
    frame, imu, state = frame_at(batch=3), lively_imu(3, M), start(3)
    together = strapdown(state, imu, DT, frame)
    for b in range(3):
        one = strapdown(NavState(*(x[b : b + 1] for x in state)), imu[b : b + 1], DT, frame[b : b + 1])
        assert (one.p_n[0] - together.p_n[b]).abs().max() < 1e-11


def test_float32_stays_within_centimetres_of_float64():
    """One minute in local metres: float32 costs centimetres, where ECEF would cost half a metre a step."""
    imu = lively_imu(8, 60 * M) * torch.tensor([0.3, 0.3, 1, 0.1, 0.1, 0.2], dtype=torch.float64)
    state = start(8)
    exact = run(state, imu, frame_at(batch=8))
    rough = run(NavState(*(x.float() for x in state)), imu.float(), frame_at(batch=8, dtype=torch.float32))
    assert (exact.p_n - rough.p_n.double()).norm(dim=-1).max() < 0.1
    assert vector_from_rotation(exact.C_nb @ rough.C_nb.double().mT).abs().max() < 3e-5


@pytest.mark.parametrize("loops", [True, False])
def test_adjoint_agrees_with_finite_differences(loops, monkeypatch):
    """Both forms of the gradient: compiled loops and tensor operations."""
    assert compiled.AVAILABLE
    monkeypatch.setattr(compiled, "AVAILABLE", loops)
    frame, imu, base = frame_at(), lively_imu(1, 6), start(1)

    def states(p, v, turn, samples):
        window = strapdown(NavState(p, v, rotation_from_vector(turn) @ base.C_nb), samples, 0.1, frame)
        return window.p_n, window.v_n, vector_from_rotation(window.C_nb @ base.C_nb.mT)

    zero = torch.zeros(1, 3, dtype=torch.float64)
    inputs = [x.clone().requires_grad_() for x in (base.p_n, base.v_n, zero, imu)]
    assert torch.autograd.gradcheck(states, inputs, atol=1e-5, rtol=1e-4)  # gravity's off-diagonal gradient


def test_state_between_samples():
    frame, imu, state = frame_at(), lively_imu(1, M), start(1)
    window = strapdown(state, imu, DT, frame)
    lag = torch.tensor([10.5 * DT], dtype=torch.float64)
    between = window.interpolate_before(state, lag, DT)
    assert torch.allclose(between.p_n, (window.p_n[:, -11] + window.p_n[:, -12]) / 2)
    at_end = window.interpolate_before(state, torch.zeros(1, dtype=torch.float64), DT)
    assert torch.allclose(at_end.C_nb, window.end.C_nb, atol=1e-9)
    lag = torch.tensor([(M - 0.25) * DT], dtype=torch.float64)  # in the first sample
    first = window.interpolate_before(state, lag, DT)
    assert torch.allclose(first.p_n, 0.75 * state.p_n + 0.25 * window.p_n[:, 0])
    assert torch.allclose(window.velocity_before(state, lag, DT), first.v_n)
    at_start = window.interpolate_before(state, torch.tensor([M * DT], dtype=torch.float64), DT)
    assert torch.allclose(at_start.C_nb, state.C_nb, atol=1e-9) and torch.allclose(at_start.p_n, state.p_n)


def test_python_ins_agrees_on_a_minute_of_driving():
    """python-ins integrates in its own wander of latitude and longitude: another mechanisation altogether."""

    lat, lon, height = 52.1, 9.9, 80.0
    frame = frame_at(np.deg2rad(lat), np.deg2rad(lon), height)
    n = 60 * 100
    t = np.arange(n) * 0.01
    rate = np.stack((0.02 * np.sin(t), 0.02 * np.cos(1.3 * t), 0.2 * np.sin(0.2 * t)), -1)
    force = np.stack((np.sin(0.3 * t), 0.5 * np.cos(0.4 * t), -9.81 + 0.1 * np.sin(t)), -1)
    imu = torch.from_numpy(np.concatenate((force, rate), -1))[None]
    state = NavState(
        torch.zeros(1, 3, dtype=torch.float64),
        torch.tensor([[10.0, 5.0, 0.0]], dtype=torch.float64),
        rotation_from_rpy(torch.tensor([[0.01, -0.02, 0.5]], dtype=torch.float64)),
    )
    ours = run(state, imu, frame, dt=0.01, window=100)
    pva = pd.Series(
        [lat, lon, height, 10.0, 5.0, 0.0, *np.rad2deg([0.01, -0.02, 0.5])],
        index=["lat", "lon", "alt", "VN", "VE", "VD", "roll", "pitch", "heading"],
        name=0.0,
    )
    turned = force * 0.01 + np.cross(rate * 0.01, force * 0.01) / 2  # their increments contain the sample's turn
    increments = pd.DataFrame(
        np.concatenate((np.full((n, 1), 0.01), rate * 0.01, turned), -1),
        columns=["dt", "theta_x", "theta_y", "theta_z", "dv_x", "dv_y", "dv_z"],
        index=np.arange(1, n + 1) * 0.01,
    )
    theirs = Integrator(pva, True).integrate(increments).iloc[-1]
    p = ours.p_n[0].numpy()
    lat2, lon2, height2 = pymap3d.ned2geodetic(*p, lat, lon, height)
    offset = pymap3d.geodetic2ned(theirs["lat"], theirs["lon"], theirs["alt"], lat2, lon2, height2)
    # their gravity drops part of the height term and their in-sample force is not turned: 2 cm over 1 km
    assert np.linalg.norm(offset) < 0.05


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_compiled_form_is_the_tensor_form(dtype):
    """On a CPU the samples are summed by a compiled loop, with gradients and without: the same to rounding."""
    frame = frame_at(batch=3, dtype=dtype)
    g = torch.Generator().manual_seed(8)
    p, v, a = (s * torch.randn(3, 3, generator=g, dtype=torch.float64) for s in (300.0, 20.0, 1.0))
    start = NavState(*(x.to(dtype) for x in (p, v, rotation_from_rpy(a))))
    imu = lively_imu(3, 100, 9).to(dtype)
    imu[1, :, 3:] = 0.0  # no turn at all
    with compiled.tensor_forms():
        assert not compiled.fits(imu, gradients=True)
        expected = strapdown(start, imu, 0.01, frame)
    with torch.no_grad():
        assert compiled.fits(imu)
        plain = strapdown(start, imu, 0.01, frame)
    assert compiled.fits(imu, gradients=True)
    with_gradients = strapdown(start, imu, 0.01, frame)
    eps = torch.finfo(dtype).eps
    for got in (plain, with_gradients):
        for one, other in zip((*got[:3], *got.end), (*expected[:3], *expected.end)):
            assert (one - other).abs().max() < 50 * eps * other.abs().max()


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_compiled_gradient_is_that_of_the_tensor_form(dtype, monkeypatch):
    """Of all samples' states and of the end's alone (as where no gradient goes through a network's inputs)."""
    frame, imu, base = frame_at(batch=3, dtype=dtype), lively_imu(3, M).to(dtype), start(3)
    base = NavState(*(x.to(dtype) for x in base))
    g = torch.Generator().manual_seed(9)
    weights = [torch.randn(3, M, *shape, generator=g, dtype=torch.float64).to(dtype) for shape in ((3,), (3,), (3, 3))]

    def gradients(loops: bool, samples: bool) -> tuple[torch.Tensor, ...]:
        monkeypatch.setattr(compiled, "AVAILABLE", loops)
        inputs = [x.clone().requires_grad_() for x in (*base, imu)]
        window = strapdown(NavState(*inputs[:3]), inputs[3], DT, frame)
        value = sum((x * w[:, -1]).sum() for x, w in zip(window.end, weights))
        if samples:
            value = value + sum((x * w).sum() for x, w in zip(window[:3], weights))
        return torch.autograd.grad(value, inputs)

    for samples in (True, False):
        for one, other in zip(gradients(True, samples), gradients(False, samples)):
            # sums over 50 samples in another order
            assert (one - other).abs().max() < 50 * torch.finfo(dtype).eps * other.abs().max()
