"""Φ against finite differences of the nonlinear strapdown, Q against Van Loan, H against its definition."""

from dataclasses import replace

import pytest
import torch
from scipy.linalg import expm

from dlkf.navigation import compiled
from dlkf.navigation.attitude import rotation_from_rpy, skew
from dlkf.navigation.calibration import ImuError
from dlkf.navigation.error_model import PLAIN, antenna, measurement_matrix, window_model
from dlkf.navigation.state import ACCEL, ATTITUDE, GYRO, POSITION, VELOCITY, ErrorStates, NavState
from dlkf.navigation.strapdown import strapdown

from .oracle import frame_at, lively_imu

DT, M = 0.02, 50
PSD = {"accel_noise": 1e-5, "gyro_noise": 3e-8, "accel_walk": 5e-8, "gyro_walk": 5e-10}


def scene(seed: int = 5):
    g = torch.Generator().manual_seed(seed)
    p, v, a = (s * torch.randn(1, 3, generator=g, dtype=torch.float64) for s in (200.0, 15.0, 0.5))
    return NavState(p, v, rotation_from_rpy(a)), lively_imu(1, M, seed), frame_at()


def model_of(frame, states=PLAIN, samples=M, **options):
    return window_model(frame, DT, samples, PSD, states=states, **options)


# Largest difference of Φ from finite differences by block, as wide as what the closed form leaves out on purpose: on
# an Earth at rest the gravity gradient's change over the window (ω_s² T² = 1.5e-6) and sums for integrals in the
# columns of the IMU error, (dt/T)² of them; on ours also its rotation within the window: g ω T² = 7e-4 in velocity
# over attitude and a third of it in position, 2.4e-3 where a rate's error first tilts. Half of the Coriolis term is
# 7e-5 in velocity over velocity and 1.5e-3 in velocity over attitude.
LEFT_OUT = {
    "an Earth at rest": {
        "position": {"position": 2e-8, "velocity": 2e-6, "attitude": 2e-8, "accel": 4e-5, "gyro": 6e-4},
        "velocity": {"position": 3e-8, "velocity": 3e-6, "attitude": 3e-8, "accel": 5e-5, "gyro": 4e-4},
        "attitude": {"position": 1e-12, "velocity": 1e-12, "attitude": 1e-11, "accel": 1e-12, "gyro": 5e-5},
    },
    "the Earth": {
        "position": {"position": 2e-8, "velocity": 2e-6, "attitude": 4e-4, "accel": 4e-5, "gyro": 1e-3},
        "velocity": {"position": 3e-8, "velocity": 3e-6, "attitude": 1e-3, "accel": 1e-4, "gyro": 2.4e-3},
        "attitude": {"position": 1e-12, "velocity": 1e-12, "attitude": 1e-11, "accel": 1e-12, "gyro": 8e-5},
    },
}
BLOCKS = {"position": POSITION, "velocity": VELOCITY, "attitude": ATTITUDE, "accel": ACCEL, "gyro": GYRO}


@pytest.mark.parametrize("earth", LEFT_OUT)
@pytest.mark.parametrize("matrix", ["none", "scale", "full"])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_transition_matches_finite_differences(seed, matrix, earth):
    """Column by column: truth = estimate ⊞ dx, true IMU error = estimated ⊞ dx, central differences."""
    state, raw, frame = scene(seed)
    if earth == "an Earth at rest":
        frame = replace(frame, earth_rate_n=torch.zeros_like(frame.earth_rate_n))
    states = ErrorStates(matrix)
    n = states.count
    error = ImuError(torch.full((1, 6), 0.01, dtype=torch.float64))
    corrected = error.correct(raw)
    window = strapdown(state, corrected, DT, frame)
    Phi = model_of(frame, states).transition(state, window, corrected, frame)[0]
    steps = torch.full((n,), 1e-4, dtype=torch.float64)
    steps[:12] = torch.tensor([1.0, 0.1, 1e-4, 1e-3]).repeat_interleave(3)
    numeric = torch.eye(n, dtype=torch.float64)
    for i in range(n):
        ends = []
        for sign in (1, -1):
            dx = torch.zeros(1, n, dtype=torch.float64)
            dx[0, i] = sign * steps[i]
            true_imu = error.update(dx, states).correct(raw)
            ends.append(window.end.error_to(strapdown(state.correct(dx[:, :9]), true_imu, DT, frame).end)[0])
        numeric[:9, i] = (ends[0] - ends[1]) / (2 * steps[i])
    off = (Phi - numeric).abs()
    for row, tolerances in LEFT_OUT[earth].items():
        for column, tolerance in tolerances.items():
            assert off[BLOCKS[row], BLOCKS[column]].max() < tolerance, f"{row} over {column}"
        if states.elements:  # as the biases, times a sample of up to 15 m/s² or 2 rad/s
            elements = off[BLOCKS[row], GYRO.stop : states.navigation]
            assert elements.max() < max(10 * tolerances["accel"], tolerances["gyro"]), f"{row} over the matrices"


