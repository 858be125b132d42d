"""A model that is scored on what it was trained on: said, and left out where asked for."""

from __future__ import annotations

import json
from pathlib import Path

import pandas as pd
import torch

from dlkf.data.store import dataset_digest
from dlkf.filters.card import recordings_seen, unmet_imus
from dlkf.filters.learned import LearnedConfig, LearnedFilter
from dlkf.filters.saved import save_filter

SMALL = {"network": {"cnn_channels": 4, "lstm_hidden": 8, "lstm_layers": 1, "dense": [8, 8]}}
SCORING = ("length_s=60", "outage.first_s=20", "outage.duration_s=20", "injected_bias=null", "baseline=mbkf15")


def test_recordings_count_by_name_or_digest_of_their_dataset():
    card = {"trained_on": ["a"], "chosen_on": ["b"], "datasets": {"town": "123"}}
    assert recordings_seen(card, "town", "999", ["a", "b", "c"]) == {"a", "b"}
    assert recordings_seen(card, "moved", "123", ["a", "c"]) == {"a"}
    assert recordings_seen(card, "other", "999", ["a"]) == set() == recordings_seen({}, "town", "123", ["a"])


def test_an_imu_that_a_model_has_not_met_is_said_and_no_other():
    cards = {"mine": {"imus": ["consumer"]}, "plus": {"imus": []}, "mbkf15": {}}
    assert unmet_imus(cards, ["consumer"]) == []
    (line,) = unmet_imus(cards, ["consumer", "bmi270"])
    assert line.startswith("mine was trained on the IMU consumer and has not met bmi270")


def test_evaluate_says_so_and_leaves_them_out(call, town, tmp_path):
    groups = list(pd.read_parquet(town / "drives.parquet")["group"])
    torch.manual_seed(0)
    model = LearnedFilter(LearnedConfig.from_mapping(SMALL))
    save_filter(model, "best", {"trained_on": groups[:1], "datasets": {"town": dataset_digest(town)}})
    done = call("evaluate", "model=[mbkf15,best]", f"dataset={town}", "out=all", *SCORING)
    assert done.code == 0, done.err
    assert "was trained or chosen on 1 of these 2 recordings" in " ".join(done.out.split())
    done = call("evaluate", "model=[mbkf15,best]", f"dataset={town}", "out=unseen", "unseen=true", *SCORING)
    assert done.code == 0 and "was trained" not in done.out, done.err
    counts = [json.loads(Path(out, "metrics.json").read_text())["results"][0]["count"] for out in ("all", "unseen")]
    assert [c["drives"] for c in counts] == [2, 1]
