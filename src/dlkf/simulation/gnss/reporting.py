"""How a receiver reports fixes: delayed, with a scaled std, and with gaps."""

from __future__ import annotations

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from dlkf.data.schema import STD
from dlkf.simulation.gnss.white import GnssConfig, antenna_states, episodes, shift_positions
from dlkf.simulation.motion.vehicle import Truth

Array = NDArray[np.floating]


def delay_fixes(
    truth: Truth, rate_b: Array, rows: NDArray[np.int64], config: GnssConfig, rate_hz: float
) -> tuple[Truth, Array]:
    """The truth of which the fixes stamped with the times of ``rows`` are made, and the body's rate there (N, 3).

    Position and velocity of the antenna are those of ``position_lag_s`` and ``velocity_lag_s`` before, to the nearest
    sample; the time is the stamp. Where they differ, the body is moved so that its antenna is where it was.
    """
    earlier = [np.maximum(rows - round(lag * rate_hz), 0) for lag in (config.position_lag_s, config.velocity_lag_s)]
    place, moving = (Truth(*(getattr(truth, name)[k] for name in Truth.__dataclass_fields__)) for k in earlier)
    swing = rate_b[earlier[1]]
    if config.position_lag_s == config.velocity_lag_s:
        where = place.lat, place.lon, place.height
    else:
        arms = [antenna_states(x, rate_b[k], config.lever_arm_b)[0] for x, k in zip((place, moving), earlier)]
        where = shift_positions(place, arms[0] - arms[1])
    return Truth(truth.t[rows], *where, moving.v_n, moving.rpy), swing


def report_fixes(rng: np.random.Generator, fixes: pd.DataFrame, config: GnssConfig) -> pd.DataFrame:
    """The fixes with stds of ``std_factor`` times what they are, and gaps of ``dropout_s`` on average (exponential)
    that make ``dropout_share`` of the time."""
    if config.std_factor != 1:
        fixes = fixes.assign(**{name: config.std_factor * fixes[name] for name in STD})
    if config.dropout_share > 0:
        lost = episodes(rng, fixes.t.to_numpy(), config.dropout_share, config.dropout_s)
        fixes = fixes.loc[~lost].reset_index(drop=True)
    return fixes
