"""Shaking: stated sizes and frequencies, gears, mounts, knocks; exact truth whatever shakes."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import welch
from tests.simulation.oracle import apart, strapdown
from tests.simulation.test_chassis import drive, later

from dlkf.base.errors import InputError
from dlkf.simulation.imu import interval_means, inverse_mechanisation
from dlkf.simulation.motion.chassis import ChassisConfig
from dlkf.simulation.motion.routes import Kinematics, VehicleConfig
from dlkf.simulation.motion.shaking import LIMIT, Shaken, Shaking, engine, gain, hum, limit_amplitude, shake_mount

ALL = Shaking(
    engine=1.0, wheel=0.3, hum=0.4, wander=0.03, rumble=0.8, rattle=6.0, mount_hz=14.0, mount_damping=0.08,
    turning=0.02, sway=0.005,
)  # fmt: skip
RATE = 1000


def steady(speed: float):
    def motion(t: np.ndarray) -> Kinematics:
        still = np.zeros_like(t)
        return Kinematics(t, speed + still, still, still, still, still, speed * t)

    return motion


def shake_body(kind: Shaking, speed: float, seconds: float = 60.0, seed: int = 0, right: float = 0.0) -> Shaken:
    t = np.arange(round(seconds * RATE) + 1) / RATE
    rng = np.random.default_rng(seed)
    return shake_mount(
        rng, kind, steady(speed), t, np.ones_like, lambda t: (np.zeros_like(t), right + np.zeros_like(t))
    )


def force(out: Shaken) -> np.ndarray:
    """Specific force along the axes by differences; 5 s for what starts from rest."""
    return np.diff(out.moved_rate, axis=0)[5 * RATE :] * RATE


def peak(x: np.ndarray) -> float:
    f, power = welch(x, RATE, nperseg=8 * RATE)
    return float(f[np.argmax(power)])


@pytest.mark.parametrize("rate", [50, 200])
def test_strapdown_reproduces_a_shaken_minute(rate):
    """As without shaking; knocks and engine tones reach above 100 Hz, and the truth is exact all the same. The oracle's
    position rule leaves f' dt³/12 per sample, and f' is hundreds of times that of a calm car."""
    kind = ChassisConfig(
        roughness=1e-3, roughness_spread=0.7, wheelbase=4.0, sideslip=0.01, imu_arm=(2.0, 0.5, -1.5),
        mounting_deg=(3.0, -4.0, 5.0), shaking=ALL,
    )  # fmt: skip
    truth = later(drive(VehicleConfig(), kind, 100, rate), 40 * rate)
    off = apart(truth, *strapdown(truth, inverse_mechanisation(truth), rate))
    assert off[0] < 5e-3 and off[1] < 1e-6 and off[2] < 1e-9


def test_samples_are_means_over_their_intervals():
    """Against the means of the rates at 1600 Hz. Of a rough road's slow motion a part is enough, and the constant
    equivalents are 8 times further off; what shakes at 60 Hz takes four."""
    rough = ChassisConfig(roughness=5e-4, imu_arm=(2.0, 0.5, -1.5))
    shaking = replace(rough, shaking=replace(ALL, mount_hz=60.0))
    for kind, parts, factor in ((rough, 1, 8), (shaking, 4, 4)):
        fine = inverse_mechanisation(drive(VehicleConfig(), kind, 40, 1600)).reshape(-1, 16, 6).mean(1)
        truth = drive(VehicleConfig(), kind, 40, 100 * parts)
        means = interval_means(truth, parts)
        equivalents = inverse_mechanisation(drive(VehicleConfig(), kind, 40, 100))
        apart = [np.sqrt(np.mean((x - fine) ** 2, axis=0)) for x in (equivalents, means)]
        assert np.all(apart[0][:2] > factor * apart[1][:2]) and np.all(apart[0][3:] > factor * apart[1][3:])


def test_any_sample_rate_sees_the_same_shaking():
    kind = ChassisConfig(shaking=ALL)
    slow, fast = (drive(VehicleConfig(), kind, 40, rate) for rate in (50, 200))
    assert np.abs(fast.v_n[::4] - slow.v_n).max() < 1e-12
    assert np.abs(fast.rpy[::4] - slow.rpy).max() < 1e-12


@pytest.mark.parametrize("source", ["engine", "wheel", "hum", "rumble", "rattle"])
def test_velocity_is_the_derivative_of_displacement(source):
    """Central differences at 1 kHz: their error is a''' dt²/6, below 3 % of the velocity of a 60 Hz tone."""
    kind = replace(Shaking(mount_hz=20.0, wander=0.02), **{source: 1.0})
    out = shake_body(kind, 12.0)
    change = (out.moved[2:] - out.moved[:-2]) * RATE / 2
    assert out.moved_rate.std() > 0
    assert np.abs(change - out.moved_rate[1:-1]).max() < 0.05 * np.abs(out.moved_rate).max()
    assert np.abs(change - out.moved_rate[1:-1]).std() < 0.03 * out.moved_rate.std()


@pytest.mark.parametrize("source", ["engine", "wheel", "hum", "rumble"])
def test_the_stated_size_on_average_over_cars(source):
    """RMS over 40 cars' axes on a rigid mount; each axis has a log-normal share, so 1σ of the mean square is 13 %."""
    kind = replace(Shaking(hum_share=1.0, gears=0, shift_hz=75.0), **{source: 0.5})
    at = 15.0  # m/s, and 50 Hz of an engine between 25 and 75 Hz
    squares = [np.mean(force(shake_body(kind, at, 20.0, seed)) ** 2) for seed in range(40)]
    expected = 0.5 * (0.7 if source == "engine" else 1.0)  # an engine that only holds the speed pulls at 0.7
    assert math.sqrt(np.mean(squares)) == pytest.approx(expected, rel=0.2)


def test_wheels_tell_the_speed_and_fans_do_not():
    for speed in (8.0, 16.0):
        assert peak(force(shake_body(Shaking(wheel=0.5), speed))[:, 0]) == pytest.approx(0.51 * speed, abs=0.2)
        fan = Shaking(hum=0.5, hum_hz=31.0, hum_share=1.0)
        assert peak(force(shake_body(fan, speed))[:, 0]) == pytest.approx(31, abs=0.2)
    fast, slow = (force(shake_body(Shaking(wheel=0.5), speed)).std() for speed in (16.0, 8.0))
    assert fast / slow == pytest.approx(4, rel=0.02)


def test_gears_hold_the_engine_between_idling_and_the_change():
    """From rest to 40 m/s and back: several speeds share a frequency; down-shifts come later than up-shifts."""
    t = np.arange(0, 160, 0.05)
    speed = np.where(t < 80, t / 2, 80 - t / 2)
    still = np.zeros_like(t)
    motion = Kinematics(t, speed, np.gradient(speed, t), still, still, still, still)
    kind = Shaking(engine=1.0, gears=6, first_gear=9.0, gear_step=0.7, shift_hz=80.0, idle_hz=25.0)
    frequency, size = engine(np.random.default_rng(1), kind, motion)
    assert frequency.min() >= 25.0 - 1e-9 and frequency.max() < 80 * 1.1 + 1
    assert frequency[0] == pytest.approx(25.0)
    per_metre = frequency[(speed > 6) & (t < 80)] / speed[(speed > 6) & (t < 80)]
    steps = np.unique(np.round(np.log(per_metre / 9.0) / math.log(0.7)))
    assert set(steps) >= {0.0, 1.0, 2.0, 3.0, 4.0}
    up, down = (np.interp(15.0, speed[half], frequency[half]) for half in (t < 80, slice(None, 1600, -1)))
    assert up != pytest.approx(down, rel=0.1)
    silent, _ = engine(np.random.default_rng(1), replace(kind, gears=0), motion)
    assert np.ptp(silent[(speed > 5) & (t < 79)]) < 0.5  # steady pull, steady frequency at any speed
    stopping = engine(np.random.default_rng(1), replace(kind, idling=0.0), motion)[1]
    assert stopping[0] == 0 and size[0] > 0


def test_fans_run_for_their_share_of_the_time():
    t = np.arange(0, 40_000, 0.05)
    _, size = hum(np.random.default_rng(2), Shaking(hum=2.0, hum_share=0.3), t)
    assert np.mean(size > 1) == pytest.approx(0.3, abs=0.05)  # 330 cycles of 2 min: 1σ is 1.4 %
    assert size.max() == pytest.approx(2.0) and size.min() >= 0


def test_a_soft_mount_amplifies_its_band():
    """Gain of base excitation: 1 at rest, about 1/(2ζ) in resonance, below one above √2 f₀."""
    kind = Shaking(mount_hz=20.0, mount_damping=0.05)
    assert gain(kind, np.array([0.0])) == pytest.approx(1)
    assert gain(kind, np.array([20.0])) == pytest.approx(math.sqrt(1 + 0.01) / 0.1)
    assert gain(kind, np.array([20 * math.sqrt(2)])) == pytest.approx(1)
    soft, rigid = (
        force(shake_body(Shaking(rumble=1.0, mount_hz=f, mount_damping=0.05), 15.0))[:, 0] for f in (20.0, 0.0)
    )
    (f, through), (_, bare) = (welch(x, RATE, nperseg=4000) for x in (soft, rigid))
    ratio = through / bare
    highest = f[np.argmax(np.where((f > 8) & (f < 60), ratio, 0))]
    assert highest == pytest.approx(20, abs=1.5)  # the bilinear warp: 0.6 Hz
    assert ratio[(f > 50) & (f < 70)].mean() < 0.1


def test_loudness_scales_all_and_bursts_make_the_noise_uneven():
    """Linear far from the limit; the mean square of bursts is that without them, within 2 · 10 % of its sampling."""
    kind = Shaking(rumble=1.0, rattle=5.0, wheel=0.5)
    loud, low = (force(shake_body(replace(kind, loudness=x), 15.0)) for x in (1.0, 0.1))
    assert np.abs(0.1 * loud - low).max() < 1e-3 * np.abs(loud).max()
    even, uneven = (force(shake_body(Shaking(rumble=1.0, bursts=x), 15.0, 200.0)) for x in (0.0, 0.7))
    assert np.mean(uneven**2) == pytest.approx(np.mean(even**2), rel=0.2)
    fourth = [np.mean(x[:, 0] ** 4) / np.mean(x[:, 0] ** 2) ** 2 for x in (even, uneven)]
    assert fourth[0] == pytest.approx(3, abs=0.3) and fourth[1] > 4
    uneasy = [np.std(np.log(np.mean(x[:, 0].reshape(-1, RATE // 4) ** 2, -1))) for x in (even, uneven)]
    assert uneasy[1] > 3 * uneasy[0]  # bursts last: quarters of a second differ, and not the samples alone
    assert Shaking(loudness=0.0, rumble=1.0).is_still
    wild = [force(shake_body(replace(Shaking(), **{name: 20.0}), 60.0)) for name in ("wheel", "rumble", "engine")]
    assert all(np.sqrt(np.mean(x**2)) < 2 * LIMIT for x in wild)  # twice: the axes' own shares
    assert limit_amplitude(np.array([0.5, 500.0])) == pytest.approx([0.5, LIMIT], rel=1e-4)


def test_knocks_do_not_depend_on_the_speed():
    kind = Shaking(rattle=10.0, rattle_per_minute=60.0)
    still, fast = (force(shake_body(kind, v, 120.0)) for v in (0.0, 30.0))
    assert np.array_equal(still, fast)
    assert 3 < np.quantile(np.abs(still).max(0), 0.5) < 60
    kurtosis = np.mean(still**4) / np.mean(still**2) ** 2
    assert kurtosis > 10  # impulsive; a normal process has 3


def test_a_swinging_mount_settles_where_the_load_holds_it():
    out = shake_body(Shaking(sway=0.004, sway_hz=2.0, sway_damping=0.3), 10.0, right=3.0)
    assert np.all(out.turned[-1, 0] < 0) and 0.3 * 0.012 <= -out.turned[-1, 0] <= 0.012
    assert np.abs(out.turned[-1] - out.turned[-2000]).max() < 1e-9 and out.turned[-1, 1] == pytest.approx(0)
    assert not out.moved.any()


def test_silence_is_exact_and_impossible_values_are_one_line():
    assert Shaking().is_still and ChassisConfig(shaking=Shaking(mount_hz=10.0)).is_point and not ALL.is_still
    for change in ({"engine": -1.0}, {"mount_hz": 1.0}, {"gears": 2.5}, {"hum_share": 2.0}):
        with pytest.raises(InputError, match=next(iter(change))):
            Shaking(**change)
