"""Allan deviation against allantools, and presets recovered from simulated logs at rest."""

from __future__ import annotations

import math
from pathlib import Path

import allantools
import numpy as np
import pandas as pd
import pytest
import yaml

from dlkf.base.config import config_dir
from dlkf.base.errors import InputError
from dlkf.data.schema import ACCEL, GYRO, new_dataset, write_drive, write_drives_table
from dlkf.diagnosis.allan import allan_variance, analyse, cluster_sizes, fit_noise, noise_preset, preset_yaml
from dlkf.navigation.imu_errors import ImuSpec, SensorErrors, imu_spec
from dlkf.simulation.imu import corrupt, draw_unit

RATE = 10  # Hz: densities do not depend on it


def spec_of(name: str) -> ImuSpec:
    return imu_spec(yaml.safe_load((config_dir() / "imu" / f"{name}.yaml").read_text()))


def at_rest(spec: ImuSpec, hours: float, seed: int = 0) -> np.ndarray:
    """Samples (N, 6) of a level unit of the preset's kind at 10 Hz."""
    rng = np.random.default_rng(seed)
    still = np.tile((0.0, 0.0, -9.81, 4e-5, 0.0, -6e-5), (round(hours * 3600 * RATE), 1))
    return corrupt(rng, still, spec, draw_unit(rng, spec), RATE)[0]


def test_it_is_the_overlapping_allan_deviation_of_allantools():
    rng = np.random.default_rng(1)
    x = rng.standard_normal(5000) + np.cumsum(rng.standard_normal(5000)) / 30
    sizes = cluster_sizes(len(x))
    theirs = allantools.oadev(x, rate=RATE, data_type="freq", taus=sizes / RATE)
    np.testing.assert_allclose(theirs[0], sizes / RATE)
    np.testing.assert_allclose(np.sqrt(allan_variance(x, 1 / RATE, sizes)), theirs[1], rtol=1e-9)


@pytest.mark.parametrize("name", ["consumer", "icm20602_i2nav"])
def test_a_preset_is_recovered_from_six_hours_at_rest(name):
    """The white noise has 6·10⁵ samples, 0.3 % at 3σ; the walk some hundred clusters in three axes, 10 %."""
    put_in = spec_of(name)
    base = spec_of("automotive_mems")
    log = analyse("bench", at_rest(put_in, 6.0), RATE, base)
    found = noise_preset("bench", (log.fits["accel"], log.fits["gyro"]), base, "a test")
    for a, b in ((found.accel, put_in.accel), (found.gyro, put_in.gyro)):
        assert a.noise_density == pytest.approx(b.noise_density, rel=0.01)
        assert math.sqrt(a.walk_psd) == pytest.approx(math.sqrt(b.walk_psd), rel=0.10)
    assert found.accel.turn_on_bias == base.accel.turn_on_bias  # rest does not tell it
    assert imu_spec(yaml.safe_load(preset_yaml(found))) == found


def test_a_correlation_time_that_the_log_resolves_is_its_own():
    short = SensorErrors(noise_density=1e-3, instability=1e-3, correlation_time=60.0)
    log = analyse("bench", at_rest(ImuSpec("short", short, short), 6.0), RATE, spec_of("consumer"))
    fit = log.fits["gyro"]
    assert fit.resolved
    assert fit.time == pytest.approx(60.0, rel=0.2)  # 360 correlation times in three axes: 6 % of 1σ
    assert fit.sigma == pytest.approx(1e-3, rel=0.1)


def test_the_fit_returns_the_model_it_is_given():
    tau = np.geomspace(0.1, 2000, 60)
    x = tau / 50.0
    bias = 2 / x * (1 - (3 - 4 * np.exp(-x) + np.exp(-2 * x)) / (2 * x))
    fit = fit_noise(tau, 9.0 / tau + 4.0 * bias + 3 * 0.01 / tau**2, 20_000.0, 3600.0)
    # T lies on a grid of 1.3 steps, which the other two follow
    assert (fit.density, fit.sigma, fit.time) == pytest.approx((3.0, 2.0, 50.0), rel=0.15)
    np.testing.assert_allclose(fit.curve(tau) ** 2, 9.0 / tau + 4.0 * bias + 0.03 / tau**2, rtol=0.05)


def test_a_log_that_moves_is_refused():
    imu = at_rest(spec_of("consumer"), 0.2)
    imu[3000:3050, 0] += 1.5
    with pytest.raises(InputError, match=r"drive car: is not static: 5 of its 720 seconds .* the first 300 s"):
        analyse("car", imu, RATE, spec_of("consumer"))


def test_a_log_that_is_too_short_is_refused():
    base = spec_of("consumer")
    with pytest.raises(InputError, match="90 s are too short for the noise density"):
        analyse("bench", at_rest(base, 0.025), RATE, base)
    log = analyse("bench", at_rest(base, 0.1), RATE, base)
    fits = (log.fits["accel"], log.fits["gyro"])
    with pytest.raises(InputError, match="too short for the in-run bias of the accelerometers"):
        noise_preset("bench", fits, base, "")
    kept = noise_preset("bench", fits, spec_of("bmi270"), "", in_run="keep")
    assert kept.gyro.instability == spec_of("bmi270").gyro.instability
    assert kept.gyro.noise_density == pytest.approx(base.gyro.noise_density, rel=0.1)


def test_the_command_writes_a_preset_that_a_filter_takes(tmp_path, call, town):
    imu = at_rest(spec_of("icm20602_i2nav"), 1.0)
    t = np.arange(1, len(imu) + 1) / RATE
    gnss = {"t": t[-1:], "quality": np.array([0])} | {
        name: np.array([np.nan])
        for name in ("lat_deg", "lon_deg", "height_m", *(f"vel_{a}" for a in "ned"))
        + tuple(f"std_{k}_{a}" for k in ("pos", "vel") for a in "ned")
    }
    with new_dataset("bench") as folder:
        columns = dict(zip((*ACCEL, *GYRO), imu.T))
        row = write_drive(folder, {"drive": "desk"}, pd.DataFrame({"t": t} | columns), pd.DataFrame(gnss))
        write_drives_table(folder, [row])
    done = call("allan", "dataset=bench", "name=mine", "out=found", "imu=consumer")
    assert done.code == 0, done.err
    assert "Gyroscopes, all axes" in done.out
    made = {p.relative_to("found").as_posix() for p in Path("found").rglob("*") if p.is_file()}
    assert made == {"imu/mine.yaml", "allan.png", "allan.html", "allan.md", "allan.csv", "allan.json"}
    done = call("navigate", "--config-dir", "found", "imu=mine", "model=mbkf15", f"dataset={town}", "out=solved")
    assert done.code == 0, done.err
    done = call("allan", f"dataset={town}", "out=moving", "drive=town-3-00000")
    assert done.code == 2 and "drive town-3-00000" in done.err and not Path("moving").exists()
