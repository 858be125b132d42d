"""Errors after longer GNSS and over long segments are those of the same scores, taken at the right times."""

import math

import numpy as np
import pytest
import torch

from dlkf.base.errors import InputError
from dlkf.data.datamodule import DriveDataModule
from dlkf.data.segments import StartLaw
from dlkf.data.store import load_dataset
from dlkf.evaluation import endurance, protocol
from dlkf.evaluation.endurance import (
    after_tables,
    hour_table,
    scenes_after_gnss,
    score_after_gnss,
    score_without_outage,
)
from dlkf.evaluation.protocol import Protocol, Scenes
from dlkf.evaluation.run import score_scenes
from dlkf.filters.build import build_filter
from tests.cars import IMU

FILTERS = {name: build_filter(name, IMU) for name in ("ins", "mbkf15")}


def test_parts_of_an_hour_hold_their_own_epochs(town, monkeypatch):
    """An hour of 50 s here: RMS over the epochs of each part, written out; the start's 2° of heading fade with GNSS."""
    drives, start = load_dataset(town, rate_hz=20, dtype=torch.float64), StartLaw()
    with pytest.raises(InputError, match="no drive has 60 min"):
        score_without_outage(FILTERS, drives, start, seed=1)
    monkeypatch.setattr(endurance, "HOUR_S", 50.0)
    monkeypatch.setattr(endurance, "MINUTES", ((0, 0.5), (0.5, 1), (1, 2)))
    found = score_without_outage(FILTERS, drives, start, seed=1)
    assert list(found["mbkf15"]) == [
        f"{q}_{part}_min" for part in ("0_0.5", "0.5_1") for q in ("heading_deg", "position_m")
    ]
    scores = score_scenes(FILTERS, Scenes(drives, Protocol("segments", 50.0, 50.0, start, seed=1)))
    position = np.linalg.norm(scores.filters["mbkf15"].error[:, 30:, :3], axis=-1)
    assert found["mbkf15"]["position_m_0.5_1_min"] == pytest.approx(math.sqrt(np.mean(position**2)))
    assert found["mbkf15"]["heading_deg_0.5_1_min"] < 0.8 * found["mbkf15"]["heading_deg_0_0.5_min"]
    assert len(hour_table("town", found).rows) == 2


def test_long_segments_cover_the_drives_of_a_side_without_an_outage(town, monkeypatch):
    """Drives of a minute: segments as long as they have room for, not of the 20 s that are scored."""
    monkeypatch.setattr(protocol, "STEP_S", 10)
    data = DriveDataModule(town, split={"train": ["g0"], "val": ["g1"], "test": ["g2"]}, eval_length_s=20.0, rate_hz=20)
    data.setup()
    (batch,) = Scenes.of_long_segments(data, "train", 0).withhold()
    assert batch.size[1] in (50, 60) and bool(batch.available.all())
    assert set(batch.drive) == {d.name for d in data.drives("train")}
    assert batch.size[0] * batch.size[1] >= 0.8 * 20 * len(data.segments("train"))


def test_a_filter_is_better_after_more_gnss(town):
    """Outages of 40 s after 3 and 10 s; 60 s of drive have no room for one after 30 s."""
    data = DriveDataModule(town, split={"train": ["g0"], "val": ["g1"], "test": ["g2"]}, eval_length_s=50.0, rate_hz=20)
    data.setup()
    assert scenes_after_gnss(data, "train", 30.0, 2, None) is None
    scenes = scenes_after_gnss(data, "train", 10.0, 2, 1)
    (batch,) = scenes.withhold()
    assert len(batch.drive) == 1 and torch.nonzero(~batch.available[0]).flatten().tolist() == list(range(10, 50))
    rows = score_after_gnss(FILTERS, data, [3, 10, 30], baseline="mbkf15", seed=2)
    assert [(r.seconds, r.segments, r.groups) for r in rows] == [(3.0, 2, 1), (10.0, 2, 1)]
    early, late = (r.filters["mbkf15"] for r in rows)
    assert late["rms_m"] < early["rms_m"] and late["geometric_m"] <= late["rms_m"] < rows[1].filters["ins"]["rms_m"]
    assert list(rows[0].ratios) == ["ins"] and rows[0].ratios["ins"].a == pytest.approx(
        rows[0].filters["ins"]["geometric_m"]
    )
    errors, headings = after_tables("town", rows, "mbkf15")
    assert len(errors.rows) == len(headings.rows) == 2 and len(errors.columns) == 5
