"""Samples of constant rate and force that act like the motion: closed forms of coning and sculling, composition."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dlkf.data.increments import merge_increments, two_sample
from dlkf.data.resampling import SampleGrid, resample_imu
from dlkf.data.schema import ACCEL, GYRO

SECONDS = 20


def _file(rate: float, integral) -> dict[str, np.ndarray]:
    """IMU table of means over 1/rate of what ``integral`` (t) -> (n, 6) is the integral of."""
    at = np.arange(SECONDS * rate + 1) / rate
    return {"t": at[1:], **dict(zip((*ACCEL, *GYRO), (np.diff(integral(at), axis=0) * rate).T))}


def _moved(samples: np.ndarray, rate: float) -> tuple[Rotation, np.ndarray]:
    """Attitude and velocity after constant samples (n, 6): C ← C exp(φ×), v ← v + C ∫exp(sφ×) ds u."""
    turns = Rotation.from_rotvec(samples[:, 3:] / rate)
    C, v = Rotation.identity(), np.zeros(3)
    for turn, phi, u in zip(turns, samples[:, 3:] / rate, samples[:, :3] / rate):
        once = np.cross(phi, u)
        v = v + C.apply(u + once / 2 + np.cross(phi, once) / 6)
        C = C * turn
    return C, v


def _plain(imu: dict, rate: int, native: int) -> np.ndarray:
    values = np.stack([imu[c] for c in (*ACCEL, *GYRO)], -1)
    return values.reshape(SECONDS * rate, native // rate, 6).mean(1)


def _loaded(imu: dict, rate: int) -> np.ndarray:
    return resample_imu(imu, SampleGrid(0.0, 1.0, SECONDS, rate)).reshape(-1, 6)


def _residuals(wh: float) -> tuple[float, float]:
    """What plain integrals and the two-sample correction miss of an interval with phase wh, per product of
    amplitudes: ½ (x − sin x), and that less 1/12 of the cross product of two neighbours' chords."""
    plain = 0.5 * (wh - np.sin(wh))
    return plain, plain - np.sin(wh / 2) ** 2 * np.sin(wh) / 3


@pytest.mark.whole
@pytest.mark.parametrize("rate, hz", [(10, 1.0), (50, 5.0), (100, 7.0)])
def test_coning_drift_has_its_closed_form(rate, hz):
    """q = (cos a/2, sin a/2 cos wt, sin a/2 sin wt, 0) does not drift; samples do about z (Savage 1998)."""
    a, w = np.radians(1.0), 2 * np.pi * hz

    def integral(t):
        turn = np.stack((np.sin(a) * np.cos(w * t), np.sin(a) * np.sin(w * t), -w * (1 - np.cos(a)) * t), -1)
        return np.concatenate((0 * turn, turn), -1)

    imu = _file(rate, integral)
    missed = [rate * np.sin(a) ** 2 * r for r in _residuals(w / rate)]
    for samples, drift in zip((_plain(imu, rate, rate), _loaded(imu, rate)), missed):
        z = _moved(samples, rate)[0].as_rotvec()[2] / SECONDS
        # closed form to second order in a: a²/12 of the drift are left; the first sample has no neighbour
        assert z == pytest.approx(-drift, rel=2e-3, abs=2 * missed[0] / (rate * SECONDS))
    assert missed[1] < 0.35 * missed[0]


@pytest.mark.parametrize("rate, hz", [(10, 1.0), (50, 5.0), (100, 7.0)])
def test_sculling_drift_has_its_closed_form(rate, hz):
    """Rolling by b sin wt under a push B sin wt to the right gains velocity downwards at B b/2 (Savage 1998)."""
    b, push, w = np.radians(0.5), 2.0, 2 * np.pi * hz

    def integral(t):
        out = np.zeros((len(t), 6))
        out[:, 1], out[:, 3] = -push / w * np.cos(w * t), b * np.sin(w * t)
        return out

    imu = _file(rate, integral)
    gained = push * b / 2  # B J₁(b), to b²/8 of it
    missed = [rate * b * push / w * r for r in _residuals(w / rate)]
    for samples, drift in zip((_plain(imu, rate, rate), _loaded(imu, rate)), missed):
        z = _moved(samples, rate)[1][2] / SECONDS
        assert z - gained == pytest.approx(-drift, rel=2e-3, abs=2 * missed[0] / (rate * SECONDS))


