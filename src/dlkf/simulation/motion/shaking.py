"""Vibration of an IMU in a car that does not follow the speed: engine and gears, fans, road noise through a soft mount,
rattling; and wheels, which do.

Every source is a displacement of the IMU along the three axes of the car [m] and a rotation of it on its mount [rad],
in closed form or as a spline, with its exact rate: tones are A(t) sin φ(t) with the phase φ = 2π ∫f dt integrated
exactly, noise is white noise through second-order filters at ``NODE_HZ`` with a quintic spline in between. So truth
stays exact at any sample rate.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from dlkf.base.errors import InputError
from dlkf.base.settings import Ranged, bounded_field
from dlkf.simulation.motion.routes import Kinematics

Array = NDArray[np.floating]
TONE_HZ, NODE_HZ = 20, 200  # nodes of amplitudes and frequencies, and of noise
AT_SPEED, AT_HZ = 15.0, 50.0  # m/s at which wheels and road, Hz at which an engine has its stated size
ROAD_HZ, ROAD_DAMPING = 6.0, 0.7  # the body's own springs keep road noise above this from the car
SHIFT_S = 0.4  # s that the revolutions take to follow a change of gear
ENGINE_ORDERS = ((1.0, 0.6), (0.5, 0.25), (2.0, 0.15))  # of the firing frequency, share of the power
WHEEL_ORDERS = ((1.0, 0.7), (2.0, 0.3))
SOURCES = ("engine", "wheel", "hum", "rumble", "rattle")
BURST_S = 0.1  # s
RATTLE_DAMPING = 0.08
LIMIT = 5.0  # m/s², RMS per axis of a source that nothing exceeds: a mount has stops, and a driver has ears
NOISE_TURN_HZ = 15.0  # frequency at which noise turns the mount by ``turning``


@dataclass(frozen=True)
class Shaking(Ranged, where="shaking"):
    """Sizes are RMS per axis on average [m/s²] before the mount amplifies them, to ``LIMIT`` at most; 0 switches off.

    ``loudness``: share of all sizes but ``sway`` that a car lets through, 0 for none.
    ``engine``: at a firing frequency of 50 Hz, growing in proportion to it; ``idle_hz`` is the firing frequency at
    standstill, ``idling`` the size there against what it would be in motion (0 for an engine that stops).
    First gear fires ``first_gear`` times a metre, each of the ``gears`` ``gear_step`` times as often as the one below;
    it changes up at ``shift_hz``, to which ``gears`` 0 holds it at any speed, as a variable transmission does.
    ``wheel``: at 15 m/s, with the square of the speed, ``wheel_turns`` per metre. ``hum``: fans and compressors at
    ``hum_hz``, on for ``hum_share`` of the time. ``wander``: relative, slow, of the frequencies of engine and hum.
    ``rumble``: road noise above 6 Hz, at 15 m/s, in proportion to speed and the road's roughness; it comes in bursts,
    of log-std ``bursts``, of ``BURST_S``.
    ``rattle``: peak of a knock [m/s²], ``rattle_per_minute`` of them at any speed, each ringing at ``rattle_hz``.

    The mount is a resonance at ``mount_hz`` with ``mount_damping`` for all of it (0 Hz: rigid); with the shaking it
    turns by ``turning`` [rad/s per m/s²]. ``sway`` [rad per m/s²]: how far it swings out under the car's acceleration,
    at ``sway_hz`` with ``sway_damping``.
    """

    loudness: float = bounded_field(1.0, 0, 1)
    engine: float = bounded_field(0.0, 0, 20)
    idle_hz: float = bounded_field(25.0, 5, 60)
    idling: float = bounded_field(1.0, 0, 5)
    gears: int = bounded_field(6, 0, 12)
    first_gear: float = bounded_field(9.0, 0.5, 40)
    gear_step: float = bounded_field(0.7, 0.4, 0.95)
    shift_hz: float = bounded_field(80.0, 30, 300)
    wheel: float = bounded_field(0.0, 0, 20)
    wheel_turns: float = bounded_field(0.51, 0.2, 1)
    hum: float = bounded_field(0.0, 0, 20)
    hum_hz: float = bounded_field(24.0, 5, 400)
    hum_share: float = bounded_field(0.5, 0, 1)
    wander: float = bounded_field(0.0, 0, 0.2)
    rumble: float = bounded_field(0.0, 0, 20)
    bursts: float = bounded_field(0.0, 0, 1.5)
    rattle: float = bounded_field(0.0, 0, 100)
    rattle_per_minute: float = bounded_field(30.0, 0, 600)
    rattle_hz: float = bounded_field(30.0, 5, 80)
    mount_hz: float = bounded_field(0.0, 0, 80)
    mount_damping: float = bounded_field(0.1, 0.02, 2)
    turning: float = bounded_field(0.01, 0, 1)
    sway: float = bounded_field(0.0, 0, 0.1)
    sway_hz: float = bounded_field(3.0, 0.5, 20)
    sway_damping: float = bounded_field(0.2, 0.02, 2)

    def __post_init__(self) -> None:
        super().__post_init__()
        if 0 < self.mount_hz < 3:
            raise InputError(f"shaking: mount_hz {self.mount_hz} is outside 3 to 80 (0 is rigid)")
        if self.gears != round(self.gears):
            raise InputError(f"shaking: gears {self.gears} must be a whole number")

    @property
    def is_still(self) -> bool:
        """Whether nothing shakes."""
        return not any((*(self.loudness * getattr(self, name) for name in SOURCES), self.sway))


@dataclass(frozen=True)
class Shaken:
    """Displacement along the car's axes [m] and its rate, and the rotation of the mount [rad], (N, 3) each."""

    moved: Array
    moved_rate: Array
    turned: Array