def test_gravity_gradient_reaches_velocity_and_position():
    """3e-6 m/s² per metre up or down, as the strapdown has it 100 m above and below; 0.5 % is the shape."""
    state, raw, frame = scene()
    up = torch.tensor([0.0, 0.0, 100.0], dtype=torch.float64)
    Phi = model_of(frame).transition(state, strapdown(state, raw, DT, frame), raw, frame)[0]
    above, below = (strapdown(state._replace(p_n=state.p_n + x), raw, DT, frame).end for x in (-up, up))
    gained, moved = ((b - a)[0, 2] / 200 for a, b in ((above.v_n, below.v_n), (above.p_n, below.p_n)))
    assert float(gained) == pytest.approx(3.08e-6 * M * DT, rel=0.01)  # 2 g / r
    assert float(Phi[VELOCITY, POSITION][2, 2]) == pytest.approx(float(gained), rel=0.01)
    assert float(Phi[POSITION, POSITION][2, 2] - 1) == pytest.approx(float(moved - 1), rel=0.01)


def continuous(C: torch.Tensor, force_n: torch.Tensor) -> torch.Tensor:
    """Jacobian F of the error model with Earth rotation left out (paper.md 2.1)."""
    F = torch.zeros(15, 15, dtype=torch.float64)
    F[POSITION, VELOCITY] = torch.eye(3, dtype=torch.float64)
    F[VELOCITY, ATTITUDE] = -skew(force_n)
    F[VELOCITY, ACCEL] = F[ATTITUDE, GYRO] = -C
    return F


def test_noise_matches_van_loan():
    """Attitude and force held constant, the case in which the closed form is exact (Van Loan 1978)."""
    frame = frame_at()
    C = rotation_from_rpy(torch.tensor([[0.1, -0.2, 0.7]], dtype=torch.float64))
    f_b = torch.tensor([1.5, -2.0, -9.5], dtype=torch.float64)
    zero = torch.zeros(1, 3, dtype=torch.float64)
    imu = torch.cat((f_b, torch.zeros(3, dtype=torch.float64))).expand(1, M, 6)
    state = NavState(zero, zero, C)
    model = model_of(frame)
    Q = model.noise(model.transition(state, strapdown(state, imu, DT, frame), imu, frame))[0]
    G = torch.zeros(15, 15, dtype=torch.float64)
    sources = zip((VELOCITY, ATTITUDE, ACCEL, GYRO), PSD, strict=True)
    for block, name in sources:
        G[block, block] = PSD[name] * torch.eye(3, dtype=torch.float64)
    F = continuous(C[0], C[0] @ f_b)
    big = torch.zeros(30, 30, dtype=torch.float64)
    big[:15, :15], big[:15, 15:], big[15:, 15:] = -F, G, F.T
    exponential = torch.from_numpy(expm(big.numpy()))
    expected = exponential[15:, 15:].T @ exponential[:15, 15:]
    size = torch.sqrt(expected.diagonal()[:, None] * expected.diagonal()[None, :])
    assert ((Q - expected) / size).abs().max() < 2e-3  # Earth rotation, and sums for integrals: 1 / (2 M)²


