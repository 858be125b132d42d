# ---
# jupyter:
#   jupytext:
#     formats: py:percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # From your own logs to an answer
#
# Logs as they are → how far the car drifts without GNSS → which filter to run → files for other programs. Every step
# is one function; the frames that go in and out are pandas'.

# %%
from pathlib import Path

import numpy as np
import pandas as pd

import dlkf

# %% [markdown]
# ## Logs
#
# With logs of your own, go on at `read_logs` with their folder. Here a simulated drive plays the part: an IMU in g and
# °/s with milliseconds since power-on, mounted 20° nose down and turned by 90°; a receiver with Unix time, km/h and
# course, and no common clock.

# %%
drive = dlkf.simulate("lifelike", minutes=5, seed=11)[0]
logs = Path("logs/monday")
logs.mkdir(parents=True, exist_ok=True)

pitch, yaw = np.radians([-20, 90])
C_yaw = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
C_pitch = np.array([[np.cos(pitch), 0, np.sin(pitch)], [0, 1, 0], [-np.sin(pitch), 0, np.cos(pitch)]])
mounting = C_yaw @ C_pitch  # sensor → car

box = pd.DataFrame({"millis": (1000 * drive.imu.t).round(1) + 734_000})
box[["acc_x", "acc_y", "acc_z"]] = drive.imu[["accel_x", "accel_y", "accel_z"]] @ mounting / 9.80665
box[["gyr_x", "gyr_y", "gyr_z"]] = np.degrees(drive.imu[["gyro_x", "gyro_y", "gyro_z"]] @ mounting)
box.to_csv(logs / "box.csv", sep=";", index=False, float_format="%.6f")

fixes = drive.gnss
receiver = pd.DataFrame({"time": 1_751_709_600 + fixes.t, "latitude": fixes.lat_deg, "longitude": fixes.lon_deg})
receiver["altitude"] = fixes.height_m
receiver["speed_kmh"] = 3.6 * np.hypot(fixes.vel_n, fixes.vel_e)
receiver["course"] = np.degrees(np.arctan2(fixes.vel_e, fixes.vel_n)) % 360
receiver["hacc"], receiver["fix"] = fixes.std_pos_n, fixes.quality
receiver.to_csv(logs / "receiver.csv", index=False)

print((logs / "box.csv").read_text()[:150])
print((logs / "receiver.csv").read_text()[:190])

# %% [markdown]
# ## Read them
#
# `read_logs` finds columns, units, mounting, clocks and lever arm, and says what it took and what it left. What it is
# not sure of it refuses, with the setting that would help.

# %%
(monday,) = dlkf.read_logs("logs/monday")
for note in monday.notes:
    print("-", note)

# %% [markdown]
# ## Navigate
#
# `plus` needs no noise settings. The summary says how many fixes were used, the filter's own 1σ, and whether the
# innovations fit it (expected: 1).

# %%
arm = [monday.meta.get(f"lever_arm_{axis}_m", 0.0) for axis in "xyz"]
solution = dlkf.navigate(monday.imu, monday.gnss, lever_arm=arm)
print(solution.summary)
solution.plot()

# %% [markdown]
# `solution` alone shows summary, picture and table; `solution.map()` is an interactive map.

# %% [markdown]
# ## How far does the car drift, and which filter should it run?
#
# `evaluate` withholds GNSS for 30 s at a time all along the drive and compares where each filter ends with the same
# drive smoothed with all its fixes. Few outages say little: drive for an hour before you decide.

# %%
report = dlkf.evaluate(monday.imu, monday.gnss, models=["mbkf21_nhc", "mbkf21_car", "plus"], outage_s=30, lever_arm=arm)
print(report.headline)
report.plot()

# %%
print(report.table.round(2).to_string())

# %% [markdown]
# `innovation_per_sigma` far above 1 means that the noise of a Kalman filter is not that of this IMU: its own 1σ
# (`own_sigma_m`) is then smaller than its error. The report says so:

# %%
optimist = dlkf.evaluate(monday.imu, monday.gnss, models="mbkf21_nhc", imu_type="tactical_oxts", lever_arm=arm)
print(*optimist.warnings, sep="\n")

# %% [markdown]
# ## Take it elsewhere
#
# Maps, receivers' formats, ROS, MATLAB (CSV): `formats="all"` or those you name. The date is that of the first second.

# %%
folder = solution.export("monday", ["gpx", "kml", "geojson", "csv"], start_utc="2025-07-05T10:00:00")
for file in sorted(folder.iterdir()):
    print(file.name, f"{file.stat().st_size / 1000:.0f} kB")

# %% [markdown]
# The same on the command line, with a page to look at for each step:
#
# ```
# python -m dlkf.ingest reader=auto source=logs out=data/town
# python -m dlkf.navigate dataset=data/town out=outputs/town export=all
# python -m dlkf.evaluate 'model=[mbkf21_nhc,plus]' dataset=data/town mode=drives reference=smoothed out=outputs/drift
# ```
