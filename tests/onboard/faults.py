"""What goes wrong on the way from sensors to a stream: one table, run against the Python stream and the core in C.

A fault turns the calls of a drive into others; beside it the words that the streams must say of it.
"""

from __future__ import annotations

from collections.abc import Callable
from math import inf, nan, sin

import numpy as np

from tests.onboard.streams import Call, Calls

Fault = Callable[[Calls], Calls]


def _changed(kind: str, chosen: Callable[[float], bool], change: Callable[[tuple], tuple | list[tuple]]) -> Fault:
    """Calls of a kind at chosen times replaced by one or more others, or by none."""

    def made(sent: Calls) -> Calls:
        out: Calls = []
        for call in sent:
            if call.kind == kind and chosen(call.arguments[0]):
                found = change(call.arguments)
                out += [Call(kind, x) for x in (found if isinstance(found, list) else [found])]
            else:
                out.append(call)
        return out

    return made


def _at(t: float, width: float = 0.015) -> Callable[[float], bool]:
    return lambda x: t <= x < t + width


def _between(first: float, last: float) -> Callable[[float], bool]:
    return lambda x: first < x <= last


def _put(x: tuple, place: int, value) -> tuple:
    return (*x[:place], value, *x[place + 1 :])


def _one_by_one(kind: str, width: float, *changes: Callable[[tuple], tuple | list[tuple]]) -> Fault:
    """A call of the kind in every other second from 20 s on, each changed in its own way."""

    def made(sent: Calls) -> Calls:
        for k, change in enumerate(changes):
            sent = _changed(kind, _at(20.0 + 2 * k, width), change)(sent)
        return sent

    return made


SENSORS = ("speed", "heading", "baro")


def t_ms(x: tuple) -> float:
    """Stamp of a call [ms]."""
    return 1e3 * x[0]


def _late(seconds: float, since: float = -inf, until: float = inf, kinds: tuple[str, ...] = ("gnss",)) -> Fault:
    def made(sent: Calls) -> Calls:
        def comes(call: Call) -> float:
            t = call.arguments[0]
            return t + (seconds if call.kind in kinds and since < t <= until else 0.0)

        return sorted(sent, key=comes)

    return made


def _clock(since: float, shift: float) -> Fault:
    """Both clocks are set at a moment."""

    def made(sent: Calls) -> Calls:
        return [Call(c.kind, (c.arguments[0] + shift, *c.arguments[1:])) if c.arguments[0] > since else c for c in sent]

    return made


def _stamps(change: Callable[[np.ndarray], np.ndarray], kinds: tuple[str, ...] = ("imu",)) -> Fault:
    def made(sent: Calls) -> Calls:
        t = change(np.array([c.arguments[0] for c in sent])).tolist()
        return [Call(c.kind, (s, *c.arguments[1:])) if c.kind in kinds else c for c, s in zip(sent, t)]

    return made


