"""The public functions: pandas frames in, frames out; what the commands run, on a temporary dataset.

Columns and units are those of the dataset contract (`dlkf.data.schema`). ``imu``: t [s], gyro_x|y|z [rad/s],
accel_x|y|z [m/s², specific force], Forward-Right-Down. ``gnss``: t, lat_deg, lon_deg, height_m and, where known,
vel_n|e|d [m/s], std_pos_n|e|d [m], std_vel_n|e|d [m/s], quality (NMEA GGA code). ``reference``: t, lat_deg, lon_deg,
height_m, vel_n|e|d and, where known, roll, pitch, yaw [rad], valid. Other units: `dlkf.frames.logs.read_logs`.
"""

from dlkf.frames.evaluation import Evaluation, evaluate
from dlkf.frames.logs import read_logs, simulate
from dlkf.frames.navigation import Stream, load, navigate
from dlkf.frames.solution import Solution

__all__ = ["Evaluation", "Solution", "Stream", "evaluate", "load", "navigate", "read_logs", "simulate"]