def shake_mount(
    rng: np.random.Generator,
    kind: Shaking,
    motion_at: Callable[[Array], Kinematics],
    t: Array,
    roughness: Callable[[Array], Array],
    load: Callable[[Array], tuple[Array, Array]],
) -> Shaken:
    """All sources at the times ``t``, which start at 0.

    ``motion_at``: the car's motion at any times; ``roughness``: of the road relative to its mean (amplitude) there;
    ``load``: specific force forward and to the right [m/s²] there.
    """
    kind = replace(kind, **{name: kind.loudness * getattr(kind, name) for name in SOURCES})
    engine_rng, wheel_rng, hum_rng, noise_rng, sway_rng = rng.spawn(5)
    end = float(t[-1])
    coarse = motion_at(np.arange(math.ceil(end * TONE_HZ) + 2) / TONE_HZ)
    out = Shaken(*(np.zeros((len(t), 3)) for _ in range(3)))
    if kind.engine > 0:
        frequency, size = engine(engine_rng, kind, coarse)
        _add_tones(engine_rng, kind, out, t, coarse.t, frequency, size, ENGINE_ORDERS)
    if kind.hum > 0:
        frequency, size = hum(hum_rng, kind, coarse.t)
        _add_tones(hum_rng, kind, out, t, coarse.t, frequency, size, ((1.0, 1.0),))
    if kind.wheel > 0:
        _add_wheels(wheel_rng, kind, out, motion_at(t), coarse)
    if kind.rumble > 0 or kind.rattle > 0:
        nodes = np.arange(math.ceil(end * NODE_HZ) + 1) / NODE_HZ
        rolling = np.abs(coarse.speed) / AT_SPEED * roughness(coarse.t)
        envelope = limit_amplitude(kind.rumble * np.interp(nodes, coarse.t, rolling))
        x = noise(noise_rng, kind, envelope)
        spline = scipy.interpolate.make_interp_spline(nodes, x, k=5)
        at = spline(t)
        out.moved[:] += at[:, :3]
        out.moved_rate[:] += spline(t, nu=1)[:, :3]
        out.turned[:] += kind.turning * 2 * math.pi * NOISE_TURN_HZ * at[:, 3:]
    if kind.sway > 0:
        out.turned[:] += sway(sway_rng, kind, end, load)(t)
    return out


