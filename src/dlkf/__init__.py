"""Deep-learning-assisted Kalman filter for GNSS/IMU integration.

Glossary of names and conventions used everywhere below this package.

Frames
    i   inertial; e  Earth-centred Earth-fixed (WGS-84, metres)
    n   local tangent North-East-Down, *fixed at the start of a sub-trajectory*, metres
    b   body, Forward-Right-Down
    Files and reports are in true local NED at the vehicle; the filter works in n.
Names
    p_n, v_n    position and velocity in n;  C_nb  rotation that takes body vectors to n
    f_b, w_b    specific force [m/s²] and angular rate [rad/s] in b
    imu         accelerometer then gyroscope, 6 columns; imu_error likewise
Errors
    Error state = truth − estimate, order position, velocity, attitude, accelerometer, gyroscope.
    C_nb(true) = exp([δh×]) C_nb(estimate); corrections are added; H = +[I₆ 0].
    Measured IMU = true + error, so corrected = measured − estimated error.
Units
    SI and radians. Degrees only in columns named ``_deg``. Quaternions scalar-first.
Shapes
    (batch, epoch, sample, axis). An epoch is one update interval, 1 s by default: the IMU samples between two
    boundaries, then at most one fix and one measurement of each aid.
Data
    drive       one continuous recording;  group: the recording it is part of, the unit of every split
    segment     a stretch of a drive with its own start state and tangent frame, as filters are trained and scored on
    outage      an interval in which GNSS fixes are withheld
    reference   the solution that errors are measured against (truth, in simulated drives)
Filters
    ins         strapdown from the last fix
    mbkf15      error-state Kalman filter: position, velocity, attitude, biases;  mbkf21, mbkf33: also scale
                factors, also misalignments;  aekf: with adaptive Q and R
    _prior      starts from the training drives' mean IMU error
    _nhc        non-holonomic constraints: no velocity across and down, zero velocity while stationary
    _car        these with mounting angles, rear-axle distance, sideslip and pitch gradient as states
    _gated      χ² gate on fixes;  _rts: smoothed backwards
    plus        mbkf33_car that estimates its IMU's noise while it runs;  dlkf: a network gives gain and IMU error
    module:Class a filter of your own;  filter+module:Class: a Kalman filter with a measurement source of your own
Tables
    30 s, 60 s  horizontal error so long after the outage began, RMS over outages [m];  end: at its end
    P / V / A   mean over segments of the RMS of position [m], velocity [m/s], attitude [rad] (the paper's measure)
    ratio       to the baseline, in [ ] the 95 % interval of a paired bootstrap over groups
    slope       change of the estimated IMU error per injected bias: 1 estimates it, 0 ignores it
    NEES, NIS   squared error, squared innovation over their covariance, divided by their size: 1 is consistent
Citations
    R085 (what the paper asks for, by number) and "paper.md 4.10" (how it was read) are in docs/paper.md; "paper eq 9"
    is the paper itself. The equations from the sample to the solution are in docs/algorithm.md.
"""

from __future__ import annotations

from typing import Any

__version__ = "0.2.0"

PUBLIC = {  # imported when first used: torch takes seconds
    **dict.fromkeys(("navigate", "evaluate", "load", "Stream", "simulate", "read_logs"), "dlkf.frames"),
    "Solution": "dlkf.frames",
    "Evaluation": "dlkf.frames",
    "InputError": "dlkf.base.errors",
}
__all__ = ["__version__", *PUBLIC]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in PUBLIC:
        raise AttributeError(f"module 'dlkf' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(PUBLIC[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
