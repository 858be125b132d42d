"""The car around the IMU: slip, suspension, rough road, vibration, lever arm and mounting.

The rear axle follows the road exactly; on top of it comes a chain of rotations, each with its rate, from the
path through the car to the IMU:

    C_nb = C_path(slope, course) · R_x(bank) · R_z(−β) · R_y(pitch) R_x(roll) · C_shaken · C_mounting

and the IMU stands off the axle by o = R_x R_z (d + R_y R_x l), with d heave, vibration and shaking and l its place
in the car; C_shaken is what the mount itself turns (``shaking``). Position and velocity of the IMU are those of the
axle plus o and its derivative by the product rule, so nothing is integrated and truth stays exact at any sample rate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields

import numpy as np
import scipy
import torch
from numpy.typing import NDArray

from dlkf.base.errors import InputError
from dlkf.base.settings import Ranged, bounded_field
from dlkf.navigation.attitude import rotation_from_rpy, rpy_from_rotation
from dlkf.navigation.earth import NOMINAL_GRAVITY
from dlkf.simulation.motion.routes import Kinematics
from dlkf.simulation.motion.shaking import Shaking, resonance, shake_mount
from dlkf.simulation.motion.vehicle import Route, Truth, Waves, radians_per_metre, random_waves

Array = NDArray[np.floating]
NODE_HZ = 100  # suspension is solved at this rate, for any rate of the IMU, and a spline lies between
ROUGHEST = 0.0115  # m³ · m/s, G_d(0.1/m) times speed, that a driver bears: about 3 m/s² RMS of the body
PROFILE_STEP = 0.25  # m, about the length of a tyre's contact
FULL_WAVE, ROLL_WAVE = 0.01, 0.1  # cycles/m below which the rough road is flat, for heave and across
# vibration: cycles per second at rest, cycles per metre driven, share of the power
TONES = ((24.0, 0.5, 0.5), (12.0, 0.25, 0.2), (0.0, 0.51, 0.3))  # engine firing, half of it, a wheel's turn
TONE_SPEED = 15.0  # m/s at which the vibration has its stated size
SHAPE = (  # of what moves, if anything does
    "body_hz", "body_damping", "wheel_hz", "wheel_damping", "wheelbase", "track", "roughness_length", "shaking",
)  # fmt: skip


@dataclass(frozen=True)
class ChassisConfig(Ranged, where="chassis"):
    """A type of car; the defaults are a point on the rear axle that slides along the road.

    ``sideslip`` K: the rear axle's slip angle per lateral acceleration [s²/m], so that on a level road its
    velocity to the right is −K v² χ' (single-track model with K = m l_f/(L C_r), exact, without a lag, where
    the dynamic index I_z/(m l_f l_r) is one); ``slip_noise`` [rad] is the RMS of what side wind and ruts add, in
    waves of 20 to 300 m. Suspension: the body rolls outwards by ``roll_gradient`` and
    pitches back by ``pitch_gradient`` [rad per m/s² of specific force], with a second-order lag; ``pitch_noise`` [rad]
    is the RMS by which it pitches besides, over the swells of a road, in waves of 50 to 500 m.
    ``body_hz``, ``body_damping``: sprung mass on its springs; ``wheel_hz``, ``wheel_damping``: unsprung mass on its
    tyres; ``wheelbase``, ``track`` [m].
    ``roughness``: ISO 8608 G_d(0.1/m) [m³] (classes A to E: 16, 64, 256, 1024, 4096 · 1e-6), which changes by sections
    of ``roughness_length`` [m] on average (exponential) by a log-normal factor of the amplitude, log-std
    ``roughness_spread`` (0.7 is one class). ``vibration`` [m/s²] and ``vibration_rate`` [rad/s]: RMS per axis at
    15 m/s of tones that follow the speed; ``shaking``: what does not depend on it.
    ``imu_arm``: rear axle → IMU, forward, right, down [m]. ``mounting_deg``: roll, pitch, yaw of the IMU in the car.
    Each drive has a car of its own: 1σ ``imu_arm_std`` [m] and ``mounting_std_deg`` per axis, and ``spread``, relative,
    of slip and suspension.
    """

    sideslip: float = bounded_field(0.0, 0, 0.05)
    slip_noise: float = bounded_field(0.0, 0, 0.05)
    roll_gradient: float = bounded_field(0.0, 0, 0.05)
    pitch_gradient: float = bounded_field(0.0, 0, 0.05)
    pitch_noise: float = bounded_field(0.0, 0, 0.05)
    roughness: float = bounded_field(0.0, 0, 0.01)
    vibration: float = bounded_field(0.0, 0, 20.0)
    vibration_rate: float = bounded_field(0.0, 0, 0.5)
    imu_arm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    imu_arm_std: float = bounded_field(0.0, 0, 2.0)
    mounting_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    mounting_std_deg: float = bounded_field(0.0, 0, 10.0)
    spread: float = bounded_field(0.0, 0, 0.5)
    body_hz: float = bounded_field(1.4, 0.5, 5)
    body_damping: float = bounded_field(0.35, 0.05, 1)
    wheel_hz: float = bounded_field(12.0, 5, 25)
    wheel_damping: float = bounded_field(0.5, 0.05, 1)
    wheelbase: float = bounded_field(2.7, 1, 8)
    track: float = bounded_field(1.55, 0.5, 3)
    roughness_spread: float = bounded_field(0.0, 0, 2.0)
    roughness_length: float = bounded_field(300.0, 2, 100000.0)
    shaking: Shaking = field(default_factory=Shaking)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, limit in (("imu_arm", 10.0), ("mounting_deg", 45.0)):
            value = getattr(self, name)
            if len(value) != 3 or not all(abs(x) <= limit for x in value):
                raise InputError(f"chassis: {name} {list(value)} must be 3 numbers within ±{limit:g}")

    @property
    def is_point(self) -> bool:
        """Whether there is nothing to a car of this kind but its rear axle."""
        added = [name for name in (f.name for f in fields(self)) if name not in SHAPE]
        return self.shaking.is_still and not any(np.any(getattr(self, name)) for name in added)


@dataclass(frozen=True)
class Car:
    """One car as drawn; its sensors have no access to it."""

    kind: ChassisConfig
    sideslip: float
    roll_gradient: float
    pitch_gradient: float
    imu_arm: Array  # (3,) m
    mounting: Array  # (3,) roll, pitch, yaw [rad]
    gusts: Waves  # what is added to the slip angle [rad]
    swells: Waves  # what is added to the pitch [rad]


def draw_car(rng: np.random.Generator, kind: ChassisConfig) -> Car:
    """A car of the kind: arm and mounting normal, slip and suspension log-normal around the kind's."""
    factors = np.exp(kind.spread * rng.standard_normal(3))
    arm = np.asarray(kind.imu_arm) + kind.imu_arm_std * rng.standard_normal(3)
    mounting = np.radians(np.asarray(kind.mounting_deg) + kind.mounting_std_deg * rng.standard_normal(3))
    slip, roll, pitch = (factors * (kind.sideslip, kind.roll_gradient, kind.pitch_gradient)).tolist()
    gusts = random_waves(rng, kind.slip_noise, (20.0, 300.0))
    swells = random_waves(rng, kind.pitch_noise, (50.0, 500.0))
    return Car(kind, slip, roll, pitch, arm, mounting, gusts, swells)