def engine(rng: np.random.Generator, kind: Shaking, motion: Kinematics) -> tuple[Array, Array]:
    """Firing frequency [Hz] and size of the vibration [m/s²] at the nodes of the coarse motion.

    Gears change up at ``shift_hz`` and down at 0.7 of where the change up landed; every change is at a frequency of
    its own, ±10 %. The revolutions follow with a lag of ``SHIFT_S``, and never fall below idling.
    """
    speed = np.abs(motion.speed)
    if kind.gears == 0:
        target = np.where(speed > 1.0, 0.5 * (kind.idle_hz + kind.shift_hz), kind.idle_hz)
        target = target + 0.2 * kind.shift_hz * np.clip(motion.acceleration, 0, 2)
    else:
        ratios = kind.first_gear * kind.gear_step ** np.arange(kind.gears)
        target = ratios[_gear(rng, kind, ratios, speed)] * speed
    frequency = _smooth(np.maximum(target, kind.idle_hz), SHIFT_S * TONE_HZ)
    frequency = frequency * (1 + kind.wander * _slow(rng, len(speed), 8.0))
    pulling = 0.7 + 0.3 * np.clip(motion.acceleration, -1, 2) + 0.2 * _slow(rng, len(speed), 3.0)
    rolling = np.clip(speed / 1.5, 0, 1)
    load = rolling * np.clip(pulling, 0.2, None) + (1 - rolling) * kind.idling
    return frequency, kind.engine * _smooth(load, SHIFT_S * TONE_HZ) * frequency / AT_HZ


def _gear(rng: np.random.Generator, kind: Shaking, ratios: Array, speed: Array) -> NDArray[np.int64]:
    gear, gears = 0, np.zeros(len(speed), dtype=np.int64)
    taste = 1.0
    for k, v in enumerate(speed.tolist()):
        f = ratios[gear] * v
        if f > kind.shift_hz * taste and gear < len(ratios) - 1:
            gear, taste = gear + 1, 1 + rng.uniform(-0.1, 0.1)
        elif gear > 0 and f < 0.7 * kind.gear_step * kind.shift_hz * taste:
            gear, taste = gear - 1, 1 + rng.uniform(-0.1, 0.1)
        gears[k] = gear
    return gears


def hum(rng: np.random.Generator, kind: Shaking, t: Array) -> tuple[Array, Array]:
    """Frequency [Hz] and size [m/s²] of what runs at a frequency of its own, on and off for a minute on average."""
    starts_on, means = bool(rng.random() < kind.hum_share), 120.0 * np.array((kind.hum_share, 1 - kind.hum_share))
    spans = rng.exponential(means if starts_on else means[::-1], (4 + int(t[-1] / 20), 2)).ravel()
    off = np.searchsorted(np.cumsum(spans), t, side="right") % 2 == int(starts_on)
    runs = ~off if 0 < kind.hum_share < 1 else np.full(len(t), kind.hum_share == 1)
    frequency = kind.hum_hz * (1 + kind.wander * _slow(rng, len(t), 20.0))
    return frequency, kind.hum * _smooth(runs.astype(float), 0.5 * TONE_HZ)


def _add_tones(
    rng: np.random.Generator,
    kind: Shaking,
    out: Shaken,
    t: Array,
    nodes: Array,
    frequency: Array,
    size: Array,
    orders: tuple[tuple[float, float], ...],
) -> None:
    """Tones at multiples of a frequency [Hz] with a size [m/s²] that both change slowly, given at nodes."""
    turns = scipy.interpolate.make_interp_spline(nodes, frequency, k=3)
    cycles, rate = turns.antiderivative()(t), turns(t)
    for order, share in orders:
        w = 2 * math.pi * order * frequency
        spline = scipy.interpolate.make_interp_spline(
            nodes, limit_amplitude(size * gain(kind, order * frequency)) / w**2, k=3
        )
        _add_tone(
            rng, kind, out, math.sqrt(2 * share), 2 * math.pi * order * cycles, 2 * math.pi * order * rate,
            spline(t), spline(t, nu=1),
        )  # fmt: skip


