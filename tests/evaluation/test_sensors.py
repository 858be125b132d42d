"""The table of further sensors says what the filters said themselves."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from dlkf.data.aid_tables import STANDARD
from dlkf.evaluation.sensors import sensor_table
from dlkf.filters.aids.attach import SOURCES, aid_columns, with_aids
from dlkf.filters.aids.estimates import format_estimate, label_estimate
from dlkf.filters.build import build_filter
from tests.cars import IMU, car_batch
from tests.evaluation.scoring import score


def test_a_row_for_each_filter_and_sensor():
    batch = car_batch(2, 30)
    forward = (batch.truth.C_nb[..., 0] * batch.truth.v_n).sum(-1)
    zero = torch.zeros_like(forward)
    count = zero + 1
    count[:, 10:15] = 0  # nothing for five seconds, then five of nonsense
    value = torch.where((torch.arange(30) >= 15) & (torch.arange(30) < 20), 5 * forward, 1.02 * forward)
    batch = replace(batch, aids={"speed": torch.stack((value, zero, zero, zero, count), -1)})
    plain = build_filter("mbkf21_car", IMU)
    filters = {"plain": plain, "aided": with_aids(plain, [STANDARD["speed"]])}
    columns = {name: aid_columns(model) for name, model in filters.items()}
    scores = score(filters, [batch])
    table = sensor_table(scores, columns)
    assert table is not None and len(table.rows) == 1
    name, sensor, updates, used, spread, scale, *_ = table.rows[0]
    assert (name, sensor, updates, used) == ("aided", "speed", "50", "80.0") and 0.05 < float(spread) < 1.5
    assert table.columns[5:] == [
        "Wheel scale error\n[%]",
        "Wheel delay\n[ms]",
        "Wheel right of IMU\n[m]",
        "Wheel offset\n[m/s]",
    ]
    last = scores.filters["aided"].aids[:, -1, columns["aided"].index("wheel_scale")]
    assert abs(float(scale.split()[0]) - 100 * last.mean()) < 0.1
    assert sensor_table(score({"plain": plain}, [batch]), columns) is None


def test_speed_from_vibration_has_a_row_of_its_own_beside_a_wheel_sensor():
    batch = car_batch(2, 30)
    forward = (batch.truth.C_nb[..., 0] * batch.truth.v_n).sum(-1)
    zero = torch.zeros_like(forward)
    batch = replace(batch, aids={"speed": torch.stack((forward, zero, zero, zero, zero + 1), -1)})
    model = with_aids(build_filter("mbkf21_car+vibration_speed", IMU), [STANDARD["speed"]])
    table = sensor_table(score({"both": model}, [batch]), {"both": aid_columns(model)})
    assert table is not None
    speed, vibration = table.rows
    assert speed[1] == "speed" and all(" ± " in cell for cell in speed[5:]) and len(speed) == 9
    assert vibration[:2] == ["both", "vibration speed"] and vibration[5:] == ["–"] * 4  # this car does not shake


@pytest.mark.parametrize(
    ("name", "value", "std", "shown"),
    [
        ("wheel_scale", 0.03041, 0.0035, "3.04 ± 0.35"),
        ("fix_delay_s", -0.07161, 0.009, "−71.6 ± 9.0"),
        ("baro_offset_m", 45.31, 12.4, "45 ± 12"),
        ("heading_offset", math.radians(0.994), math.radians(0.0996), "0.99 ± 0.10"),
        ("mine", 0.123456, 0.0, "0.123 ± 0.000"),
        ("mine", math.nan, 0.1, "–"),
    ],
)
def test_an_estimate_has_as_many_digits_as_its_sigma_allows(name, value, std, shown):
    assert format_estimate(name, value, std) == shown


def test_every_estimate_of_a_source_has_words_and_a_unit():
    for source in SOURCES.values():
        for name in getattr(source, "parameters", {}):
            assert label_estimate(name) != name
