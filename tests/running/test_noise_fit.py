"""Noise found from fixes alone: it is that which the drives have, whatever the search was told at the start."""

from __future__ import annotations

import math
import shutil
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
import torch
import yaml

from dlkf.base.errors import InputError
from dlkf.data.aid_tables import STANDARD
from dlkf.data.alignment import ALIGN
from dlkf.data.segments import whole_drives
from dlkf.data.store import load_dataset
from dlkf.filters.aids.attach import find_tables
from dlkf.filters.tuning import Tuning
from dlkf.navigation.imu_errors import imu_spec
from dlkf.onboard.compiled_filter import compile_or_keep
from dlkf.running import noise_fit
from dlkf.running.noise_fit import Evidence, FixOffset, NoiseFit, find_noise, generic_filter, search_fix_offset
from dlkf.running.start import align
from tests.cars import IMU, car_batch, write_segments


@pytest.fixture(scope="module")
def long_town(tmp_path_factory) -> Path:
    """Three drives of 150 s whose IMU is that of tests.cars."""
    return write_segments(tmp_path_factory.mktemp("data") / "long", car_batch(3, 150))


@pytest.fixture(scope="module")
def drives(long_town):
    return load_dataset(long_town, rate_hz=20, epoch_s=1.0, dtype=torch.float64, reference=False)


def known_noise(factor: float):
    """The IMU with white noise told so many times too large."""
    accel, gyro = (replace(s, noise_density=factor * s.noise_density) for s in (IMU.accel, IMU.gyro))
    return replace(IMU, accel=accel, gyro=gyro)


def evidence_in_c(drives) -> Evidence:
    """Its trials are those in torch, as a test below shows, and take a tenth of the time."""
    return replace(Evidence.of(drives), compiler=compile_or_keep)


def test_the_density_is_that_of_student(drives):
    z, S = torch.tensor([[0.3, -1.0]]).double(), torch.tensor([[[2.0, 0.3], [0.3, 0.5]]]).double()
    t = torch.distributions.StudentT(noise_fit.FREEDOM)
    one = noise_fit._density(z[:, :1], S[:, :1, :1], torch.tensor([1]))
    scaled = -t.log_prob(z[:, 0] / S[:, 0, 0].sqrt()) + 0.5 * S[:, 0, 0].log()
    zero = noise_fit._density(torch.zeros(1, 1).double(), torch.ones(1, 1, 1).double(), torch.tensor([1]))
    assert one - zero == pytest.approx(float(scaled + t.log_prob(torch.tensor(0.0))))
    assert noise_fit._density(z, S, torch.tensor([2])).shape == (1,)


def test_gaps_are_withheld_and_scored(drives):
    evidence = Evidence.of(drives)
    B = len(drives) * (1 + len(noise_fit.GAPS_S))
    assert evidence.batch.size[0] == B
    whole = evidence.batch.available[:: 1 + len(noise_fit.GAPS_S)]
    assert whole.all() and not evidence.batch.available[1].all()
    assert not evidence.offered[:, : int(noise_fit.SETTLE_S)].any()
    start = whole_drives([drives[0]], [align(drives[0])])
    assert torch.equal(evidence.batch.imu[0, : start.size[1]], start.imu[0])


@pytest.mark.commands
def test_noise_that_is_told_wrong_is_found(drives):
    found = find_noise(evidence_in_c(drives), "mbkf15", known_noise(0.05), Tuning(), delay=False)
    assert found.after < found.before - 1
    for sensor, ratio in (("accel", 1.6), ("gyro", 0.8)):  # within 0.8 to 1.6 with three seeds; one drive 0.15 to 3.2
        density = getattr(found.imu, sensor).noise_density / getattr(IMU, sensor).noise_density
        assert density == pytest.approx(ratio, rel=0.01)  # the search goes in factors: the same, or another
    assert found.tuning.position_std == 1


@pytest.mark.parametrize("name", ["mbkf15", "mbkf21_car"])
def test_trials_in_c_are_those_in_torch(name, drives):
    """Used and withheld fixes alike; 1e-6 of densities around 10 is rounding."""
    evidence = Evidence.of([d.part(0, 100) for d in drives])
    a, b = (
        replace(evidence, compiler=c).shares(name, known_noise(2.0), Tuning(), FixOffset(0.02))
        for c in (None, compile_or_keep)
    )
    assert (a != 0).any() and (a - b).abs().max() * evidence.fixes < 1e-6


def test_fixes_that_are_late_are_found_out(drives):
    d = drives[0]  # every fix tells where the car was, and how fast, 0.2 s before its stamp
    pull = torch.gradient(d.gnss_v_e, dim=0)[0]
    was = replace(d, gnss_r_e=d.gnss_r_e - 0.2 * d.gnss_v_e + 0.02 * pull, gnss_v_e=d.gnss_v_e - 0.2 * pull)
    evidence = evidence_in_c([was])
    at = {
        late: evidence.negative_log_likelihood("mbkf15", IMU, Tuning(), FixOffset(late))
        for late in (0.0, 0.1, 0.2, 0.3)
    }
    assert min(at, key=at.get) == 0.2


@pytest.fixture
def coarse(monkeypatch):
    """A search in one step size, for what comes behind it."""
    monkeypatch.setattr(noise_fit, "STEPS", (4.0,))