def slip_angle(car: Car, route: Route, motion: Kinematics) -> tuple[Array, Array]:
    """β of the rear axle [rad] and its rate [rad/s]; the velocity to the right there is v sin β.

    The tyres carry the lateral acceleration less what the bank of the road does: β = −K (v χ' − g bank) + gusts.
    """
    gust, gust_rate = car.gusts.at(motion)
    bank, bank_rate = route.bank(motion)
    load = motion.speed * motion.yaw_rate - NOMINAL_GRAVITY * bank
    change = motion.acceleration * motion.yaw_rate + motion.speed * motion.yaw_acceleration
    return gust - car.sideslip * load, gust_rate - car.sideslip * (change - NOMINAL_GRAVITY * bank_rate)


def apply_mounting(rng: np.random.Generator, car: Car, route: Route, axle: Truth) -> Truth:
    """Truth of the IMU in a car whose rear axle moves as ``axle`` does along ``route``."""
    ride_rng, tone_rng, stretch_rng, shaking_rng = rng.spawn(4)
    motion = route.motion(axle.t)
    slope, slope_rate = route.slope.at(motion)
    slip, slip_rate = slip_angle(car, route, motion)
    sections = draw_road_sections(stretch_rng, car.kind, float(np.ptp(motion.distance)), float(motion.speed.max()))
    suspended = suspension(ride_rng, car, route, float(axle.t[-1]), sections)
    roll, pitch, heave = suspended(axle.t).T
    roll_rate, pitch_rate, heave_rate = suspended(axle.t, nu=1).T
    shake, shake_rate = vibration(tone_rng, car.kind, motion)

    C = rotation_from_rpy(torch.from_numpy(axle.rpy)).numpy()
    rate = np.stack((-motion.yaw_rate * np.sin(slope), slope_rate, motion.yaw_rate * np.cos(slope)), -1)
    C, rate = _turn(C, rate, 0, *route.bank(motion))
    C, rate = _turn(C, rate, 2, shake[:, 5] - slip, shake_rate[:, 5] - slip_rate)
    moved, moved_rate = shake[:, :3].copy(), shake_rate[:, :3].copy()
    moved[:, 2] -= heave
    moved_rate[:, 2] -= heave_rate
    mount = None
    if not car.kind.shaking.is_still:
        mount = shake_mount(
            shaking_rng, car.kind.shaking, route.motion, axle.t, lambda t: sections.at(route.motion(t).distance),
            lambda t: loads(route, route.motion(t)),
        )  # fmt: skip
        moved += mount.moved
        moved_rate += mount.moved_rate
    offset, change = _rotate(C, moved), _rotate(C, np.cross(rate, moved) + moved_rate)
    swell, swell_rate = car.swells.at(motion)
    C, rate = _turn(C, rate, 1, pitch + swell + shake[:, 4], pitch_rate + swell_rate + shake_rate[:, 4])
    C, rate = _turn(C, rate, 0, roll + shake[:, 3], roll_rate + shake_rate[:, 3])
    arm = np.broadcast_to(car.imu_arm, rate.shape)
    offset += _rotate(C, arm)
    change += _rotate(C, np.cross(rate, arm))
    if mount is not None:
        C = C @ rotation_from_rpy(torch.from_numpy(mount.turned)).numpy()
    return _shift(axle, offset, change, C @ rotation_from_rpy(torch.from_numpy(car.mounting)).numpy())


