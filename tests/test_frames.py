"""The public functions do what the commands do: the same solution, the same scores, the same one-line errors."""

from __future__ import annotations

import inspect
import pickle
import re
import subprocess
import sys

import gpxpy
import numpy as np
import pandas as pd
import pytest
import yaml

import dlkf
import dlkf.frames
from dlkf.base.config import config_dir
from dlkf.data.schema import POSITION, STD, VELOCITY


@pytest.fixture(scope="module")
def drive(simulated) -> dict[str, pd.DataFrame]:
    name = pd.read_parquet(simulated / "drives.parquet")["drive"][0]
    return {
        kind: pd.read_parquet(simulated / kind / f"drive={name}" / "part-0.parquet")
        for kind in ("imu", "gnss", "reference")
    } | {"name": name, "folder": simulated}


def test_navigate_gives_the_command_s_solution(drive, call):
    done = call(
        "navigate",
        "model=mbkf21_nhc",
        f"dataset={drive['folder']}",
        "imu=consumer",
        "out=solved",
        "skip_unaligned=true",
    )
    assert done.code == 0, done.err
    expected = pd.read_parquet(f"solved/drive={drive['name']}/solution.parquet").drop(columns="geometry")
    row = pd.read_parquet(drive["folder"] / "drives.parquet").iloc[0]
    arm = row[["lever_arm_x_m", "lever_arm_y_m", "lever_arm_z_m"]].astype(float).tolist()
    solution = dlkf.navigate(drive["imu"], drive["gnss"], model="mbkf21_nhc", imu_type="consumer", lever_arm=arm)
    pd.testing.assert_frame_equal(pd.DataFrame(solution), expected, check_exact=True)
    assert solution.summary.startswith("solution from t = ") and "fixes used" in solution._repr_html_()
    assert len(solution.map().data) and type(solution[solution.t > 10]) is pd.DataFrame


def test_a_prior_is_where_the_filter_begins(drive, call):
    """In a solution, a stream and an evaluation: the calibration of the unit, as the command takes it."""
    prior = {"mean": [0.02, -0.03, 0.01, 1e-3, -1e-3, 5e-4], "std": np.full(6, 1e-4)}
    words = [f"prior.{name}=[{','.join(map(str, values))}]" for name, values in prior.items()]
    dataset = f"dataset={drive['folder']}"
    done = call("navigate", "model=mbkf15_prior", dataset, "out=solved", "skip_unaligned=true", *words)
    assert done.code == 0, done.err
    expected = pd.read_parquet(f"solved/drive={drive['name']}/solution.parquet").drop(columns="geometry")
    row = pd.read_parquet(drive["folder"] / "drives.parquet").iloc[0]
    arm = row[["lever_arm_x_m", "lever_arm_y_m", "lever_arm_z_m"]].astype(float).tolist()
    given = {"imu": drive["imu"], "gnss": drive["gnss"], "lever_arm": arm, "prior": prior}
    with pytest.warns(UserWarning, match="overconfident"):  # this IMU has no such biases
        solution = dlkf.navigate(model="mbkf15_prior", **given)
    pd.testing.assert_frame_equal(pd.DataFrame(solution), expected, check_exact=True)
    assert solution.accel_error_y.iloc[0] == pytest.approx(-0.03, abs=1e-3)
    report = dlkf.evaluate(reference=drive["reference"], models=["mbkf15", "mbkf15_prior"], outage_s=10, **given)
    assert report.table.end_rms_m.nunique() == 2
    assert dlkf.Stream("mbkf15_prior", rate_hz=50, prior=prior)
    done = call("navigate", "model=mbkf15", dataset, "out=none", *words)
    assert done.code == 2 and "a prior has no effect on mbkf15; filters with _prior take one" in done.err


def test_numbers_of_other_types_and_columns_of_other_names(drive):
    """Objects, categories, a quality that is not known in some rows; names that are close are said to be unused."""
    imu, gnss = drive["imu"].astype({"accel_x": object, "gyro_x": "category"}), drive["gnss"]
    odd = gnss.assign(quality=gnss.quality.where(gnss.index % 2 > 0), note=[1, *"a" * (len(gnss) - 1)])
    usual = dlkf.navigate(drive["imu"], gnss, model="ins", rate_hz=10)
    pd.testing.assert_frame_equal(pd.DataFrame(dlkf.navigate(imu, odd, model="ins", rate_hz=10)), pd.DataFrame(usual))
    with pytest.warns(
        UserWarning, match="gnss: columns vn, hacc are not used; a dataset has the names vel_n, std_pos_n"
    ):
        dlkf.navigate(imu, gnss[["t", *POSITION]].assign(vn=gnss.vel_n, hacc=0.1), model="ins", rate_hz=10)
    with pytest.warns(UserWarning, match="plus has its own noise"):
        dlkf.load("plus", tuning="any_car")
    with pytest.warns(UserWarning, match="imu_type has no effect .*model=plus_imu takes biases"):
        dlkf.load("plus", imu_type="consumer")
    assert dlkf.load("plus_imu", imu_type="consumer").imu.gyro.turn_on_bias == 9.69627e-4
    with pytest.warns(UserWarning, match="plus_imu has its own noise: tuning has no effect [^;]*$"):
        dlkf.load("plus_imu", tuning="any_car")