def _add_wheels(rng: np.random.Generator, kind: Shaking, out: Shaken, motion: Kinematics, coarse: Kinematics) -> None:
    """An unbalanced mass: its displacement is the same at any speed, but for what the mount does to it."""
    per_metre = 2 * math.pi * kind.wheel_turns
    for order, share in WHEEL_ORDERS:
        size = kind.wheel / (order * per_metre * AT_SPEED) ** 2
        f = order * kind.wheel_turns * np.abs(coarse.speed)
        quick = (2 * math.pi * np.maximum(f, 0.1)) ** 2
        strength = limit_amplitude(size * gain(kind, f) * quick) / quick
        spline = scipy.interpolate.make_interp_spline(coarse.t, _smooth(strength, 4.0), k=3)
        _add_tone(
            rng, kind, out, math.sqrt(2 * share), order * per_metre * motion.distance, order * per_metre * motion.speed,
            spline(motion.t), spline(motion.t, nu=1),
        )  # fmt: skip


def _add_tone(
    rng: np.random.Generator, kind: Shaking, out: Shaken, factor: float, phase: Array, w: Array, A: Array, A_rate: Array
) -> None:
    """factor · A sin(φ + φ₀) along each axis with a size and phase φ₀ of its own, and the turns that go with it:
    rates of ``turning`` times the specific force A φ'², so angles of ``turning`` A φ'."""
    axes = factor * np.exp(0.5 * rng.standard_normal(6) - 0.25)  # E of its square is one
    start = rng.uniform(0, 2 * math.pi, 6)
    sine, cosine = np.sin(phase), np.cos(phase)
    speed = A * w
    for k in range(3):
        s, c = math.sin(start[k]), math.cos(start[k])
        wave, quadrature = sine * c + cosine * s, cosine * c - sine * s
        out.moved[:, k] += axes[k] * A * wave
        out.moved_rate[:, k] += axes[k] * (A_rate * wave + speed * quadrature)
        if kind.turning > 0:
            s, c = math.sin(start[3 + k]), math.cos(start[3 + k])
            out.turned[:, k] += axes[3 + k] * kind.turning * speed * (sine * c + cosine * s)


def noise(rng: np.random.Generator, kind: Shaking, envelope: Array) -> Array:
    """Displacements (N, 6) at the nodes by road noise of the size ``envelope`` (N,) [m/s²] and by knocks; the last
    three columns, of the same size, are those that turn the mount. Each has a log-normal share of the noise."""
    count = len(envelope)
    axes = np.exp(0.5 * rng.standard_normal(6) - 0.25)
    if kind.bursts > 0:
        keep = math.exp(-1 / (BURST_S * NODE_HZ))
        level = scipy.signal.lfilter([math.sqrt(1 - keep**2)], [1.0, -keep], rng.standard_normal(count))
        envelope = envelope * np.exp(kind.bursts * level - kind.bursts**2)
    white = envelope[:, None] * axes * rng.standard_normal((count, 6)) if kind.rumble > 0 else np.zeros((count, 6))
    w = 2 * math.pi * ROAD_HZ
    b, a = scipy.signal.bilinear([1.0], [1.0, 2 * ROAD_DAMPING * w, w * w], NODE_HZ)
    x = _filter_by_mount(kind, np.asarray(scipy.signal.lfilter(b, a, white, axis=0)) / _acceleration_rms(b, a))
    if kind.rattle > 0 and kind.rattle_per_minute > 0:
        knocks = rng.random(count) < kind.rattle_per_minute / 60 / NODE_HZ
        w = 2 * math.pi * kind.rattle_hz
        height = kind.rattle / w**2 * np.exp(0.6 * rng.standard_normal((count, 6))) * rng.choice((-1, 1), (count, 6))
        ringing = resonance(kind.rattle_hz, RATTLE_DAMPING, NODE_HZ)
        hit = np.asarray(scipy.signal.lfilter(*ringing, knocks[:, None] * height, axis=0))
        x += _filter_by_mount(kind, hit * NODE_HZ / w)
    return x


