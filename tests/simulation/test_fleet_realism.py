"""The study of the fleet among real drives: levels of known tones, delays put in, what is inside."""

import numpy as np
import pandas as pd
import pytest
from pipelines.studies import fleet_realism as study
from tests.drives import tables_in_memory

from dlkf.command.simulated import composed_recipe
from dlkf.data.schema import ACCEL, GYRO
from dlkf.simulation.dataset import simulate


def test_a_tone_has_its_level_in_its_band_and_nowhere_else():
    """RMS a/√2 within the Hann window's leakage; gravity and a slow turn leave nothing above 1 Hz."""
    t = np.arange(1, 3001) / 100
    imu = {"t": t, **dict.fromkeys((*ACCEL, *GYRO), np.zeros(3000))}
    imu |= {"accel_z": -9.8 + 0.3 * np.sin(2 * np.pi * 9 * t), "gyro_x": 0.01 * t}
    middle, level, peaked = study.band_levels(imu)
    assert len(middle) == 30 and level.shape == (30, 6, len(study.BANDS))
    assert level[:, 2, 2] == pytest.approx(0.3 / np.sqrt(2), rel=0.01)
    assert np.delete(level[:, 2], 2, axis=1).max() < 0.02 and level[:, 3].max() < 1e-6
    assert peaked[:, 2] == pytest.approx(1.5, abs=0.02)  # of a sine


@pytest.mark.parametrize("lag", [0.0, 0.3])
def test_the_delay_of_the_velocity_is_seen(lag):
    """Within 0.1 s, though an updating filter takes part of it for its own error."""
    late = f"+dataset.gnss.velocity_lag_s={lag}"
    made_by = composed_recipe("simulated@dataset=per_drive", late, "imu=consumer", "seed=3")
    found = study.of_innovations(tables_in_memory(made_by, 0, 200))
    assert found["velocity's delay by its innovations [s]"] == pytest.approx(lag, abs=0.1)


def test_what_lies_inside(tmp_path):
    """A fleet among itself: every number that drives share is its own median, and a stranger's is outside."""
    wide = composed_recipe("simulated@dataset=wide", "dataset.hours=0.05", "dataset.drive_minutes=1", "seed=4")
    fleet = study.numbers(simulate(wide, tmp_path / "wide", progress=False, workers=1))
    assert len(fleet) == 3
    table = study.compared(fleet, {"same": fleet, "stranger": 1e3 * fleet.abs() + 1e3})
    assert study.is_inside(table, "same").dropna().mean() > 0.5
    assert not study.is_inside(table, "stranger").dropna().any()
    text = study.markdown(table, ["same", "stranger"])
    assert f"stranger: 0 of {fleet.notna().any().sum()} numbers inside" in text
    study.draw(tmp_path / "fleet.png", table, ["same", "stranger"])
    assert (tmp_path / "fleet.png").stat().st_size > 10_000
    assert isinstance(table, pd.DataFrame)