@pytest.mark.parametrize("native", [100, 200])
def test_a_lower_rate_drifts_no_more_than_the_native_one(native):
    """Coning and sculling at once, to 50 Hz and to the file's own rate: the same drift; plain averages far more."""
    w = 2 * np.pi * 9.0

    def integral(t):
        c, s = np.cos(w * t), np.sin(w * t)
        return np.stack((0.02 * s, 0.03 * c, -9.8 * t, 0.01 * c, 0.01 * s, 0.2 * t), -1)

    imu = _file(native, integral)
    ends = [_moved(_loaded(imu, rate), rate) for rate in (native, 50)]
    averaged = _moved(_plain(imu, 50, native), 50)
    turned, gained = (ends[0][0].inv() * ends[1][0]).magnitude(), np.linalg.norm(ends[0][1] - ends[1][1])
    assert turned < 0.01 * (ends[0][0].inv() * averaged[0]).magnitude()
    assert gained < 0.1 * np.linalg.norm(ends[0][1] - averaged[1])  # third order: |φ|²/12 of gravity per sample


def test_merging_is_exact_to_second_order():
    """Halving the turns and pushes leaves an eighth of the error; of plain sums a quarter."""
    rng = np.random.default_rng(0)
    segments = np.concatenate((rng.standard_normal((3, 40)), 0.1 * rng.standard_normal((3, 40))))
    first = np.array([0, 4, 5, 12, 20, 33])
    last = np.append(first[1:], 40)
    errors = []
    for scale in (1.0, 0.5):
        part = scale * segments
        whole, sums = merge_increments(part, first), np.add.reduceat(part, first, axis=1)
        for one in (whole, sums):
            worst = np.zeros(2)
            for j, (i, k) in enumerate(zip(first, last)):
                exact, ours = _moved(part[:, i:k].T, 1), _moved(one[:, j : j + 1].T, 1)
                error = (exact[0].inv() * ours[0]).magnitude(), np.abs(exact[1] - ours[1]).max()
                worst = np.maximum(worst, error)
            errors.append(worst)
    ours, plain, ours_halved, plain_halved = errors
    np.testing.assert_allclose(ours_halved / ours, 1 / 8, rtol=0.15)
    np.testing.assert_allclose(plain_halved / plain, 1 / 4, rtol=0.15)
    single = merge_increments(segments, np.arange(40))
    np.testing.assert_allclose(single, segments, rtol=0, atol=1e-14)


def test_uneven_steps_and_gaps():
    """A rate linear in time is exact at any steps; where the sample before is missing nothing is assumed."""
    at = np.cumsum(np.array([0.0, 1.0, 1.3, 0.6, 1.0, 2.0, 1.0])) * 0.01
    slope, rate = np.array([0.0, 30.0, 0.0]), np.array([2.0, 0.0, 0.0])  # ω = (2, 30 t, 0): coning along z
    alpha = np.diff(rate[:, None] * at + slope[:, None] * at**2 / 2, axis=1)
    step = np.diff(at)
    follows = np.array([False, True, True, False, True, True])
    out = two_sample(np.concatenate((0 * alpha, alpha)), step, follows)[3:]
    exact = 2.0 * 30.0 * step**3 / 12  # ½∫α×ω dt of ω = w + m (s − h/2) is w × m h³/12
    np.testing.assert_allclose((out - alpha)[2], np.where(follows, exact, 0), rtol=1e-9, atol=1e-18)
    np.testing.assert_array_equal((out - alpha)[:2], 0)


def test_noise_is_not_amplified():
    """White noise of a consumer IMU at 100 Hz under a brisk turn: the same spread and the same random walk."""
    rng = np.random.default_rng(3)
    n, rate = 200_000, 100
    mean = np.array([1.0, 3.0, -9.8, 0.1, -0.1, 0.5])
    noise = np.concatenate((0.025 * rng.standard_normal((n, 3)), 9e-4 * rng.standard_normal((n, 3))), -1)
    imu = {"t": np.arange(1, n + 1) / rate, **dict(zip((*ACCEL, *GYRO), (mean + noise).T))}
    ours = resample_imu(imu, SampleGrid(0.0, 1.0, n // rate, 50)).reshape(-1, 6)
    averages = (mean + noise).reshape(-1, 2, 6).mean(1)
    np.testing.assert_allclose(ours.std(0) / averages.std(0), 1, atol=1e-3)
    # over a second it adds half a hundredth of the random walk at most, in quadrature
    added = (ours - averages).reshape(-1, 50, 6).mean(1).std(0)
    assert (added < 5e-3 * averages.reshape(-1, 50, 6).mean(1).std(0)).all()