def test_fixes_may_be_positions_alone(drive):
    positions = drive["gnss"][["t", "lat_deg", "lon_deg", "height_m"]]
    solution = dlkf.navigate(drive["imu"], positions, model="mbkf15")
    assert len(solution) > 30 and solution[["lat_deg", "roll", "std_yaw"]].notna().all(axis=None)


def test_evaluate_withholds_what_was_asked_for(drive):
    report = dlkf.evaluate(drive["imu"], drive["gnss"], drive["reference"], models=["ins", "mbkf15"], outage_s=10)
    assert report.headline.startswith("10 s without GNSS, ") and set(report.table.index) == {"ins", "mbkf15"}
    assert (report.outages["length_s"] == 10).all() and len(report.outages) >= 2
    rms = (report.outages["mbkf15"] ** 2).mean() ** 0.5
    assert report.table.loc["mbkf15", "end_rms_m"] == pytest.approx(rms, rel=1e-12)
    assert report.headline in report._repr_html_() and "end_rms_m" in repr(report)


def test_a_sensor_that_a_filter_refuses_is_a_warning(drive):
    """A dual-antenna receiver mounted otherwise, by less than the checks of its table see."""
    reference = drive["reference"].iloc[::10]
    heading = pd.DataFrame({"t": reference["t"], "heading": reference["yaw"] + np.radians(24)})
    with pytest.warns(UserWarning, match=r"heading in \d+ of \d+ updates, most of them refused: see its unit, sign"):
        dlkf.navigate(drive["imu"], drive["gnss"], model="mbkf21_nhc", heading=heading)


def test_further_sensors_are_taken(drive):
    """By a filter that knows a car; another one leaves them."""
    fixes = drive["gnss"]
    wheel = pd.DataFrame({"t": fixes.t, "speed": np.hypot(fixes.vel_n, fixes.vel_e)})
    solution = dlkf.navigate(drive["imu"], fixes, model="mbkf21_nhc", speed=wheel)
    assert solution["speed_used"].sum() > 20 and "wheel scale error" in solution.summary
    with pytest.warns(UserWarning, match="used by no filter here"):
        assert "speed_used" not in dlkf.navigate(drive["imu"], fixes, model="mbkf15", speed=wheel)


def test_a_sensor_that_the_filter_does_not_use_is_named(drive):
    gnss = drive["gnss"]
    speed = pd.DataFrame({"t": gnss.t, "speed": np.hypot(gnss.vel_n, gnss.vel_e)})
    with pytest.warns(UserWarning, match="speed: used by no filter here; mbkf15 takes it"):
        dlkf.navigate(drive["imu"], gnss, speed=speed, model="mbkf15", rate_hz=10)


def test_a_solution_shows_and_writes_itself(drive, tmp_path):
    solution = dlkf.navigate(drive["imu"], drive["gnss"], model="mbkf15")
    assert solution.plot()._repr_png_().startswith(b"\x89PNG") and "data:image/png" in solution._repr_html_()
    place = solution.export(tmp_path / "town", ["gpx", "kml"], start_utc="2025-07-05T12:00:00+02:00")
    points = gpxpy.parse((place / "solution.gpx").read_text()).tracks[0].segments[0].points
    assert points[0].time.isoformat() == f"2025-07-05T10:00:{solution.t.iloc[0]:02.0f}+00:00"
    assert len(points) == len(solution) and "2025-07-05T10:01" in (place / "solution.kml").read_text()
    solution.export(tmp_path / "town", "gpx")
    assert "<time>" not in (place / "solution.gpx").read_text()  # t counts from 0: no date


def test_a_solution_can_be_pickled(drive):
    """With its summary, its track and its fixes."""
    solution = dlkf.navigate(drive["imu"], drive["gnss"], model="ins", rate_hz=10)
    again = pickle.loads(pickle.dumps(solution))
    assert type(again) is dlkf.Solution and again.summary == solution.summary and again.warning is solution.warning
    pd.testing.assert_frame_equal(pd.DataFrame(again), pd.DataFrame(solution), check_exact=True)
    assert again._repr_html_() == solution._repr_html_() and len(again.map().data) == len(solution.map().data)


