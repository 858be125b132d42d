"""A drive without a reference, scored against itself: the same errors as against the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from dlkf.base.errors import InputError
from dlkf.command.composing import compose_command
from dlkf.data.alignment import ALIGN
from dlkf.data.store import load_dataset
from dlkf.evaluation.metrics import magnitudes, outage_end
from dlkf.evaluation.outages import OutagePlan
from dlkf.evaluation.protocol import Protocol, Scenes
from dlkf.evaluation.run import score_scenes
from dlkf.filters.build import build_filter
from dlkf.navigation.imu_errors import imu_spec
from dlkf.running.references import _carry_to_imu, make_reference, median_std
from tests.drives import drives_in


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """Two drives of four minutes, and what a filter is told about their IMU."""
    size = ["dataset.hours=0.133", "dataset.drive_minutes=4", "dataset.imu_rate_hz=50", "seed=3"]
    config = compose_command("simulate", "simulated@dataset=per_drive", *size)
    folder = drives_in(config, tmp_path_factory.mktemp("data") / "town")
    spec = imu_spec(config["imu"])
    return load_dataset(folder, rate_hz=25.0, dtype=torch.float64), build_filter("mbkf21", spec), spec


def ends(drives, spec, seconds: float) -> np.ndarray:
    """Horizontal error [m] at the end of every outage."""
    plan = OutagePlan(first_s=40, duration_s=seconds)
    scores = score_scenes({"mbkf15": build_filter("mbkf15", spec)}, Scenes(drives, Protocol("drives", outage=plan)))
    return outage_end(magnitudes(scores.filters["mbkf15"].error)["horizontal"], scores.windows)


@pytest.mark.whole
@pytest.mark.parametrize("kind", ["smoothed", "gnss"])
def test_errors_are_those_against_the_truth(world, kind):
    """RMS at the end of outages of 30 and 60 s within 5 %: the references are centimetres off, the errors metres."""
    drives, smoother, spec = world
    made = make_reference(drives, kind, smoother, ALIGN)
    assert median_std(made.sigma)[0] < 0.1 and not made.skipped
    for seconds in (30.0, 60.0):
        true, expected = ends(drives, spec, seconds), ends(made.drives, spec, seconds)
        assert len(true) == len(expected) >= 2 and np.sqrt((true**2).mean()) > 1
        assert np.sqrt((expected**2).mean()) == pytest.approx(np.sqrt((true**2).mean()), rel=0.05)


@pytest.mark.parametrize("rate_hz", [25.0, 200.0])
def test_the_antenna_swings_with_the_rate_of_the_last_tenth_of_a_second(world, rate_hz):
    """An antenna 1 m ahead of a car that turns ever faster: ω × l of its mean rate over 0.1 s, whatever the samples."""
    drive, count = world[0][0], int(rate_hz)
    rate = torch.linspace(0.0, 1.0, count + 1, dtype=torch.float64)[1:]  # rad/s at the samples of each second
    imu = torch.zeros(drive.epochs, count, 6, dtype=torch.float64)
    imu[..., 5] = rate
    arm = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    turning = replace(drive, imu=imu, rate_hz=rate_hz, lever_arm_b=arm)
    rows = slice(1, drive.epochs + 1)
    C = torch.eye(3, dtype=torch.float64).expand(drive.epochs, 3, 3)
    _, v, good = _carry_to_imu(turning, rows, C, torch.zeros(drive.epochs, 3, dtype=torch.float64))
    swing = (drive.gnss_v_e[rows] - v)[good & drive.gnss_valid[rows, 3:].all(-1)]
    assert len(swing) > 60
    # to the half sample by which 0.1 s is no whole number of them
    assert (swing[:, 1] - 0.95).abs().max() < 1.0 / rate_hz


def test_the_reference_is_as_good_as_it_says(world):
    """Half of the errors lie within 2.5 times what a 1σ of centimetres gives; tails (turns, the start) are longer."""
    drives, smoother, _ = world
    made = make_reference(drives, "smoothed", smoother, ALIGN)
    off = torch.cat([(m.ref_r_e - d.ref_r_e)[m.ref_valid & d.ref_valid] for m, d in zip(made.drives, drives)])
    middle = float(off.norm(dim=-1).median())
    assert 0.4 < middle / np.hypot(*median_std(made.sigma)) < 2.5 and float(off.norm(dim=-1).max()) < 1.0
    assert all(bool(m.ref_C_eb[m.ref_valid].isfinite().all()) for m in made.drives)


@pytest.mark.parametrize("kind", ["smoothed", "gnss"])
def test_fixes_of_a_frozen_receiver_are_no_reference(world, kind):
    """The last position for half a minute in motion, with a 1σ of centimetres."""
    drives, smoother, _ = world
    speed = drives[0].ref_v_e.norm(dim=-1)
    first = next(k for k in range(80, 200) if bool((speed[k : k + 30] > 3).all()))
    rows, frozen = slice(first + 1, first + 30), {}
    for name in ("gnss_r_e", "gnss_v_e", "gnss_valid"):
        frozen[name] = getattr(drives[0], name).clone()
    frozen["gnss_r_e"][rows] = frozen["gnss_r_e"][first]
    frozen["gnss_valid"][rows, 3:] = False
    made = make_reference([replace(drives[0], **frozen)], kind, smoother, ALIGN).drives[0]
    off = (made.ref_r_e - drives[0].ref_r_e).norm(dim=-1)[made.ref_valid & drives[0].ref_valid]
    assert len(off) > 150 and off.max() < 5.0


def test_no_file_is_needed_and_mistakes_are_told(world):
    drives, smoother, _ = world
    with pytest.raises(InputError, match="reference=best is none of file, smoothed, gnss"):
        make_reference(drives, "best", smoother, ALIGN)
