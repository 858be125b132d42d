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
    (batch, epoch, sample, axis). An epoch is one update interval, 1 s unless said otherwise.
Citations
    R085 (what the paper asks for, by number) and "paper.md 4.10" (how it was read) are in docs/paper.md; "paper eq 9"
    is the paper itself. The equations from the sample to the solution are in docs/algorithm.md.
"""

__version__ = "0.1.0"