@pytest.mark.whole
def test_a_filter_that_is_too_sure_of_itself_is_said(drive):
    """A tenth of the preset's noise: one line with the remedy; a filter tuned for any car has none."""
    spec = yaml.safe_load((config_dir() / "imu" / "consumer.yaml").read_text())
    for sensor in ("accel", "gyro"):
        spec[sensor] |= {k: 0.1 * x for k, x in spec[sensor].items() if k != "correlation_time"}
    frames = drive["imu"], drive["gnss"]
    with pytest.warns(UserWarning, match="mbkf21_nhc is overconfident"):  # a script has no page that shows it
        sure = dlkf.navigate(*frames, model="mbkf21_nhc", imu_type=spec)
    assert sure.warning.startswith("mbkf21_nhc is overconfident") and "tuning=any_car" in sure.warning
    assert sure.warning in sure._repr_html_()
    tuned = dlkf.evaluate(*frames, drive["reference"], models="mbkf21_car", tuning="any_car", outage_s=10)
    assert tuned.warnings == [] and tuned.table.loc["mbkf21_car", "own_sigma_m"] > 0
    optimist = dlkf.evaluate(*frames, drive["reference"], models=["mbkf21_nhc", "ins"], imu_type=spec, outage_s=10)
    (line,) = optimist.warnings
    assert line in repr(optimist) and optimist.table.loc["mbkf21_nhc", "innovation_per_sigma"] > 1.5
    assert optimist.plot()._repr_png_().startswith(b"\x89PNG") and np.isnan(optimist.table.loc["ins", "own_sigma_m"])


def test_logs_are_read_by_a_preset_that_builds_on_another(tmp_path):
    """reader=ubx is csv's settings with its own."""
    with pytest.raises(dlkf.InputError, match="no file"):
        dlkf.read_logs(tmp_path, "ubx")


def test_logs_are_read_by_a_file_of_one_s_own(drive, tmp_path):
    """As ``--config-dir`` does: only what differs from the preset that it builds on."""
    imu, gnss = drive["imu"].copy(), drive["gnss"]
    accel = [f"accel_{a}" for a in "xyz"]
    imu[accel] /= 9.80665
    (tmp_path / "logs").mkdir()
    imu.rename(columns={"t": "seconds"}).to_csv(tmp_path / "logs" / "imu.csv", index=False)
    gnss.to_csv(tmp_path / "logs" / "gnss.csv", index=False)
    own = tmp_path / "shed, 1.yaml"
    own.write_text(
        "defaults: [csv, _self_]\ntime_zero: keep\nlever_arm_m: [0.5, 0.0, -1.2]\n"
        "imu: {time: {column: seconds}, accel: {unit: g}}\n"
    )
    (read,) = dlkf.read_logs(tmp_path / "logs", own)
    assert np.allclose(read.imu[accel], drive["imu"][accel], atol=1e-9) and read.meta["lever_arm_z_m"] == -1.2
    (other,) = dlkf.read_logs(tmp_path / "logs", str(own), "reader.lever_arm_m=[0,0,0]")
    assert other.meta["lever_arm_z_m"] == 0.0
    for text, says in (
        ("defaults: [csw, _self_]\n", "unknown preset or config 'reader/csw'"),
        ("defaults: [csv, _self_]\nimu: {accel: {unitt: g}}\n", "unitt"),
        ("imu: [\n", "shed, 1.yaml"),
        ("7\n", "shed, 1.yaml"),
    ):
        own.write_text(text)
        with pytest.raises(dlkf.InputError, match=says) as error:
            dlkf.read_logs(tmp_path / "logs", own)
        assert "\n" not in str(error.value)
    with pytest.raises(dlkf.InputError, match="no such file"):
        dlkf.read_logs(tmp_path / "logs", tmp_path / "none.yaml")


WARNED = """
import warnings, dlkf
with warnings.catch_warnings(record=True) as said:
    warnings.simplefilter("always")
    dlkf.Stream("plus", rate_hz=10)
    dlkf.Stream("plus", tuning="any_car")
    stream = dlkf.Stream("plus")
    for k in range(100):
        stream.imu(k / 10, (0.1 * (k % 2), 0.0, -9.8), (0.0, 0.0, 0.0))
        if k % 10 == 0:
            stream.gnss(k / 10, 48.0, 11.0, 500.0)
print([(w.category.__name__, w.filename, w.lineno) for w in said])
"""


@pytest.mark.whole
def test_warnings_name_the_line_of_the_caller():
    """A stream's too, whether the rate is known from the start or seen in its samples. In a process of its own: here
    the checks of shapes are calls in between."""
    out = subprocess.run([sys.executable, "-c", WARNED], capture_output=True, text=True, check=True).stdout
    low, user = "LowSampleRateWarning", "UserWarning"
    assert eval(out) == [(low, "<string>", 5), (user, "<string>", 6), (low, "<string>", 9)]