@pytest.mark.parametrize(("delay_s", "arm_m", "near"), [
    (0.0, 0.0, (0.04, 0.0)), (0.05, 0.0, (0.08, 0.0)), (0.0, 0.5, (0.04, 0.0)),
])  # fmt: skip
@pytest.mark.whole
def test_a_delay_is_told_from_a_wrong_lever_arm(long_town, tmp_path, delay_s, arm_m, near):
    """The IMU's clock runs ``delay_s`` behind, so fixes come late by as much; the arm is told ``arm_m`` too long.

    From where a search in steps of 0.08 s might have ended; 0.04 s is what 0.5 m look like at 12 m/s.
    """
    shutil.copytree(long_town, tmp_path / "town")
    for path in (tmp_path / "town").glob("imu/*/*.parquet"):
        table = pd.read_parquet(path, partitioning=None)
        table.assign(t=table["t"] - delay_s).to_parquet(path, index=False)
    drives = load_dataset(tmp_path / "town", rate_hz=20, epoch_s=1.0, dtype=torch.float64, reference=False)
    arm = torch.tensor([arm_m, 0.0, 0.0])
    known_noise = [replace(d, lever_arm_b=d.lever_arm_b + arm).part(0, 110) for d in drives]
    placing, std = search_fix_offset(evidence_in_c(known_noise), "mbkf15", IMU, Tuning(), FixOffset(*near))
    assert std.delay_s < 0.01 and std.ahead_m < 0.2  # 2 to 5 ms and 5 to 15 cm: five minutes of cm fixes
    assert placing.delay_s == (pytest.approx(delay_s, abs=4 * std.delay_s) if delay_s else 0.0)
    assert placing.ahead_m == (pytest.approx(-arm_m, abs=4 * std.ahead_m) if arm_m else 0.0)
    said = NoiseFit(IMU, Tuning(), placing, std, 0.0, 0.0).describe_offset()
    assert ("not significantly late" in said) == (not delay_s) and ("further back" in said) == bool(arm_m)


def test_what_no_car_does_is_told():
    fit = NoiseFit(IMU, Tuning(lateral_std=0.3), FixOffset(), FixOffset(0.01, 0.1), 0.0, 0.0)
    assert not fit.describe_doubt() and "± 0.010 s" in fit.describe_offset()
    wrong = fit._replace(tuning=Tuning(lateral_std=19.0, vertical_std=32.0), placing_std=FixOffset(math.inf, 0.1))
    assert "vertical_std 32 m/s" in wrong.describe_doubt() and "inf" not in wrong.describe_offset()


def test_the_command_writes_what_the_others_take(uri, call, long_town, coarse):
    one = (f"dataset={long_town}", "drives=[car-00]", "rate_hz=20")
    done = call("tune", "objective=likelihood", "model=mbkf15", *one, "imu=consumer", "name=ours", "out=found")
    assert done.code == 0, done.err
    preset = yaml.safe_load(Path("found/imu/ours.yaml").read_text())
    assert imu_spec(preset).name == "ours" and Path("found/tuning/ours.yaml").is_file()
    done = call("navigate", "--config-dir", "found", "model=mbkf15", *one, "imu=ours", "tuning=ours", "out=solved")
    assert done.code == 0, done.err


@pytest.mark.whole
def test_navigate_finds_the_noise_by_itself(call, long_town, coarse):
    one = (f"dataset={long_town}", "drives=[car-00]", "rate_hz=20", "out=solved")
    done = call("navigate", "model=mbkf15", "imu=auto", *one)
    assert done.code == 0 and "found, SI units: accel.noise_density" in done.out, done.err
    assert Path("solved/drive=car-00/solution.parquet").is_file()


@pytest.mark.parametrize("words,says", [
    (("navigate", "model=plus", "imu=auto", "out=a"), "model=plus has no such noise"),
    (("navigate", "model=mbkf15", "imu=auto", "streaming=true", "out=a"), "looks ahead"),
    (("evaluate", "model=mbkf15", "imu=auto", "out=a"), "only navigate finds the noise"),
])  # fmt: skip
def test_where_noise_cannot_be_found(call, long_town, words, says):
    done = call(*words, f"dataset={long_town}")
    assert done.code == 2 and says in done.err


def test_drives_that_say_nothing_are_refused(drives):
    short = [d.part(0, 15) for d in drives]
    with pytest.raises(InputError, match="cannot estimate the noise"):
        find_noise(Evidence.of(short), "mbkf15", IMU, Tuning())


def test_noise_is_found_with_the_sensors_that_a_drive_has(drives, monkeypatch):
    names = []

    def found(evidence, name, imu, tuning):
        names.append(name)
        return NoiseFit(imu, tuning, FixOffset(), FixOffset(), 0.0, 0.0)

    monkeypatch.setattr(noise_fit, "find_noise", found)
    for name, tables in (("mbkf21_car", ["speed"]), ("mbkf21_car", []), ("mbkf15", ["speed"])):
        estimator, _, _ = generic_filter(drives, name, IMU, Tuning(), ALIGN, [STANDARD[t] for t in tables])
        assert [t.name for t in find_tables(estimator)] == (tables if "car" in name else [])
    assert names == ["mbkf21_car+speed", "mbkf21_car", "mbkf15"]
