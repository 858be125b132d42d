"""What the numbers of an exported filter are, in words, with their units: of its memory and of a row."""

from __future__ import annotations

AXES = {"n": "North", "e": "East", "d": "Down", "x": "forward", "y": "right", "z": "down"}
COLUMNS = {  # of a row, at the IMU; before the last part of a name that is an axis
    "t": "time of the row on the clock of the samples [s]",
    "revised": "1 where a late fix changed a row that was there before, else 0",
    "lat_deg": "latitude [deg]",
    "lon_deg": "longitude [deg]",
    "height_m": "height above the ellipsoid [m]",
    "gnss_used": "1 where the epoch's fix was used, else 0",
    "from_origin_m": "horizontal distance from the origin of the tangent frame [m]",
    "roll": "roll [rad]",
    "pitch": "pitch [rad]",
    "yaw": "yaw from North over East [rad]",
    "pos": "position {} [m]",
    "vel": "velocity {} [m/s]",
    "accel_error": "accelerometer error {}, measured less true [m/s²]",
    "gyro_error": "gyroscope error {}, measured less true [rad/s]",
    "vibration_speed_innovation": "ln of the speed that vibration shows over the filter's",
    "vibration_speed_innovation_std": "1σ of that",
    "vibration_speed_used": "1 where that was used, else 0",
    "vibration_speed_share": "how far the spectrum of the vibration is trusted, 0 to 1",
    **{
        f"g_sensitivity_{axis}": f"rate {name} that the gyroscopes show of specific force {{}} [rad/s per m/s²]"
        for axis, name in AXES.items()
    },
    "fix_delay_s": "how old fixes are at their stamp [s]",
    "velocity_delay_s": "how much older the velocity of a fix is than its position [s]",
    "clock_drift_ppm": "receiver's clock fast against that of the IMU, per million: the delay grows so",
    "lever_forward_m": "antenna further forward than the lever arm says [m]",
    "lever_right_m": "antenna further to the right than the lever arm says [m]",
    "lever_down_m": "antenna further down than the lever arm says [m]",
    **{
        f"position_error_{axis}_m": f"slow error of the receiver's positions, {axis} [m]"
        for axis in ("north", "east", "down")
    },
}
SENSOR = {  # of a further sensor, after its name
    "_innovation": "sample of the sensor {} less expected, in its unit",
    "_innovation_std": "1σ of that of the sensor {}, in its unit",
    "_used": "1 where a sample of the sensor {} was used, else 0",
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
    "error.g_sensitivity": "rate that gyroscopes show of specific force forward and right [rad/s per m/s²]",
    "error.matrix": "scale factors, or M of measured = (I + M) true + bias",
    "lever_arm_b": "IMU to antenna, forward, right, down [m]",
    "since_fix_s": "time since the last position [s]",
    "P": "covariance of the error states: m, m/s, rad, m/s², rad/s, then elements of M, then the car",
    "still": "transition of a window in which nothing moves",
    "density": "S of the noise: accelerometers [m²/s³], gyroscopes [rad²/s], walks of their biases [m²/s⁵, rad²/s³]",
    "fix.scale": "factors on 1σ of a fix, and the least 1σ: position [m], velocity [m/s]",
    "std": "1σ across the car [m/s], and at rest: velocity [m/s], rate [rad/s]",
    "liveliness.standing": "least level of a stationary second: spread of force × that of rate [m/s² rad/s]; inf: none",
    "liveliness.moving": "least level of a second of motion, likewise",
    "liveliness.still_s": "s without acceleration or turn",
    "liveliness.calm_s": "s of these at a level that may be a standstill",
    "liveliness.rest_s": "s of these at the level of one",
    "rest.last_force": "specific force of the last second, forward and right, as measured [m/s²]; NaN: none",
    "rest.force": "specific force of the last standstill, forward and right, as measured [m/s²]; NaN: none",
    "rest.left_s": "s since that standstill",
    "rest.velocity": "mean velocity of the fixes since the car shows no acceleration and no turn, north and east [m/s]",
    "rest.std": "1σ of the last of them [m/s]",
    "rest.fixes": "number of them, at most ten",
    "rest.fix_age_s": "s since the last of them",
    "second.means": "means of the samples over 0.1 s, of the last second [m/s², rad/s]; NaN: not yet",
    "span.place": "position by the fix that a span of seconds begins with, in n [m]; NaN: none",
    "span.age_s": "s since that fix",
    "span.moving": "least level of the seconds since in which the filter moves, likewise",
    "span.still": "least level of the seconds since without acceleration or turn, likewise",
    "prior": "prior least level of a second of motion, likewise",
    "tails.start": "variance of the prior of the vertical gyroscope's scale factor, at the start",
    "tails.variance": "the same, in force",
    "structure": "mounting yaw, pitch [rad], distance to the rear axle [m], sideslip [s²/m], pitch gradient [rad s²/m]",
    "parameters": "estimates of what further sensors add to the states, in their order",
    "trust.refused": "measurements of a further sensor refused in a row",
    "trust.doubted": "1 where the sensor is not used until it agrees again",
    "trust.agreed": "measurements that agreed in a row since",
    "factor": "factor on the 1σ of a further sensor",
    "variance": "factor on the variance of its noise",
    "counted": "measurements that this factor is of",
    "last": "last speed of the wheel [m/s]; last innovation of the heading [rad], NaN: none",
    "repeats": "how often that speed came again",
    "gained": "what the INS has gained in speed in the last seconds since it came first [m/s]",
    "whole": "share of its speeds that were whole km/h",
    "signed": "1 where it has been negative",
    "zone": "largest speed at which it has read zero [m/s]",
    "rolling": "1 where the wheel turned and counted",
    "stopped": "1 where it did not turn and counted",
    "block.spectrum": "sums over a block of samples times cos and sin at every spatial frequency",
    "block.distance": "distance covered in the block [m]",
    "block.elapsed": "time in the block [s]",
    "block.slowest": "least speed in the block [m/s]",
    "block.fixed": "1 where it had a fix",
    "block.turned": "course since the block began [rad]",
    "block.turned_s": "its integral over time [rad s]",
    "last_sample": "the last sample [m/s², rad/s]",
    "by_distance.total": "sum over blocks of ln power less its trend, by axis and spatial frequency",
    "by_distance.weight": "blocks in that sum",
    "by_time.total": "the same by frequency in time",
    "by_time.weight": "blocks in that sum",
    "blocks": "blocks in both",
    "evidence": "evidence for each share of the vibration's likelihood [nats]",
    "age": "time since the last fix [s]",
    "turn.total": "fading sum of innovations across the car over their 1σ, sideways and down",
    "turn.weight": "fading sum of the squares of its weights",
    "noise.squares": "sum over fixes in motion of innovation² over its variance with the 1σ as set, sideways and down",
    "noise.Q": "adapted covariance of an epoch's process noise, units of P",
    "noise.R": "adapted variance of a fix: position [m²], velocity [m²/s²]",
    "noise.settled": "1 where the adapted noise is in force",
    "noise.fixes": "fixes so far (constraints: in motion, those long ago less)",
    "noise.epochs": "epochs since the last fix",
    "forgetting": "share of the past in the adapted noise",
    "gate.usual": "logarithm of the usual normalised innovation squared, by part of a fix (a gate of outliers)",
    "gate.refused": "fixes refused in a row that agree with each other",
    "gate.innovation": "innovation of the last refused ones [m, m/s]",
    "gate.age": "time since the last refused fix [s]",
    "gate.fix": "the last position offered (a gate of outliers), the last refused fix (a coarse gate), in n [m, m/s]",
    "gate.frozen": "1 where fixes stay while the car moves",
    "gate.steady": "time with hardly a refusal, of positions and of velocities [s]",
    "gate.lost": "time since the last that was not refused [s]",
    "gate.moves": "1 where the last refused fix had a velocity",
    "coasting.place": "position of the last fix with a velocity, of a receiver without of the last, north and east [m]",
    "coasting.velocity": "its velocity, or from the fix before to it, north and east [m/s]; NaN: none",
    "coasting.measured": "1 where that fix has a velocity",
    "coasting.age": "time since that fix [s]",
    "coasting.gained": "change of the INS's velocity since the first fix with it, north and east [m/s]",
    "coasting.lead": "velocity of the INS at the end of the last interval less its mean in it, north and east [m/s]",
    "coasting.std": "1σ of that change [m/s]",
    "coasting.found": "1 where position and velocity of the last fix are extrapolated",
    "gate.limits": "greatest normalised innovation squared of each part, where usual ones are as claimed",
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
    "network.fix": "the last fix in n [m, m/s]",
    "network.origin": "position at the start, from which the network's inputs count, in n [m]",
    "estimate.bias": "accelerometer [m/s²] and gyroscope [rad/s] bias that the Kalman filter estimates",
    "estimate.matrix": "scale factors that it estimates, or M of measured = (I + M) true + bias",
    "had_fix": "1 where it had that component",
    "matching.innovations": "innovations² over their variance, remembered short and long",
    "matching.ratios": "corrections² over what P lost by them, likewise",
    "matching.sizes": "corrections² over typical ones, remembered short",
    "matching.fixes": "fixes so far",
    "fix_speed": "forward speed at the last fix [m/s]",
    "outage.drift": "estimates less those of the trajectory without corrections (virtual outage), in the order of P",
    "outage.P": "covariance of that trajectory but for white noise, units of P",
    "outage.white": "what the white noise of accelerometers and gyroscopes adds to it at level 1, units of P",
    "outage.age": "time since the virtual outage began [s]",
    "outage.due": "age from which on the next fix is scored [s]",
    "outage.evidence": "logarithm of the density of the scored fixes by levels of accelerometers and gyroscopes",
    "errors.residual": "the last fix less the filter's position after it [m]",
    "errors.change": "change of a position's error since the fix before, over its 1σ",
    "errors.successive": "fixes in successive epochs",
    "errors.white": "white part of the variance of positions",
    "errors.walk": "variance by which errors of positions move in an epoch, over that of a position",
    "errors.square": "half the mean square change of the error, of the variance of positions: limits its white part",
    "errors.recent": "half the mean square change of the error over the last fixes, of the variance of positions",
    "errors.fixes": "fixes that both count for",
    "errors.slow": "variance of the last position that is not white [m²]",
    "errors.last": "variance of the last position as claimed, horizontal and down [m²]",
    "errors.usual": "the usual one [m²]; inf: none yet",
    "errors.modelled": "variance of the slow errors as states, of that of a usual position",
    "errors.fixed_s": "time since the first fix, or the first one after an outage [s]",
    "fix_noise.apart": "positions of the last three fixes less those of the virtual outage [m], the latest first",
    "fix_noise.residual": "velocity of the last fix less the filter's estimate after it [m/s]",
    "fix_noise.successive": "fixes in successive epochs, by part of a fix",
    "fix_noise.variance": "variance of the noise of fixes over the claimed one (of positions with 0.1 m more), by part",
    "fix_noise.fixes": "fixes that it counts for",
    "fix_noise.largest": "largest such ratio so far, of horizontal positions and velocities",
    "steps.total": "fading sum of corrections over their 1σ: biases of accelerometers and gyroscopes; scale of a wheel",
    "steps.weight": "variance of that sum where the noise is right",
}


def describe_field(name: str) -> str | None:
    """Of a field of the memory; None for one of a filter of a user's own."""
    parts = name.split(".")
    tails = (".".join(parts[k:]) for k in range(len(parts)))
    return next((MEMORY[tail] for tail in tails if tail in MEMORY), None)


def describe_column(name: str) -> str:
    """Of a column of a row.

    ``std_vel_n`` → 1σ of velocity North [m/s], ``innovation_pos_d`` → fix less expected: position Down [m].
    """
    for head, said in (("innovation_std_", "1σ of fix less expected: "), ("innovation_", "fix less expected: ")):
        if name.startswith(head):
            return said + describe_column(name.removeprefix(head))
    if name.startswith("std_"):
        return "1σ of " + describe_column(name.removeprefix("std_"))
    if name in COLUMNS:
        return COLUMNS[name]
    for tail, said in SENSOR.items():
        if name.endswith(tail):
            return said.format(name.removesuffix(tail))
    quantity, _, axis = name.rpartition("_")
    if quantity in COLUMNS and axis in AXES:
        return COLUMNS[quantity].format(AXES[axis])
    return f"{name} as the filter estimates it, in the unit of its sensor"
