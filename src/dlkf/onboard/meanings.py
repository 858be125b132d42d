"""What the numbers of an exported filter are, in words, with their units: of its memory, of a fix, of a row."""

from __future__ import annotations

AXES = {"n": "North", "e": "East", "d": "Down", "x": "forward", "y": "right", "z": "down"}
COLUMNS = {  # of a fix (at the antenna) and of a row (at the IMU); before the last part of a name that is an axis
    "lat_deg": "latitude [deg]",
    "lon_deg": "longitude [deg]",
    "height_m": "height above the ellipsoid [m]",
    "quality": "NMEA GGA: 0 none, 1 single, 2 differential, 4 RTK fixed, 5 RTK float",
    "lag_s": "how long before the epoch's end it was taken [s]",
    "gnss_used": "1 where the epoch's fix was used, else 0",
    "from_origin_m": "horizontal distance from the origin of the tangent frame [m]",
    "roll": "roll [rad]",
    "pitch": "pitch [rad]",
    "yaw": "yaw from North over East [rad]",
    "pos": "position {} [m]",
    "vel": "velocity {} [m/s]",
    "accel_error": "accelerometer error {}, measured less true [m/s²]",
    "gyro_error": "gyroscope error {}, measured less true [rad/s]",
}
MEMORY = {  # by the last parts of a field's name
    "frame.origin_e": "origin of the tangent frame n, ECEF [m]",
    "frame.C_en": "axes of n (North, East, Down at the origin) in ECEF",
    "frame.axis_n": "axis of the Earth in n",
    "frame.earth_rate_n": "rotation of the Earth in n [rad/s]",
    "frame.radius": "transverse radius of curvature plus height at the origin [m]",
    "frame.stretch": "ratio of the ellipsoid's normal to the radius there",
    "frame.height": "height of the origin [m]",
    "state.p_n": "position of the IMU in n [m]",
    "state.v_n": "velocity in n [m/s]",
    "state.C_nb": "attitude, body (forward, right, down) to n",
    "error.bias": "accelerometer [m/s²] and gyroscope [rad/s] bias in force",
    "error.matrix": "scale factors, or M of measured = (I + M) true + bias",
    "lever_arm_b": "IMU to antenna, forward, right, down [m]",
    "P": "covariance of the error states: m, m/s, rad, m/s², rad/s, then elements of M, then the car",
    "still": "transition of a window in which nothing moves",
    "density": "S of the noise: accelerometers [m²/s³], gyroscopes [rad²/s], walks of their biases [m²/s⁵, rad²/s³]",
    "fix.scale": "factors on 1σ of a fix, and the least 1σ: position [m], velocity [m/s]",
    "std": "1σ across the car [m/s], and at rest: velocity [m/s], rate [rad/s]",
    "liveliness.standing": "quietest second of standing: spread of force times that of rate [m/s² rad/s]; inf: none",
    "liveliness.moving": "quietest second of motion, likewise",
    "prior": "quietest second of motion before one was heard, likewise",
    "structure": "mounting yaw, pitch [rad], distance to the rear axle [m], sideslip [s²/m], pitch gradient [rad s²/m]",
    "noise.Q": "adapted covariance of an epoch's process noise, units of P",
    "noise.R": "adapted variance of a fix: position [m²], velocity [m²/s²]",
    "noise.settled": "1 where the adapted noise is in force",
    "noise.fixes": "fixes so far",
    "noise.epochs": "epochs since the last fix",
    "forgetting": "share of the past in the adapted noise",
    "gate.refused": "fixes refused in a row that agree with each other",
    "gate.innovation": "innovation of the last refused position [m]",
    "gate.age": "time since then [s]",
    "gate.fix": "the last fix offered, in n [m, m/s]",
    "gate.frozen": "1 where fixes stay while the car moves",
    "gate.limits": "greatest normalised innovation squared, by the number of components",
    "recurrent.0": "cells of the LSTM: hidden, by layer",
    "recurrent.1": "cells of the LSTM: memory, by layer",
    "hidden": "cells of the recurrent network",
    "elapsed": "time since the start (plus), since the network's last run (dlkf) [s]",
    "since_fix": "time since the last fix [s]",
    "memory.origin": "position at the start, from which the network's inputs count, in n [m]",
    "posterior.p_n": "position after the network's last run, in n [m]",
    "posterior.v_n": "velocity then, in n [m/s]",
    "posterior.C_nb": "attitude then, body to n",
    "difference": "change from the run before to that one [m, m/s, rad]",
    "difference_s": "time between the two [s]",
    "correction": "the last correction [m, m/s, rad]",
    "memory.fix": "the last fix in n [m, m/s]",
    "had_fix": "1 where it had that component",
    "matching.innovations": "innovations² over their variance, remembered short and long",
    "matching.ratios": "corrections² over what P lost by them, likewise",
    "matching.sizes": "corrections² over typical ones, remembered short",
    "matching.fixes": "fixes so far",
    "fix_speed": "forward speed at the last fix [m/s]",
    "car.mean": "speed from vibrations: weights w of speed = wᵀφ, φ heard by the network and 1 [m/s]",
    "car.spread": "covariance P of w, over the variance b / a of a speed",
    "car.count": "a of that variance",
    "car.squares": "b of it [m²/s²]",
    "memory.residual": "part of the IMU error that the network added [m/s², rad/s]",
    "silent": "1 where the speed is withheld; always 0 in a vehicle",
    "seen.process": "the network's last factors on the noise: both sensors, their walks; forward, right, down",
    "seen.fix": "its factors on 1σ of a fix: position horizontal and down, velocity horizontal and down",
    "seen.across": "its factors on 1σ of the constraints: to the right, down",
    "seen.offset": "its velocity to the right and down beside the car's model [m/s]",
    "seen.residual": "its part of the IMU error [m/s², rad/s]",
    "seen.doubt": "its factor on 1σ of the speed from vibrations",
}


def of_field(name: str) -> str | None:
    """Of a field of the memory; None for one of a filter of a user's own."""
    parts = name.split(".")
    tails = (".".join(parts[k:]) for k in range(len(parts)))
    return next((MEMORY[tail] for tail in tails if tail in MEMORY), None)


def of_column(name: str) -> str:
    """Of a column of a fix or of a row.

    ``std_vel_n`` → 1σ of velocity North [m/s], ``innovation_pos_d`` → fix less expected: position Down [m].
    """
    for head, said in (("innovation_std_", "1σ of fix less expected: "), ("innovation_", "fix less expected: ")):
        if name.startswith(head):
            return said + of_column(name.removeprefix(head))
    if name.startswith("std_"):
        return "1σ of " + of_column(name.removeprefix("std_"))
    if name in COLUMNS:
        return COLUMNS[name]
    quantity, _, axis = name.rpartition("_")
    return COLUMNS[quantity].format(AXES[axis])
