"""How long the epochs of ``navigate`` are, and what it keeps of its drives."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from dlkf.base.angles import wrap_angle
from dlkf.data.resampling import usual_rate
from dlkf.data.schema import ACCEL, GYRO, POSITION, STD, VELOCITY, write_drive
from dlkf.filters.build import build_filter
from dlkf.filters.saved import choose_grid
from dlkf.filters.shipped import trained_filter
from dlkf.report.navigation import TrackOnMap, make_rows, route_map, sensor_rows, summary_lines
from dlkf.running.grid import UsableFixes, choose_epoch
from dlkf.running.offline import Innovation, Navigated
from dlkf.running.solution import COLUMNS
from tests.cars import IMU

FIVE_A_SECOND = UsableFixes(*(np.arange(0.0, 10.0, 0.2) for _ in range(4)))


@pytest.mark.parametrize(
    ("name", "epoch_s"),
    [("ins", 0.2), ("mbkf15", 0.2), ("mbkf15_rts", 0.2), ("mbkf21_nhc", 1.0), ("mbkf21_car_gated_rts", 1.0)],
)
def test_epochs_are_as_long_as_fixes_are_apart_but_constraints_keep_a_second(name, epoch_s):
    estimator = build_filter(name, IMU)
    assert choose_epoch([FIVE_A_SECOND], 50.0, estimator) == epoch_s
    assert choose_epoch([FIVE_A_SECOND], 12.0, estimator) == 1.0  # 2.4 samples make no epoch
    for apart, expected in ((2.0, 1.0), (2.5, 3.0), (5.001, 5.0), (10.0, 10.0), (12.0, 1.0), (1.2, 1.0)):
        seldom = UsableFixes(*(np.arange(0.0, 100.0, apart) for _ in range(4)))
        assert choose_epoch([seldom], 50.0, estimator) == expected


def test_a_row_without_a_position_is_no_usable_fix(tmp_path):
    t = np.arange(0.0, 4.0)
    imu = pd.DataFrame({"t": t} | dict.fromkeys((*GYRO, *ACCEL), 0.0))
    gnss = pd.DataFrame({"t": t} | dict.fromkeys((*POSITION, *VELOCITY, *STD), 1.0) | {"quality": 1})
    gnss.loc[1, list(POSITION)] = np.nan
    write_drive(tmp_path, {"drive": "a"}, imu, gnss)
    assert UsableFixes.of(tmp_path, "a").t.tolist() == [0.0, 2.0, 3.0]


def test_a_network_round_a_filter_with_constraints_keeps_its_second():
    plus = trained_filter("plus")
    assert choose_grid([plus]) == {"rate_hz": 50.0, "epoch_s": 1.0}
    assert choose_grid([plus], rates=[9.98, 10.01]) == {"rate_hz": 10.0, "epoch_s": 1.0}
    assert choose_grid([plus], 50.0, rates=[10.0])["rate_hz"] == 50.0
    assert choose_epoch([FIVE_A_SECOND], 50.0, plus) == 1.0


def test_the_grid_of_slow_logs_has_their_own_rate():
    """That of the fastest, in whole samples an update interval; 50 Hz for logs at 40 Hz and more, and for none."""
    assert [usual_rate(x) for x in ([], [100.0], [39.9, 100.0], [40.0])] == [50.0] * 4
    assert [usual_rate(x) for x in ([9.97, 4.0], [25.3], [0.4])] == [10.0, 25.0, 1.0]
    assert usual_rate([9.97], 0.25) == 8.0


def driven(seed: int) -> TrackOnMap:
    """A drive of twenty minutes with a gap, of made-up numbers."""
    draw = np.random.default_rng(seed)
    table = pd.DataFrame({c: draw.uniform(0.1, 1.0, 1200) for c in COLUMNS} | {"gnss_used": True})
    table["t"] = np.arange(1200.0)
    table.loc[300:340, "gnss_used"] = False
    innovation = Innovation(draw.normal(size=(1200, 6)), draw.uniform(0.5, 2.0, (1200, 6)))
    fixes = UsableFixes(table.t.to_numpy(), table.lat_deg.to_numpy(), table.lon_deg.to_numpy(), np.ones(1200))
    return TrackOnMap(Navigated(f"d{seed}", 0.0, table, innovation), fixes)


def with_vibration(course: TrackOnMap, share: float, used: int) -> TrackOnMap:
    """With the columns of speed from vibration, which is trusted in the second half."""
    table = course.result.table.assign(vibration_speed_share=0.02, vibration_speed_used=0.0)
    table.loc[600:, "vibration_speed_share"] = share
    table.loc[600 : 599 + used, "vibration_speed_used"] = 1.0
    return course._replace(result=replace(course.result, table=table))


def test_the_summary_says_in_which_drives_vibration_shows_the_speed():
    a, b = driven(0), driven(1)
    assert not [line for line in summary_lines("mbkf15", [a, b]) if "vibration" in line]
    none = with_vibration(b, 0.05, 0)
    assert summary_lines("plus", [none])[2] == "Speed from vibration: the spectrum of the IMU does not show it."
    said = summary_lines("plus", [with_vibration(a, 0.4, 7), none])[2]
    assert said == "Speed from vibration: the spectrum of the IMU shows it in 1 of 2 drives; 7 measurements used."
    idle = with_vibration(a, 0.4, 0)
    assert summary_lines("plus", [idle])[2].endswith("shows it; 0 measurements used.")  # a has an outage
    fixes = idle.result.table.assign(gnss_used=True)
    idle = idle._replace(result=replace(idle.result, table=fixes))
    assert summary_lines("plus", [idle])[2].endswith("shows it; not needed: no outage.")


def test_the_summary_counts_the_fixes_of_the_file():
    """From a solution that begins late: those before its first row, and all."""
    late = driven(0)
    result = replace(late.result, aligned_at=9.0, table=late.result.table[10:])
    said = result.summary(late.fixes)
    assert "from t = 10.0 s, none for the 10 fixes before, while it aligned, 1190 epochs, 1149 of 1200 fixes" in said


def test_the_summary_says_how_long_a_restart_took():
    result = driven(0).result
    t = result.table.t
    gone = replace(result, table=result.table[(t < 300) | (t > 400)], restarts=(100.0, 300.0, float(t.iloc[-1])))
    assert "started over at t = 100, 300 (no solution until 401), 1199 (no solution after it) s" in gone.summary()
    often = replace(result, restarts=tuple(10.0 * k for k in range(1, 9)))
    assert "started over at t = 10, 20, 30, 40, 50 s and 3 times more" in often.summary()
    page = summary_lines("plus", [TrackOnMap(x, driven(0).fixes) for x in (often, gone, result)])
    assert any("started over 8 times in" in line and "3 times in" in line for line in page)


def test_the_summary_says_where_the_car_goes_in_the_axes_of_its_imu():
    """Of an IMU that is turned about the vertical; not of a course that only scatters, nor of slow rows."""
    result = driven(0).result
    yaw = np.linspace(0, 20, len(result.table))

    def said(angle: float | np.ndarray, speed: float = 12.0) -> str:
        course = yaw + np.radians(angle)
        moving = {"vel_n": speed * np.cos(course), "vel_e": speed * np.sin(course), "yaw": wrap_angle(yaw)}
        return replace(result, table=result.table.assign(**moving)).summary()

    assert "25° to the right of the IMU's x axis (dlkf doctor" in said(25.0)
    assert "12° to the left of the IMU's x axis" in said(-12.0)
    assert "backwards all the way" in said(175.0) and "x axis" not in said(175.0)
    scattered = np.random.default_rng(0).normal(0, 60, len(yaw)) + 15
    for angle, speed in ((8.0, 12.0), (25.0, 3.0), (scattered, 12.0)):
        assert "x axis" not in said(angle, speed)


def test_a_sensor_that_made_no_update_is_said_to_have_made_none_but_vibration_which_needs_none():
    result = with_vibration(driven(0), 0.4, 7).result
    z = np.where(result.table.vibration_speed_used > 0, 0.02, np.nan)
    measured = result.table.assign(vibration_speed_innovation=z, vibration_speed_innovation_std=0.01)
    said = replace(result, table=measured).sensors()["vibration_speed"]
    assert said == "vibration_speed in 7 of 7 updates (normalised innovation RMS 2)"
    unused = measured.assign(vibration_speed_used=0.0)  # no sensor that has a unit or a clock to look at
    assert replace(result, table=unused).sensors() == {
        "vibration_speed": "vibration_speed in 0 of 7 updates (normalised innovation RMS 2)"
    }
    nothing = measured.assign(vibration_speed_innovation=np.nan, vibration_speed_used=0.0)
    assert replace(result, table=nothing).sensors() == {}
    wheel = nothing.assign(speed_innovation=np.nan, speed_innovation_std=np.nan, speed_used=0.0)
    assert replace(result, table=wheel).sensors() == {"speed": "speed: no update"}


def test_the_page_has_a_sensor_only_where_it_made_an_update_and_estimates_with_units():
    idle = with_vibration(driven(0), 0.4, 0).result
    nothing = {"vibration_speed_innovation": np.nan, "vibration_speed_innovation_std": np.nan}
    assert sensor_rows([replace(idle, table=idle.table.assign(**nothing))])[0] == []
    wheel = {"speed_innovation": 0.1, "speed_innovation_std": 0.2, "speed_used": 1.0}
    late = {"fix_delay_s": 0.15, "std_fix_delay_s": 0.01}
    other = driven(1).result
    columns, rows = sensor_rows(
        [replace(idle, table=idle.table.assign(**nothing, **late)), replace(other, table=other.table.assign(**wheel))]
    )
    assert columns == ["Drive", "Delay of fixes\n[ms]", "Wheel speed,\nupdates used", "Wheel speed,\ninnovation / σ"]
    assert rows == [["d0", "150 ± 10", "–", "–"], ["d1", "–", "1200 of 1200", "0.50"]]


def test_of_delay_and_antenna_what_differs_from_the_log_is_said():
    """Beyond 3σ, and beyond what the errors of any model of a car look like."""
    result = driven(0).result
    table = result.table.assign(
        fix_delay_s=0.15, std_fix_delay_s=0.01, lever_forward_m=-0.2, std_lever_forward_m=0.1,
        lever_right_m=0.16, std_lever_right_m=0.04,
        clock_drift_ppm=40.0, std_clock_drift_ppm=20.0, wheel_scale=0.01, std_wheel_scale=0.02,
    )  # fmt: skip
    said = replace(result, table=table).sensors()
    assert said == {"fix_delay_s": "delay of fixes 150 ± 10 ms", "wheel_scale": "wheel scale error 1.0 ± 2.0 %"}


def test_drives_without_plots_of_their_own_are_kept_small_and_shown_the_same():
    whole = [driven(seed) for seed in range(3)]
    small = [course.for_the_map() for course in whole]
    assert make_rows(small) == make_rows(whole) and summary_lines("mbkf15", small) == summary_lines("mbkf15", whole)
    assert "Longest time without a fix: 41 s (d0)." in summary_lines("mbkf15", whole)[1]
    with_all = whole[0]._replace(result=replace(whole[0].result, table=whole[0].result.table.assign(gnss_used=True)))
    assert summary_lines("mbkf15", [with_all])[1].startswith("A fix in every epoch. ")
    assert {row[4] for row in make_rows(whole)[1]} == {"1200"}
    assert route_map(small).to_json() == route_map(whole).to_json()
    assert sum(c.result.table.memory_usage().sum() for c in small) < 80 * 3600