@dataclass(frozen=True)
class RoadSections:
    """The roughness of a road relative to its mean (amplitude), by sections that end at ``ends`` [m]."""

    ends: Array
    factors: Array

    def at(self, distance: Array) -> Array:
        """The factor at distances from the road's start [m]."""
        return self.factors[np.minimum(np.searchsorted(self.ends, distance, side="right"), len(self.factors) - 1)]


def draw_road_sections(rng: np.random.Generator, kind: ChassisConfig, length: float, fastest: float) -> RoadSections:
    """RoadSections of a road as long as that [m]; a single one where the kind has no spread.

    None is rougher than a driver would take at the ``fastest`` [m/s] of the drive: the body's acceleration goes with
    √(G_d v), and ``ROUGHEST`` is an average road (64e-6) at 180 m/s, or a poor one (1024e-6) at 11 m/s.
    """
    if kind.roughness_spread == 0:
        return RoadSections(np.array((math.inf,)), np.ones(1))
    mean = length / kind.roughness_length
    count = 2 + int(mean + 10 * math.sqrt(mean))  # ten sigma more than it takes
    ends = np.cumsum(kind.roughness_length * rng.standard_exponential(count))
    most = math.sqrt(ROUGHEST / max(kind.roughness * max(fastest, 1.0), 1e-12))
    return RoadSections(ends, np.minimum(np.exp(kind.roughness_spread * rng.standard_normal(count)), most))


def loads(route: Route, motion: Kinematics) -> tuple[Array, Array]:
    """Specific force along the road, forward and to the right [m/s²]."""
    forward = motion.acceleration + NOMINAL_GRAVITY * route.slope.at(motion)[0]
    return forward, motion.speed * motion.yaw_rate - NOMINAL_GRAVITY * route.bank(motion)[0]


def suspension(
    rng: np.random.Generator, car: Car, route: Route, end: float, sections: RoadSections | None
) -> scipy.interpolate.BSpline:
    """Roll, pitch [rad] and heave [m, up] of the body against the road, until ``end`` [s], as a spline.

    Each is a sprung mass: driven by the load it settles at gradient · specific force, H = ω²/(s² + 2ζωs + ω²);
    over the rough road it follows the wheels, H = (2ζωs + ω²)/(s² + 2ζωs + ω²).
    """
    nodes = np.arange(math.ceil(end * NODE_HZ) + 1) / NODE_HZ
    motion = route.motion(nodes)
    forward, right = loads(route, motion)
    load = np.stack((-car.roll_gradient * right, car.pitch_gradient * forward, np.zeros_like(nodes)), -1)
    kind = car.kind
    body = _filter(resonance(kind.body_hz, kind.body_damping, NODE_HZ), load)
    if kind.roughness > 0:
        road = rough_road(rng, kind, motion.distance, sections)
        wheels = _filter(resonance(kind.wheel_hz, kind.wheel_damping, NODE_HZ), road)
        body += _filter(resonance(kind.body_hz, kind.body_damping, NODE_HZ, at_base=True), wheels)
    return scipy.interpolate.make_interp_spline(nodes, body, k=5)