def test_numbers_as_text_are_refused_by_a_stream():
    stream = dlkf.Stream("plus", aids="speed")
    for receipt in (
        stream.gnss("0", 48.0, 11.0, 500.0),
        stream.gnss(0.0, "48", 11.0, 500.0),
        stream.gnss(0.0, 48.0, 11.0, 500.0, ("1", "0", "0")),
        stream.imu("0", (0.0, 0.0, -9.8), (0.0, 0.0, 0.0)),
        stream.imu(0.0, (0.0, 0.0, b"-9.8"), (0.0, 0.0, 0.0)),
        stream.speed("1", 5.0),
        stream.speed(1.0, "5"),
    ):
        assert receipt.status == "refused" and "number" in receipt.reason
    assert stream.gnss(0.0, 48, np.float32(11), 500.0).status == "taken"


def test_a_stream_navigates(drive):
    stream = dlkf.Stream("mbkf15", rate_hz=50, imu_type="consumer")
    accel, gyro = (drive["imu"][[f"{s}_{a}" for a in "xyz"]].to_numpy() for s in ("accel", "gyro"))
    fixes = iter(drive["gnss"].to_dict("records"))
    fix = next(fixes)
    for t, a, w in zip(drive["imu"]["t"], accel, gyro):
        stream.imu(t, a, w)
        while fix is not None and fix["t"] <= t:
            stream.gnss(fix["t"], *(fix[c] for c in POSITION), [fix[c] for c in VELOCITY], [fix[c] for c in STD])
            fix = next(fixes, None)
    assert stream.latest is not None and stream.latest.t > drive["imu"]["t"].iloc[-1] - 2


def test_a_stream_takes_the_sensors_that_are_named():
    stream = dlkf.Stream("plus", aids=["speed"])
    assert stream.speed(1.0, 5.0).status == "taken" and stream.heading(1.0, 0.5).status == "refused"
    with pytest.raises(dlkf.InputError, match="model=mbkf15 has no vehicle constraints and takes no speed"):
        dlkf.Stream("mbkf15", aids=["speed"])
    with pytest.raises(dlkf.InputError, match="unknown 'sped'; did you mean speed"):
        dlkf.Stream("plus", aids=["sped"])
    with pytest.raises(dlkf.InputError, match="leaves out speed, which model="):
        dlkf.Stream("mbkf21_car+speed", aids=["heading"])


WRONG = {
    "no frame": (lambda d: (d["imu"].to_numpy(), d["gnss"]), {}, "imu is a ndarray, must be a pandas DataFrame"),
    "a column": (lambda d: (d["imu"].drop(columns="gyro_x"), d["gnss"]), {}, "column gyro_x missing"),
    "no model": (lambda d: (d["imu"], d["gnss"]), {"model": "mbkf16"}, "unknown model 'mbkf16'"),
    "no preset": (lambda d: (d["imu"], d["gnss"]), {"imu_type": "consumr"}, "preset 'consumr'; did you mean consumer?"),
    "lever arm": (lambda d: (d["imu"], d["gnss"]), {"lever_arm": (1, 2)}, "lever_arm is (1, 2), must be three numbers"),
    "no fix": (lambda d: (d["imu"], d["gnss"].iloc[:0]), {}, "gnss has no rows"),
}


@pytest.mark.parametrize("case", WRONG)
def test_mistakes_are_one_line(drive, case):
    frames, options, message = WRONG[case]
    with pytest.raises(dlkf.InputError) as error:
        dlkf.navigate(*frames(drive), **({"model": "mbkf15"} | options))
    assert message in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["navigate", "evaluate", "Stream", "load", "simulate", "read_logs"])
def test_docstrings_name_every_parameter_with_its_type(name):
    """As numpydoc has them: a type or choice for each, what is returned, and the errors."""
    function = getattr(dlkf.frames, name)
    text = inspect.getdoc(function)
    described = re.findall(
        r"^(\*?[\w, *]+)( : .+)?$", text.partition("Parameters\n")[2].partition("\nReturns")[0], re.M
    )
    names = [one.strip(" *") for said, kind in described if kind or said.startswith("*") for one in said.split(",")]
    assert names == [p for p in inspect.signature(function).parameters]
    assert "Returns\n-------\n" in text and "Raises\n------\nInputError\n    " in text


def test_importing_dlkf_imports_little():
    code = (
        "import sys, dlkf; print([m for m in ('torch', 'pandas', 'numpy', 'mlflow') if m in sys.modules], dlkf.__all__)"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out.startswith("[] ") and "navigate" in out


def test_a_command_s_module_is_the_function_too(drive):
    import dlkf.navigate as module

    assert module.main is not None
    with pytest.raises(dlkf.InputError, match="must be a pandas DataFrame"):
        dlkf.navigate(1, 2)