def _acceleration_rms(b: Array, a: Array) -> float:
    """RMS of the second derivative of filtered white noise of size one at the nodes."""
    f, H = scipy.signal.freqz(b, a, worN=2048, fs=NODE_HZ)
    return float(np.sqrt(np.mean(np.abs((2 * math.pi * f) ** 2 * H) ** 2)))


def _filter_by_mount(kind: Shaking, x: Array) -> Array:
    if kind.mount_hz == 0:
        return x
    mount = resonance(kind.mount_hz, kind.mount_damping, NODE_HZ, at_base=True)
    return np.asarray(scipy.signal.lfilter(*mount, x, axis=0))


def resonance(hz: float, damping: float, node_hz: float, *, at_base: bool = False) -> tuple[Array, Array]:
    """The filter (b, a) at nodes of a mass on a spring that a force moves, ω²/(s² + 2ζωs + ω²), or its base,
    (2ζωs + ω²)/(s² + 2ζωs + ω²)."""
    w, z = 2 * math.pi * hz, damping
    return scipy.signal.bilinear([2 * z * w, w * w] if at_base else [w * w], [1.0, 2 * z * w, w * w], node_hz)


def gain(kind: Shaking, f: Array) -> Array:
    """By how much the mount amplifies a tone, |(1 + 2ζri)/(1 − r² + 2ζri)|, r = f/f_mount (base excitation)."""
    if kind.mount_hz == 0:
        return np.ones_like(f)
    r, z = f / kind.mount_hz, kind.mount_damping
    return np.sqrt((1 + (2 * z * r) ** 2) / ((1 - r**2) ** 2 + (2 * z * r) ** 2))


def sway(
    rng: np.random.Generator, kind: Shaking, end: float, load: Callable[[Array], tuple[Array, Array]]
) -> scipy.interpolate.BSpline:
    """Roll, pitch, yaw [rad] by which the mount swings out: ω²/(s² + 2ζωs + ω²) of what the load asks for.

    How it hangs is drawn: the share of each angle.
    """
    nodes = np.arange(math.ceil(end * NODE_HZ / 2) + 1) * 2 / NODE_HZ
    forward, right = load(nodes)
    share = rng.uniform(0.3, 1.0, 3) * (1, 1, 0.5)
    asked = kind.sway * share * np.stack((-right, forward, right), -1)
    swinging = resonance(kind.sway_hz, kind.sway_damping, NODE_HZ / 2)
    return scipy.interpolate.make_interp_spline(nodes, scipy.signal.lfilter(*swinging, asked, axis=0), k=5)


def limit_amplitude(size: Array) -> Array:
    """A size x [m/s²] that saturates at ``LIMIT``, x/(1 + (x/LIMIT)⁴)^¼: within 2 % of it up to half of that."""
    return size / (1 + (size / LIMIT) ** 4) ** 0.25


def _smooth(x: Array, nodes: float) -> Array:
    """Twice through a first-order lag of so many nodes, from the steady state of x₀: no corners, no overshoot."""
    keep = math.exp(-2 / max(nodes, 1e-9))
    for _ in range(2):
        x = scipy.signal.lfilter([1 - keep], [1, -keep], x, zi=keep * x[:1])[0]
    return x


def _slow(rng: np.random.Generator, count: int, seconds: float) -> Array:
    """A smooth random process of about size one at the coarse nodes, limited to ±2.5."""
    keep = math.exp(-1 / (seconds * TONE_HZ))
    first, steps = keep * rng.standard_normal(1), math.sqrt(1 - keep**2) * rng.standard_normal(count)
    drawn = scipy.signal.lfilter([1.0], [1.0, -keep], steps, zi=first)[0]
    return _smooth(np.clip(drawn, -2.5, 2.5), TONE_HZ / 2)
