"""A model that is scored on what it was trained on: said, and left out where asked for."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pandas as pd
import pytest
import torch

from dlkf.data.store import dataset_digest
from dlkf.filters.card import describe_slow_drives, describe_unseen_imus, find_seen_recordings
from dlkf.filters.learned import LearnedConfig, LearnedFilter
from dlkf.filters.saved import save_filter

SMALL = {"network": {"cnn_channels": 4, "lstm_hidden": 8, "lstm_layers": 1, "dense": [8, 8]}}
SCORING = ("length_s=60", "outage.first_s=20", "outage.duration_s=20", "injected_bias=null", "baseline=mbkf15")


def test_recordings_count_by_name_or_digest_of_their_dataset():
    card = {"trained_on": ["a"], "chosen_on": ["b"], "datasets": {"town": "123"}}
    assert find_seen_recordings(card, "town", "999", ["a", "b", "c"]) == {"a", "b"}
    assert find_seen_recordings(card, "moved", "123", ["a", "c"]) == {"a"}
    assert find_seen_recordings(card, "other", "999", ["a"]) == set() == find_seen_recordings({}, "town", "123", ["a"])


def test_an_imu_that_a_model_has_not_met_is_said_and_no_other():
    cards = {"mine": {"imus": ["consumer"]}, "plus": {"imus": []}, "mbkf15": {}}
    assert describe_unseen_imus(cards, ["consumer"]) == []
    (line,) = describe_unseen_imus(cards, ["consumer", "bmi270"])
    assert line.startswith("mine was trained on the IMU consumer; for bmi270 its accuracy")


def test_a_filter_that_listens_says_that_samples_are_too_slow_for_it():
    class Listening:
        least_rate_hz = 50.0

    models = {"plus": Listening(), "mbkf15": object()}
    assert describe_slow_drives(models, [50.0, 100.0, 49.9]) == []
    (line,) = describe_slow_drives(models, [100.0, 10.01, 1.0])
    assert line.startswith("plus needs samples at 50 Hz or more for its full accuracy and these drives have 1 to 10 Hz")


@pytest.mark.commands
@pytest.mark.whole
def test_navigate_and_evaluate_say_so_of_a_file_and_of_a_rate(call, town, tmp_path):
    """The rate of the samples in the file counts, whatever its ``drives.parquet`` says and they are brought to: what
    lies between them is not heard."""
    slow = Path(shutil.copytree(town, tmp_path / "slow"))
    table = pd.read_parquet(slow / "drives.parquet")
    for file in slow.glob("imu/*/*.parquet"):
        samples = pd.read_parquet(file, partitioning=None)
        samples.iloc[:: round(0.1 / samples["t"].diff().median())].to_parquet(file, index=False)
    said = "plus needs samples at 50 Hz or more for its full accuracy and these drives have 10 Hz"
    drive = f"drives=[{table['drive'][0]}]"
    for k, (data, more) in enumerate(((slow, ()), (town, ("rate_hz=10",)))):
        done = call("navigate", "model=plus", f"dataset={data}", f"out=navigated{k}", drive, *more)
        assert done.code == 0 and said in done.out and "have no effect" not in done.out, done
    noise = ("imu=consumer", "tuning.gyro_noise=2.5")
    done = call("navigate", f"dataset={town}", "out=untold", drive, *noise)
    assert done.code == 0 and f"plus has its own noise: {' '.join(noise)} have no effect" in done.out, done
    assert said not in done.out
    done = call("navigate", "model=ins", f"dataset={town}", "out=solved", drive, *noise)
    assert done.code == 0 and "have no effect" not in done.out, done
    done = call("evaluate", "model=[mbkf15,plus]", f"dataset={slow}", "out=scored", drive, *SCORING)
    assert done.code == 0 and said in " ".join(done.out.split()), done


@pytest.mark.whole
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
