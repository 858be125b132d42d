"""Sensors of a car beside IMU and GNSS, as sources of a Kalman filter: wheel speed, heading, barometer."""