def _jitter(seed: int, size: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda t: t + np.random.default_rng(seed).uniform(-size, size, len(t))


def _lost(share: float, kind: str = "imu") -> Fault:
    def made(sent: Calls) -> Calls:
        kept = np.random.default_rng(3).random(len(sent)) > share
        return [c for c, k in zip(sent, kept) if k or c.kind != kind]

    return made


def _first(*arguments) -> Fault:
    """A fix before all others."""
    return lambda sent: [Call("gnss", arguments), *sent]


def _many(sent: Calls) -> Calls:
    """One sample in twenty and one fix in three are damaged in some way."""
    g = np.random.default_rng(5)
    out: Calls = []
    for call in sent:
        if call.kind in SENSORS or g.random() > (0.05 if call.kind == "imu" else 0.3):
            out.append(call)
            continue
        x = list(call.arguments)
        kind = g.integers(6)
        if kind == 0:
            continue  # lost
        if kind == 1:
            out.append(call)  # twice
        elif kind == 2:
            x[0] = float(x[0] + g.choice([-30.0, -0.5, 0.05, 70.0, 1e9, nan, inf]))
        elif kind == 3 and call.kind == "imu":
            x[int(g.integers(1, 3))] = [float(g.choice([nan, inf, 1e7])), 0.0, -9.8]
        elif kind == 3:
            x[int(g.integers(1, 4))] = float(g.choice([nan, inf, 95.0]))
        elif kind == 4 and out:
            out.insert(-1, call)  # out of order
            continue
        out.append(Call(call.kind, tuple(x)))
    return out


def _frozen(sent: Calls) -> Calls:
    """One fix again and again for eight seconds, while the velocity is that of motion."""
    held = next(c.arguments for c in sent if c.kind == "gnss" and c.arguments[0] > 30)
    place = held[1:4]
    return _changed("gnss", _between(30.5, 38.5), lambda x: (x[0], *place, [5.0, 5.0, 0.0], *x[5:]))(sent)


def _frozen_imu(first: float, last: float) -> Fault:
    """One sample again and again, with stamps that go on."""

    def made(sent: Calls) -> Calls:
        held = next(c.arguments[1:] for c in sent if c.kind == "imu" and c.arguments[0] > first)
        return _changed("imu", _between(first, last), lambda x: (x[0], *held))(sent)

    return made


def _repeated(sent: Calls) -> Calls:
    """Samples ten times as seldom, each sent ten times."""
    out, held, k = [], (), 0
    for call in sent:
        if call.kind == "imu":
            held = call.arguments[1:] if k % 10 == 0 else held
            call, k = Call("imu", (call.arguments[0], *held)), k + 1
        out.append(call)
    return out


def _often(sent: Calls) -> Calls:
    """Each fix four times more in the second after it."""
    again = [Call("gnss", (c.arguments[0] + 0.2 * k, *c.arguments[1:])) for c in sent if c.kind == "gnss"
             for k in range(1, 5)]  # fmt: skip
    return sorted([*sent, *again], key=lambda call: call.arguments[0])


def _fast_speeds(sent: Calls) -> Calls:
    """Speeds between those of the drive at every sample of five seconds, the first ten of them once more."""
    fast = [
        Call("speed", (c.arguments[0] + 0.001, 5.0, 0.1)) for c in sent if c.kind == "imu" and 25 < c.arguments[0] < 30
    ]
    arriving = [*((c.arguments[0], c) for c in (*sent, *fast)), *((28.0, c) for c in fast[:10])]
    return [call for _, call in sorted(arriving, key=lambda x: x[0])]


def _spikes(first: float, every: float) -> Fault:
    """A sample of one sensor or of both that is far off, again and again."""

    def made(sent: Calls) -> Calls:
        out, due, k = [], first, 0
        for call in sent:
            if call.kind == "imu" and call.arguments[0] >= due - 1e-9:
                t, accel, gyro = call.arguments
                due, k = due + every, k + 1
                accel = [accel[0], accel[1] - 30.0, accel[2] + 12.0] if k % 3 else accel
                call = Call("imu", (t, accel, gyro if k % 3 == 1 else [gyro[0], gyro[1], gyro[2] + 1.5]))
            out.append(call)
        return out

    return made


WITHOUT_VELOCITY = [nan] * 3
JUMPS: dict[str, Fault] = {
    "fixes 20 km off for 25 s": _changed("gnss", _between(25.5, 50.5), lambda x: _put(x, 1, x[1] + 0.18)),
    "a frozen receiver": _frozen,
}
OFF, FROZEN = JUMPS
JUMPS_LATE: dict[str, tuple[str, Fault]] = {  # what the receiver says, and which of its fixes come late
    "fixes 20 km off, the last good one late": (OFF, _late(8.0, 24.5, 25.5)),
    "fixes 20 km off, some of them late": (OFF, _late(6.0, 30.5, 32.5)),
    "fixes 20 km off, the first good ones after them late": (OFF, _late(7.0, 50.5, 52.5)),
    "a frozen receiver, and late fixes": (FROZEN, _late(5.0, 29.5, 33.5)),
}
ALONE = _changed("gnss", lambda t: True, lambda x: _put(x, 4, WITHOUT_VELOCITY))
JUMPY = _changed("gnss", lambda t: round(t) % 7 == 3, lambda x: _put(x, 1, x[1] + 2.7e-5))
SCATTERED = _changed("gnss", lambda t: True, lambda x: _put(x, 1, x[1] + 2.5e-5 * sin(round(x[0]) ** 2)))
COARSE = _changed("gnss", lambda t: True, lambda x: (*x[:4], WITHOUT_VELOCITY, [3.0] * 3 + WITHOUT_VELOCITY, x[6]))
AROUND = (48.8, 9.2, 300.0)  # some place, far from the drive
LEVEL = _changed("gnss", lambda t: True, lambda x: _put(x, 4, [*x[4][:2], nan]))
FAULTS: dict[str, tuple[Fault, tuple[str, ...]]] = {
    "none": (lambda sent: sent, ("taken",)),
    "single samples": (_one_by_one(
        "imu", 0.015,
        lambda x: [],  # missing
        lambda x: [x, x],
        lambda x: [x, _put(x, 0, x[0] - 0.02)],  # in the wrong order
        lambda x: _put(x, 1, [0.0, nan, 0.0]),
        lambda x: _put(x, 0, nan),
        lambda x: _put(x, 1, [1e6, 0.0, 0.0]),
        lambda x: _put(x, 2, [0.0, 100.0, 0.0]),
    ), ("double", "back", "not_finite", "not_finite", "implausible", "implausible")),
    "single fixes": (_one_by_one(
        "gnss", 0.5,
        lambda x: [x, x],
        lambda x: [x, (x[0] - 0.3, x[1] + 1e-7, *x[2:])],  # an older one of the same interval
        lambda x: _put(x, 4, WITHOUT_VELOCITY),
        lambda x: [x, _put(x, 0, x[0] + 100)],  # ahead of the samples
        lambda x: _put(x, 1, nan),
        lambda x: _put(x, 6, 0),  # quality
        lambda x: _put(x, 6, 77),
        lambda x: _put(x, 3, inf),
        lambda x: _put(x, 1, 95.0),
        lambda x: _put(x, 5, [-1.0] * 6),
        lambda x: (x[0], 0.0, 0.0, 0.0, *x[4:]),
        lambda x: _put(x, 1, x[1] + 0.045),  # 5 km off
        lambda x: _put(x, 3, 2e4),
        lambda x: _put(x, 4, [300.0, 0.0, 0.0]),
    ), ("double", "superseded", "ahead", *3 * ("no_fix",), "not_finite", *2 * ("outside",), *4 * ("implausible_fix",))),
    "single samples of sensors": (lambda sent: _changed(
        "baro", _at(50.0, 1.0), lambda x: [x, _put(x, 0, x[0] + 100), _put(x, 0, 1e300), _put(x, 2, -0.1)]
    )(_changed(
        "heading", _between(25, 35), lambda x: [_put(x, 0, x[0] - 0.2), x, _put(x, 0, x[0] - 0.4)]
    )(_one_by_one(
        "speed", 0.5, lambda x: _put(x, 1, nan), lambda x: [x, x]
    )(sent))), ("not_finite", "double", "ahead", "ahead", "outside")),
    "spikes": (_spikes(0.0, 3.17), ()),
    "spikes in the last and the last but one sample of an update interval": (_spikes(19.99, 2.99), ()),
    "knocks of two samples": (_changed("imu", lambda t: t > 20 and t % 3 < 0.025, lambda x: _put(
        x, 1, [x[1][0] + 30.0, *x[1][1:]])), ()),
    "a tenth of the samples missing": (_lost(0.1), ()),
    "stamps that jitter": (_stamps(_jitter(1, 3e-3)), ()),
    "an IMU's clock 500 ppm fast": (_stamps(lambda t: t * 1.0005), ()),
    "samples at half the rate": (lambda sent: [c for k, c in enumerate(sent) if k % 2 or c.kind != "imu"], ()),
    "a gap of 0.2 s": (_changed("imu", _between(30.1, 30.3), lambda x: []), ()),
    "a gap of 0.4 s": (_changed("imu", _between(30.12, 30.52), lambda x: []), ("gap", "bridged")),
    "a gap of 2.9 s": (_changed("imu", _between(30.1, 33.0), lambda x: []), ("gap", "bridged")),
    "a gap of 4 s": (_changed("imu", _between(30.1, 34.1), lambda x: []), ("gap", "restarted")),
    "gaps of 0.3 s in every second of four": (
        _changed("imu", lambda t: 30 < t < 34 and t % 1 > 0.7, lambda x: []), ("bridged",) * 4),
    "a gap of half a second, late fixes": (
        lambda sent: _changed("imu", _between(30.1, 30.6), lambda x: [])(_late(3.0)(sent)), ("bridged", "replayed")),
    "a gap of half a second in which the lost filter ends": (
        lambda sent: _changed("imu", _between(30.1, 30.6), lambda x: [])(
            _changed("gnss", lambda t: t < 44, lambda x: _put(x, 1, -x[1]))(sent)), ("gap", "implausible_fix")),
    "gaps of half a second without fixes": (
        lambda sent: _changed("imu", lambda t: t > 26 and t % 7 < 0.5, lambda x: [])(
            _changed("gnss", _between(25.0, 45.0), lambda x: [])(sent)), ("bridged",)),
    "two samples ahead": (_changed("imu", _at(30.1, 0.015), lambda x: _put(x, 0, x[0] + 1.5)), ("gap",)),
    "an IMU frozen for 2 s": (_frozen_imu(30.1, 32.1), ("frozen", "gap", "bridged")),
    "an IMU frozen for 5 s": (_frozen_imu(30.1, 35.1), ("frozen", "gap", "restarted")),
    "an IMU frozen for 0.4 s": (_frozen_imu(30.1, 30.5), ()),
    "an IMU that repeats each sample": (_repeated, ()),
    "clocks set back 50 s": (_clock(30.5, -50.0), ("back", "restarted")),
    "clocks set ahead 1e6 s": (_clock(30.5, 1e6), ("gap", "restarted")),
    "no fixes for 20 s": (_changed("gnss", _between(25.0, 45.0), lambda x: []), ()),
    "fixes 3 s late": (_late(3.0), ("replayed",)),
    "fixes 9.5 s late": (_late(9.5, 20.0), ("replayed",)),
    "fixes 15 s late": (_late(15.0, 25.0), ("late",)),
    "all fixes late from the start on": (_late(6.3), ("replayed",)),
    "positions alone": (ALONE, ()),
    "positions alone, one in seven 3 m off": (lambda sent: JUMPY(ALONE(sent)), ()),
    "positions alone that scatter by two metres": (lambda sent: SCATTERED(ALONE(sent)), ()),
    "positions that scatter by two metres": (SCATTERED, ()),
    "one velocity in three fixes": (
        _changed("gnss", lambda t: round(t) % 3 > 0, lambda x: _put(x, 4, WITHOUT_VELOCITY)), ()),
    "every third fix lost": (_changed("gnss", lambda t: round(t) % 3 == 1, lambda x: []), ()),
    "a fix in two seconds": (_changed("gnss", lambda t: round(t) % 2 == 1, lambda x: []), ()),
    "a fix in four seconds": (_changed("gnss", lambda t: round(t) % 4 > 0, lambda x: []), ()),
    "a position in two seconds": (
        lambda sent: ALONE(_changed("gnss", lambda t: round(t) % 2 == 1, lambda x: [])(sent)), ()),
    "no velocities for ten seconds, twice": (
        _changed("gnss", lambda t: round(t) % 20 > 9, lambda x: _put(x, 4, WITHOUT_VELOCITY)), ()),
    "velocities of unknown 1σ": (
        _changed("gnss", lambda t: True, lambda x: _put(x, 5, [*x[5][:3], 99.0, 99.0, 99.0])), ()),
    "coarse positions alone": (COARSE, ()),
    "coarse positions alone, 3 s late": (lambda sent: _late(3.0)(COARSE(sent)), ("replayed",)),
    "fixes of the other hemisphere": (
        _changed("gnss", lambda t: t < 44, lambda x: _put(x, 1, -x[1])), ("implausible_fix",)),  # lost again and again
    "wheel speeds at 100 Hz, some again after three seconds": (_fast_speeds, ("double",)),
    "no 1σ": (_changed("gnss", lambda t: True, lambda x: _put(x, 5, [nan] * 6)), ()),
    "a 1σ of 0": (_changed("gnss", lambda t: True, lambda x: _put(x, 5, [0.0] * 6)), ()),
    "fixes 100 m off, one in six": (
        _changed("gnss", lambda t: round(t) % 6 == 3, lambda x: _put(x, 1, x[1] + 9e-4)), ()),
    **{name: (jump, ("implausible_fix",)) for name, jump in JUMPS.items()},
    **{name: (lambda sent, jump=JUMPS[jump], late=late: late(jump(sent)), ("implausible_fix",))
       for name, (jump, late) in JUMPS_LATE.items()},
    "a frozen receiver without velocity down": (lambda sent: LEVEL(_frozen(sent)), ("implausible_fix",)),
    "fixes at 5 Hz that hold the last position": (lambda sent: _often(ALONE(_frozen(sent))), ()),
    "a receiver that holds its last position": (lambda sent: ALONE(_frozen(sent)), ()),
    "sensors that mark invalid values": (
        _changed("speed", _between(25.0, 28.0), lambda x: _put(x, 1, 1.7e308)), ("implausible",)),
    "a gyroscope that saturates for a second": (
        _changed("imu", _between(30.0, 31.0), lambda x: _put(x, 2, [0.0, 0.0, 35.0])), ()),
    "velocities 4 m/s off, one in five": (
        _changed("gnss", lambda t: round(t) % 5 == 2, lambda x: _put(x, 4, [x[4][0] + 4.0, *x[4][1:]])), ()),
    "velocities that scatter by 2 m/s": (_changed("gnss", lambda t: True, lambda x: _put(
        x, 4, [x[4][0] + 2.0 * sin(round(x[0]) ** 2), x[4][1] + 2.0 * sin(3 + round(x[0]) ** 2), x[4][2]])), ()),
    "gyroscopes 3 °/s off": (
        _changed("imu", lambda t: True, lambda x: _put(x, 2, [w + 0.05 for w in x[2]])), ()),
    "a first fix of the year 2001": (_first(1e9, *AROUND), ()),
    "a first fix 18 s ahead": (_first(18.0, *AROUND), ()),
    "fixes at 2 Hz off the second": (
        _changed("gnss", lambda t: True, lambda x: [_put(x, 0, x[0] - 0.18), _put(x, 0, x[0] + 0.31)]), ()),
    "fix stamps that jitter": (_stamps(_jitter(2, 0.04), ("gnss",)), ()),
    "positions alone whose stamps jitter": (lambda sent: _stamps(_jitter(3, 0.04), ("gnss",))(ALONE(sent)), ()),
    "sensors 0.4 s late": (_late(0.4, 30.0, 34.0, SENSORS), ("replayed",)),
    "sensors 15 s late": (_late(15.0, 25.0, 40.0, SENSORS), ("late",)),
    "wheel speeds with 1σ, and some without": (
        _changed("speed", lambda t: True, lambda x: _put(x, 2, 0.1 if round(t_ms(x)) % 7 else nan)), ()),
    "a locked wheel on a moving car": (
        _changed("speed", _between(25.0, 45.0), lambda x: _put(x, 1, 0.0)), ()),
    "no sensors": (lambda sent: [c for c in sent if c.kind not in SENSORS], ()),
    "damage of all kinds": (_many, ("not_finite", "implausible", "double", "back")),
}  # fmt: skip
USUAL = (  # one of each kind, of every day's tests; all of them: pytest -m exports
    "none", "single samples", "single fixes", "a gap of 0.4 s", "a gap of 4 s", "an IMU frozen for 5 s",
    "spikes in the last and the last but one sample of an update interval", "a tenth of the samples missing",
    "clocks set back 50 s", "coarse positions alone, 3 s late", *JUMPS, *JUMPS_LATE, "a first fix 18 s ahead",
    "wheel speeds at 100 Hz, some again after three seconds", "fix stamps that jitter", "every third fix lost",
    "a position in two seconds", "a locked wheel on a moving car", "damage of all kinds",
)  # fmt: skip