def test_noise_of_rough_motion_matches_sample_by_sample():
    """Brute force P ← Φₖ P Φₖᵀ + Qₖ over 50 samples; the window formula assumes a constant force."""
    state, imu, frame = scene(4)
    window = strapdown(state, imu, DT, frame)
    model, short = model_of(frame), model_of(frame, samples=1)
    Q = model.noise(model.transition(state, window, imu, frame))[0]
    total = torch.zeros(15, 15, dtype=torch.float64)
    at = state
    for k in range(M):
        one = strapdown(at, imu[:, k : k + 1], DT, frame)
        step = short.transition(at, one, imu[:, k : k + 1], frame)
        total = step[0] @ total @ step[0].T + short.noise(step)[0]
        at = one.end
    std, expected = Q.diagonal().sqrt(), total.diagonal().sqrt()
    assert ((std / expected) - 1).abs().max() < 0.03
    assert torch.linalg.eigvalsh(Q / (std[:, None] * std)).min() > -1e-12


def test_measurement_matrix_matches_finite_differences():
    state, _, frame = scene(6)
    arm = torch.tensor([[1.2, -0.4, -1.5]], dtype=torch.float64)
    rate = torch.tensor([[0.05, -0.02, 0.4]], dtype=torch.float64)
    H = measurement_matrix(state, rate, arm, frame)
    step = 1e-5
    for i in range(15):
        dx = torch.zeros(1, 15, dtype=torch.float64)
        dx[0, i] = step
        ahead = antenna(state.correct(dx[:, :9]), rate - dx[:, 12:], arm, frame)
        behind = antenna(state.correct(-dx[:, :9]), rate + dx[:, 12:], arm, frame)
        numeric = (ahead - behind)[0] / (2 * step)
        # the rate's own error enters with +Ĉ[l×]: truth − estimate of (ω − ζ)×l is l×ζ
        assert (numeric - H[0, :, i]).abs().max() < 1e-6, i


def test_zero_lever_arm_is_the_paper_s_h():
    state, _, frame = scene(7)
    zero = torch.zeros(1, 3, dtype=torch.float64)
    predicted, H = (f(state, zero + 0.3, zero, frame) for f in (antenna, measurement_matrix))
    assert torch.equal(H[0, :, :6], torch.eye(6, dtype=torch.float64)) and not H[0, :, 6:].any()
    assert torch.equal(predicted, torch.cat((state.p_n, state.v_n), -1))


@pytest.mark.parametrize("matrix", ["none", "scale", "full"])
def test_compiled_transition_is_the_tensor_form_s(matrix):
    state, imu, frame = scene(8)
    model = model_of(frame, ErrorStates(matrix))
    window = strapdown(state, imu, DT, frame)
    with compiled.tensor_forms():
        expected = model.transition(state, window, imu, frame)
    with torch.no_grad():
        assert compiled.fits(imu)
        assert torch.allclose(model.transition(state, window, imu, frame), expected, rtol=1e-12, atol=1e-12)


def test_compiled_process_noise_is_the_tensor_form_s():
    """Summed in another order: equal to rounding of the largest element of each row and column."""
    state, imu, frame = scene(8)
    model = model_of(frame, ErrorStates("full"))
    Phi = model.transition(state, strapdown(state, imu, DT, frame), imu, frame)
    expected = model.noise(Phi)
    with torch.no_grad():
        assert compiled.fits(Phi)
        got = model.noise(Phi)
    size = expected.diagonal(dim1=-2, dim2=-1).sqrt()
    assert torch.equal(got, got.mT)
    assert ((got - expected).abs() <= 1e-14 * size[:, :, None] * size[:, None]).all()


def test_gradient_of_the_process_noise_in_its_scale_is_the_numerical_one():
    """In closed form, where nothing is learned through Φ."""
    state, imu, frame = scene(9)
    model = model_of(frame, ErrorStates("full"))
    Phi = model.transition(state, strapdown(state, imu, DT, frame), imu, frame)
    scale = 1 + torch.randn(1, 4, 3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    size = model.noise(Phi).abs().amax((1, 2), keepdim=True)
    assert torch.autograd.gradcheck(lambda W: model.noise(Phi, W) / size, scale.requires_grad_())