def rough_road(
    rng: np.random.Generator, kind: ChassisConfig, distance: Array, sections: RoadSections | None = None
) -> Array:
    """Roll, pitch [rad] and height [m] of the road under four wheels at distances (N,) → (N, 3) (ISO 8608).

    G_d(n) = G_d(n₀) (n/n₀)⁻², n₀ = 0.1/m: a white slope of one-sided PSD (2π n₀)² G_d(n₀), made leaky, so that
    the height does not wander off. Front and rear wheels run over the same profile; left and right differ
    by a profile of their own, below 10 m wavelength.
    """
    distance = distance - distance.min()
    count = int((distance.max() + 2 * kind.wheelbase) / PROFILE_STEP) + 3
    steepness = math.sqrt((0.2 * math.pi) ** 2 * kind.roughness / (2 * PROFILE_STEP))
    white = steepness * PROFILE_STEP * rng.standard_normal((2, count))
    if sections is not None and len(sections.factors) > 1:
        white *= sections.at(PROFILE_STEP * np.arange(count))
    along, across = (
        scipy.signal.lfilter([1.0], [1.0, -math.exp(-2 * math.pi * wave * PROFILE_STEP)], x)
        for wave, x in zip((FULL_WAVE, ROLL_WAVE), white)
    )
    at = PROFILE_STEP * np.arange(count)
    rear, front = (np.interp(distance + shift, at, along) for shift in (0.0, kind.wheelbase))
    roll = math.sqrt(2) * np.interp(distance, at, across) / kind.track
    return np.stack((roll, (front - rear) / kind.wheelbase, 0.5 * (front + rear)), -1)


def vibration(rng: np.random.Generator, kind: ChassisConfig, motion: Kinematics) -> tuple[Array, Array]:
    """Displacement along three axes [m] and roll, pitch, yaw [rad] by vibration, and their rates, (N, 6) each.

    Tones of fixed amplitude with phase 2π(f t + g s): the frequency f + g v rises with the speed v, the specific
    force with its square, as an unbalanced mass has it. All lie below 50 Hz up to 130 km/h.
    """
    shake, change = (np.zeros((len(motion.t), 6)) for _ in range(2))
    for rest, per_metre, share in TONES:
        start = rng.uniform(0, 2 * math.pi, 6)
        w = 2 * math.pi * (rest + per_metre * TONE_SPEED)
        size = math.sqrt(2 * share) * np.array([kind.vibration / w**2] * 3 + [kind.vibration_rate / w] * 3)
        phase = 2 * math.pi * (rest * motion.t + per_metre * motion.distance)[:, None] + start
        shake += size * np.sin(phase)
        change += size * np.cos(phase) * 2 * math.pi * (rest + per_metre * motion.speed)[:, None]
    return shake, change


def _filter(coefficients: tuple[Array, Array], x: Array) -> Array:
    """Columns of x (N, k) at the nodes through a filter (b, a), from the steady state of x₀."""
    b, a = coefficients
    return scipy.signal.lfilter(b, a, x, axis=0, zi=scipy.signal.lfilter_zi(b, a)[:, None] * x[:1])[0]


def _turn(C: Array, rate: Array, axis: int, angle: Array, angle_rate: Array) -> tuple[Array, Array]:
    """C R_axis(angle), and the rate of the turned frame in its own axes, Rᵀω + angle' e."""
    j, k = (axis + 1) % 3, (axis + 2) % 3
    cos, sin = np.cos(angle), np.sin(angle)
    turned, turned_rate = C.copy(), rate.copy()
    turned[..., j] = cos[:, None] * C[..., j] + sin[:, None] * C[..., k]
    turned[..., k] = cos[:, None] * C[..., k] - sin[:, None] * C[..., j]
    turned_rate[:, j] = cos * rate[:, j] + sin * rate[:, k]
    turned_rate[:, k] = cos * rate[:, k] - sin * rate[:, j]
    turned_rate[:, axis] += angle_rate
    return turned, turned_rate


def _rotate(C: Array, u: Array) -> Array:
    return np.einsum("tij,tj->ti", C, u)


def _shift(axle: Truth, offset: Array, change: Array, C_nb: Array) -> Truth:
    """Truth of a point that stands off by ``offset`` [m] in NED, whose change [m/s] is as seen in NED.

    NED itself turns as the car moves over the ellipsoid: v = v_axle + o' + ω_en × o (Groves 5.44).
    """
    north, east = axle.v_n[:, 0], axle.v_n[:, 1]
    per_east, per_north = radians_per_metre(axle.lat, axle.height)
    transport = np.stack(
        (east * per_east * np.cos(axle.lat), -north * per_north, -east * per_east * np.sin(axle.lat)), -1
    )
    rpy = rpy_from_rotation(torch.from_numpy(C_nb)).numpy()
    turns = np.round((axle.rpy[:, 2] - rpy[:, 2]) / (2 * math.pi))
    rpy[:, 2] += 2 * math.pi * turns
    return Truth(
        axle.t,
        axle.lat + offset[:, 0] * per_north,
        axle.lon + offset[:, 1] * per_east,
        axle.height - offset[:, 2],
        axle.v_n + change + np.cross(transport, offset),
        rpy,
    )
